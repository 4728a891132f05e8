"""Contrasts: levels of p-values on renders, power against a test that knows the place, and time.

Run with ``pytest benchmarks/test_contrasts.py --benchmark-only -s``: about eight minutes, of
which simulated pairs, ``-k simulated``, take three.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.inference import Reference
from chdstat.scenes import load_scene

LEVELS = np.array([0.001, 0.01, 0.05, 0.1])
SCENES = ("cornell-box", "bathroom", "night-room", "gallery", "caustic", "many-lights")
SPP = (16, 64, 256, 1024)
KINDS = {
    "path, other seed": (False, 5),
    "roulette, other seed": (True, 7),
    "roulette, same seed": (True, 0),
}


def rendered(name, *, roulette=False, seed=0, spp=1024, edge=64):
    """Return samples in memory; with Russian roulette from the first segment on, or without."""
    scene = load_scene(name)
    if roulette:
        integrator = {**scene.source["integrator"], "rr_depth": 1}
        scene = replace(scene, source={**scene.source, "integrator": integrator})
    size = (edge, edge)
    return chd.render(scene, spp=spp, size=size, seed=seed, backend="scalar", progress=False)


@pytest.mark.parametrize("name", SCENES)
def test_levels_of_renders_with_equal_means(as_benchmark, name):
    """Shares of p-values up to a, of pixels and of verdicts; none above a + .01 for pixels."""
    path = rendered(name)
    print(f"\n{name:34} spp" + "".join(f"{f'p<={a}':>10}" for a in LEVELS) + "   verdicts p<=.05")
    for kind, (roulette, seed) in KINDS.items():
        other = rendered(name, roulette=roulette, seed=seed)
        for spp in SPP:
            parts = [slice(i, i + spp) for i in range(0, min(1024, 16 * spp), spp)]
            found = [chd.contrast(path.isel(sample=s), other.isel(sample=s)) for s in parts]
            p = np.concatenate([f.p_value.to_numpy().ravel() for f in found])
            shares = (p[np.isfinite(p), np.newaxis] <= LEVELS).mean(axis=0)
            verdicts = sum(f.outcome == "differ" for f in found)
            line = "".join(f"{share:10.4f}" for share in shares)
            print(f"{kind:34}{spp:4}{line}   {verdicts} of {len(found)}", flush=True)
            assert (shares <= LEVELS + 0.01).all()


def test_light_that_one_render_meets_by_chance(as_benchmark):
    """Direct light that follows the material, against both samplings: at most 4 of 30 differ.

    More is a chance of 1 in 64 if 1 in 20 do.
    """
    view = {"spp": 48, "size": (64, 64), "backend": "scalar", "progress": False}
    outcomes = []
    for seed in range(30):
        met, both = (
            chd.render(
                "cornell-box",
                seed=100 + 2 * seed + i,
                integrator={"type": "direct", "emitter_samples": i, "bsdf_samples": 1},
                **view,
            )
            for i in (0, 1)
        )
        outcomes.append(chd.contrast(met, both).outcome)
    print({outcome: outcomes.count(outcome) for outcome in sorted({*outcomes})})
    assert outcomes.count("differ") <= 4


EDGE, DRAWN = 16, 32
Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def _level(edge=EDGE):
    y, x = np.mgrid[:edge, :edge] / edge
    return (0.2 + y + 2 * x * y)[:, :, np.newaxis, np.newaxis]


def _gamma(shape) -> Draw:
    return lambda rng, size: rng.gamma(shape, 1 / shape, size)


def _log_normal(sigma) -> Draw:
    return lambda rng, size: rng.lognormal(-(sigma**2) / 2, sigma, size)


def _pareto(index) -> Draw:
    return lambda rng, size: 1 + rng.pareto(index, size)


def _nulls(share, draw) -> Draw:
    return lambda rng, size: draw(rng, size) * (rng.random(size) >= share)


def _fireflies(p, height, draw) -> Draw:
    """Return samples of which a share is brighter, by so many times the mean of the others."""
    return lambda rng, size: draw(rng, size) + height * (rng.random(size) < p)


CHDS: dict[str, Draw] = {
    "gamma": _gamma(0.5),
    "log-normal, sigma 2": _log_normal(2),
    "Pareto, infinite variance": _pareto(1.5),
    "95 % nulls": _nulls(0.95, _log_normal(1)),
    "fireflies, 1 of 10,000": _fireflies(1e-4, 1e4, _gamma(1.0)),
    "negative": lambda rng, size: rng.gamma(1.0, size=size) - 0.9,
}


def _independent(rng, draw, a):
    return draw(rng, a.shape) * _level()


def _longer(rng, draw, a):
    return draw(rng, (*a.shape[:3], 9 * DRAWN)) * _level()


def _exact(_rng, _draw, _a):
    return _level()[..., 0]


def _roulette(q, share=1.0, fresh=False):
    """Return samples of which a share is drawn again: x / q with probability q, or 0."""

    def of(rng, draw, a):
        x = draw(rng, a.shape) * _level() if fresh else a
        return np.where(rng.random(x.shape) < share, x * (rng.random(x.shape) < q) / q, x)

    return of


PAIRS = {
    **{(name, "independent"): _independent for name in CHDS},
    ("gamma", "9 times the spp"): _longer,
    **{(name, "exact image"): _exact for name in ("gamma", "log-normal, sigma 2")},
    ("gamma", "order of 3 samples"): lambda _, __, a: a[..., [2, 0, 1, *range(3, DRAWN)]],
    ("gamma", "roulette, q .5"): _roulette(0.5),
    ("gamma", "roulette, q .1"): _roulette(0.1),
    ("gamma", "roulette of 2 %, q .1"): _roulette(0.1, 0.02),
    ("log-normal, sigma 2", "roulette, q .1"): _roulette(0.1),
    ("log-normal, sigma 2", "roulette, q .1, other seed"): _roulette(0.1, fresh=True),
}


HARD = {("gamma", "roulette of 2 %, q .1"), ("log-normal, sigma 2", "roulette, q .1")}
"""Pairs of which few samples decide."""


def _interval(count, trials):
    ends = stats.binomtest(count, trials).proportion_ci(method="exact")
    return f"{count / trials:.3f} [{ends.low:.3f}, {ends.high:.3f}]"


@pytest.mark.parametrize(("chds", "kind"), PAIRS)
def test_levels_of_simulated_pairs(as_benchmark, chds, kind):
    """Shares of p-values up to a, and of false verdicts with their interval.

    At most 5 % of the verdicts are false, 10 % of the pairs in `HARD`, but for what chance adds in
    one case of 100. Without the allowance for missed samples, these were up to 19 %.
    """
    p, verdicts = [], []
    for seed in range(200):
        rng = np.random.default_rng([seed, *map(ord, chds + kind)])
        a = CHDS[chds](rng, (EDGE, EDGE, 1, DRAWN)) * _level()
        found = chd.contrast(a, PAIRS[chds, kind](rng, CHDS[chds], a), seed=seed)
        p.append(found.p_value.to_numpy().ravel())
        verdicts.append(found.outcome)
    p = np.concatenate(p)
    shares = (p[np.isfinite(p), np.newaxis] <= LEVELS[1:]).mean(axis=0)
    line = "".join(f"{share:8.4f}" for share in shares)
    print(
        f"\n{chds:26} {kind:27}{line}  false {_interval(verdicts.count('differ'), len(verdicts))}, "
        f"cannot tell {verdicts.count('cannot tell')}"
    )
    level = 0.1 if (chds, kind) in HARD else 0.05
    assert verdicts.count("differ") <= stats.binom.isf(0.01, len(verdicts), level)


COUNTS = ((16, 144), (16, 256), (16, 1024), (16, 4096), (32, 288), (64, 640), (256, 16))
SHAPES = ((8, 1), (8, 3), (16, 1), (16, 3), (32, 1))


def _rare_log_normal(rng, size):
    return rng.gamma(1.0, size=size) + (rng.random(size) < 1 / 2000) * rng.lognormal(5, 1.5, size)


EQUAL: dict[str, Draw] = {
    **{
        f"gamma, 1 of {n} x {height}": _fireflies(1 / n, height, _gamma(1.0))
        for n in (300, 2000, 10_000, 30_000)
        for height in (10, 100, 1000, 10_000)
    },
    **{
        f"constant, 1 of {n} x 1000": _fireflies(1 / n, 1000, lambda _, size: np.ones(size))
        for n in (300, 2000, 10_000, 30_000)
    },
    "gamma, log-normal ones": _rare_log_normal,
    "90 % nulls, 1 of 2000 x 1000": _fireflies(1 / 2000, 1000, _nulls(0.9, _gamma(1.0))),
    **{f"log-normal {sigma}": _log_normal(sigma) for sigma in (0.5, 1.5, 2.5)},
    **{f"Pareto {index}": _pareto(index) for index in (1.1, 1.5, 2.5)},
    **{f"{share:.0%} nulls": _nulls(share, _log_normal(1.0)) for share in (0.5, 0.9, 0.95, 0.99)},
    "gamma .2": _gamma(0.2),
    "gamma": _gamma(1.0),
}
REPRODUCTIONS = ("constant, 1 of 2000 x 1000", "gamma, 1 of 2000 x 1000", "gamma, log-normal ones")


@pytest.mark.parametrize("counts", COUNTS, ids=lambda c: f"{c[0]}-{c[1]}")
@pytest.mark.filterwarnings(
    "ignore::chdstat.errors.InputWarning"
)  # short renders without any noise
def test_levels_at_unequal_spp(as_benchmark, counts):
    """At most .06 of the verdicts of one distribution are "differ", and of its images have a q."""
    print(f"\n{counts[0]} against {counts[1]} spp{'':24}differ   any q <= .05   cannot tell")
    total, pooled = 0, np.zeros(3, int)
    for law, draw in EQUAL.items():
        trials = (100 if law in REPRODUCTIONS else 15) if max(counts) < 4096 else 10
        found = np.zeros(3, int)
        for seed in range(trials):
            rng = np.random.default_rng([seed, *counts, *map(ord, law)])
            edge, channels = SHAPES[seed % len(SHAPES)]
            a, b = (
                (draw(rng, (edge, edge, channels, n)) * _level(edge)).astype(np.float32)
                for n in counts
            )
            one = chd.contrast(a, b, seed=seed)
            found += [
                one.outcome == "differ",
                bool((one.q_value <= 0.05).any()),
                one.outcome == "cannot tell",
            ]
        total, pooled = total + trials, pooled + found
        print(f"{law:32}{trials:4}" + "".join(f"{n:13}" for n in found), flush=True)
    print("all: " + ", ".join(_interval(int(n), total) for n in pooled))
    assert (pooled[:2] <= 0.06 * total).all()


MEANS: dict[str, tuple[Draw, float]] = {
    **{f"gamma {shape}": (_gamma(shape), 1) for shape in (0.2, 1.0, 20.0)},
    **{f"log-normal {sigma}": (_log_normal(sigma), 1) for sigma in (0.5, 1.5, 2.5)},
    **{f"Pareto {index}": (_pareto(index), index / (index - 1)) for index in (1.5, 2.5)},
    **{f"{n:.1%} nulls": (_nulls(n, _log_normal(1)), 1 - n) for n in (0.5, 0.9, 0.95, 0.99, 0.999)},
    "constant": (lambda _, size: np.ones(size), 1),
    "an edge of 1 of 200": (_nulls(0.995, lambda _, size: np.ones(size)), 0.005),
    "an edge of 199 of 200": (_nulls(0.005, lambda _, size: np.ones(size)), 0.995),
    "gamma, 1 of 2000 x 100": (_fireflies(1 / 2000, 100, _gamma(1.0)), 1.05),
    "constant, 1 of 300 x 10": (_fireflies(1 / 300, 10, lambda _, size: np.ones(size)), 1 + 1 / 30),
    "constant, 1 of 2000 x 1000": (
        _fireflies(1 / 2000, 1000, lambda _, size: np.ones(size)),
        1.5,
    ),
}
"""Laws by their means."""
KINDS_OF_B = ("samples", "9 x samples", "exact", "half", "mean, variance", "no spp", "no variance")


def _other(kind, rng, draw, mean, level):
    """Return B with the mean of the law."""
    if kind in ("exact", "half"):
        return (mean * level[..., 0]).astype(np.float16 if kind == "half" else float)
    spp = DRAWN * (1 if kind in ("samples", "no spp") else 9)
    x = (draw(rng, (EDGE, EDGE, 1, spp)) * level).astype(np.float32)
    if "samples" in kind:
        return x
    variance = None if kind == "no variance" else x.var(axis=-1, ddof=1, dtype=float)
    return Reference(x.mean(axis=-1, dtype=float), variance, None if kind == "no spp" else spp)


@pytest.mark.filterwarnings("ignore::chdstat.errors.InputWarning")  # samples without any noise
@pytest.mark.parametrize("dark", [False, True], ids=["smooth", "with a dark corner"])
def test_levels_against_images_and_stores(as_benchmark, dark):
    """Of renders of one mean, at most .05 differ, and none of a law in a share surely above .05."""
    trials, level = 40, _level().copy()
    if dark:
        level[:7, 9:] *= 1e-4
    print(f"\n{'differ (cannot tell) of 40':28}" + "".join(f"{kind:>16}" for kind in KINDS_OF_B))
    wrong = dict.fromkeys(KINDS_OF_B, 0)
    for law, (draw, mean) in MEANS.items():
        line = f"{law:28}"
        for kind in KINDS_OF_B:
            found = []
            for seed in range(trials):
                rng = np.random.default_rng([seed, *map(ord, law + kind)])
                a = (draw(rng, (EDGE, EDGE, 1, DRAWN)) * level).astype(np.float32)
                b = _other(kind, rng, draw, mean, level)
                found.append(chd.contrast(a, b, seed=seed).outcome)
            differ = found.count("differ")
            line += f"{differ:10} ({found.count('cannot tell'):3})"
            wrong[kind] += differ
            assert stats.binomtest(differ, trials, 0.05, alternative="greater").pvalue > 1e-3, line
        print(line, flush=True)
    for kind, count in wrong.items():
        print(f"{kind:28}{_interval(count, trials * len(MEANS))}")
        assert count <= 0.05 * trials * len(MEANS)


def _best(mean, variance, block, spp):
    """Return the smallest loss that is found in 90 % by the best weighted sum over a known block.

    Weights are the mean over the variance, each smoothed a little or not, or the mean's inverse.
    """
    from scipy.ndimage import uniform_filter

    weights = [np.ones_like(mean), 1 / np.maximum(uniform_filter(mean, 3), 1e-9)]
    for edge in (3, 7, 13):
        near = uniform_filter(variance, edge)
        weights.append(uniform_filter(mean, edge) / np.maximum(near, near[near > 0].min()))
    noisy = block & (variance > 0)  # a lamp without noise shows any loss
    ratios = [(w * mean)[noisy].sum() / np.sqrt((w**2 * variance)[noisy].sum()) for w in weights]
    return (1.96 + 1.2816) / max(ratios) / np.sqrt(spp)


@pytest.mark.parametrize("kind", ["other seed", "same seed"])
@pytest.mark.parametrize("spp", [64, 256])
def test_power_in_a_tenth_of_the_bathroom(as_benchmark, kind, spp):
    """A loss of twice the size that the best test of a known block finds in 90 %."""
    path = rendered("bathroom").read()
    other = (
        rendered("bathroom", roulette=True) if kind == "same seed" else rendered("bathroom", seed=5)
    ).read()
    light = [np.asarray(chd.Samples.from_array(x)).mean(axis=2) for x in (path, other)]
    mean, variance = light[0].mean(axis=-1), (light[1] - light[0]).var(axis=-1)
    rng, factors = np.random.default_rng(1), (1.0, 1.5, 2.0, 2.5)
    hits, trials = np.zeros(len(factors)), 40
    for trial in range(trials):
        y, x = rng.integers(0, 64 - 20, 2)
        block = np.zeros((64, 64), bool)
        block[y : y + 20, x : x + 20] = True
        i = trial % (1024 // spp)
        j = i if kind == "same seed" else (trial // 4) % (1024 // spp)
        a, b = path[..., i * spp : (i + 1) * spp], other[..., j * spp : (j + 1) * spp]
        for k, factor in enumerate(factors):
            loss = min(1, factor * _best(mean, variance, block, spp))
            dark = np.where(block[:, :, np.newaxis, np.newaxis], b * np.float32(1 - loss), b)
            hits[k] += chd.contrast(a, dark).outcome == "differ"
    print(f"\n{kind}, {spp} spp: found, by the size of the loss over that of the best test:")
    print("  ".join(f"{f}: {h / trials:.2f}" for f, h in zip(factors, hits, strict=True)))
    assert hits[2] >= 0.75 * trials


def test_time_against_that_of_rendering(as_benchmark):
    start = time.process_time()
    a = rendered("bathroom", spp=256, edge=128)
    render = time.process_time() - start
    b = rendered("bathroom", spp=256, edge=128, seed=1)
    start = time.process_time()
    chd.contrast(a, b)
    ours = time.process_time() - start
    print(f"\n128 x 128 x 256: contrast {ours:.2f} s, one render {render:.1f} s of processor time")
    assert ours < 0.1 * render
