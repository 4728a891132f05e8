"""Render tests of right renders: false alarms, whether "would have found" is true, and cost.

Make the pools first (`benchmarks.render_pools`), then run ``CHDSTAT_POOLS=FOLDER pytest
benchmarks/test_false_alarms.py --benchmark-only -s``. ``CHDSTAT_DRAWS`` sets the draws of each
scene, 100 by default, and ``CHDSTAT_SESSIONS`` the sessions, 300 by default: those take an hour.

**What a draw shows.** The batches of a pool are divided into a test and its reference at random.
Such halves are exchangeable whatever the samples are, so that an excess of small p-values is a
fault of the test. Draws of one pool share its batches, and hide what real tests could suffer from
besides: a dependence of consecutive batches, or of seeds. Every second draw therefore takes the
test from one part of the pool and the reference from another part, which has another seed. Such
draws share what the means of both parts differ by, by chance: they are judged over all scenes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from benchmarks.render_pools import (
    BUDGET,
    REFERENCE,
    TEST,
    batch_size,
    like,
    pools,
    sources,
)
from chdstat.inference import Contrast, Reference

ALPHA = 0.01
LEVELS = np.array([0.1, 0.01, 1e-3, 1e-4])
DRAWS = int(os.environ.get("CHDSTAT_DRAWS", "100"))
SESSIONS = int(os.environ.get("CHDSTAT_SESSIONS", "300"))
UNLIKELY = 1e-3
"""Chance of failing by accident, of each check of a share."""
_HEADER = "".join(f"{f'p<={level:g}':>10}" for level in LEVELS)

pytestmark = pytest.mark.filterwarnings(
    "ignore::chdstat.errors.InputWarning"  # images without any noise, and parts of them
)
needs_pools = pytest.mark.skipif(not pools(), reason="CHDSTAT_POOLS names no folder with pools")


class Pool:
    """Batches of a scene.

    Attributes
    ----------
    name
        What it is called.
    parts
        Means of batches (y, x, channel, batch), of one seed each.
    size
        Samples of a batch of a pixel.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.parts = [np.load(path) for path in pools()[name]]
        self.size = batch_size(*self.parts[0].shape[:2])

    def draw(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the batches of a test and of its reference."""
        rng = np.random.default_rng([seed, *map(ord, self.name)])
        if seed % 2 and len(self.parts) > 1:
            one, other = rng.choice(len(self.parts), 2, replace=False)
            return _some(rng, self.parts[one], TEST), _some(rng, self.parts[other], REFERENCE)
        both = _some(rng, self.parts[rng.integers(len(self.parts))], TEST + REFERENCE)
        return both[..., :TEST], both[..., TEST:]

    def contrast(self, test: np.ndarray, reference: np.ndarray, **options) -> Contrast:
        return _contrast(test, reference, self.size, **options)


def _contrast(test: np.ndarray, reference: np.ndarray, size: int, **options) -> Contrast:
    """Contrast batches of so many samples with those of a reference."""
    spp = size * reference.shape[-1]
    known = Reference(reference.mean(axis=-1, dtype=float), None, spp, 0, batches=reference)
    return chd.contrast(chd.Samples.from_array(test, averaged=size), known, **options)


def _some(rng: np.random.Generator, batches: np.ndarray, count: int) -> np.ndarray:
    return batches[..., rng.choice(batches.shape[-1], count, replace=False)]


def right() -> list[str]:
    """Return the scenes that have pools, but for one whose large images would take all the time."""
    return [name for name in sources() if name in pools() and name != "various_shapes_path"]


def _check(p: np.ndarray, line: str) -> None:
    """Fail if a share of independent p-values is surely above its level."""
    for level in LEVELS:
        count = int((p <= level).sum())
        sure = stats.binomtest(count, len(p), level, alternative="greater").pvalue
        assert sure > UNLIKELY / len(LEVELS), f"{line}: {count} of {len(p)} are up to {level}"


def _check_scenes(p: np.ndarray) -> None:
    """Fail if the mean share of p-values (scene, draw) is more than 3 standard errors too large.

    Draws of one scene depend on each other, scenes do not.
    """
    for level in LEVELS:
        shares = (p <= level).mean(axis=1)
        error = max(float(shares.std(ddof=1)), level) / np.sqrt(len(shares))
        assert shares.mean() <= level + 3 * error, f"{shares.mean():.4f} are up to {level}"


def _shares(p: np.ndarray) -> str:
    return "".join(f"{(p <= level).mean():10.4f}" for level in LEVELS)


# --- false alarms ---------------------------------------------------------------------------------


@needs_pools
def test_false_alarms_of_sessions(as_benchmark):
    """At most .02 of the sessions of right renders have any test that fails, at alpha .01.

    No share of p-values up to a level is surely above it, of a scene or of all.
    """
    tests = [Pool(name) for name in right()]
    p, tell = np.empty((SESSIONS, len(tests))), np.zeros(len(tests), int)
    alarms, began = [], time.process_time()
    print()
    for session in range(SESSIONS):
        for k, pool in enumerate(tests):
            found = pool.contrast(*pool.draw(session), alpha=ALPHA / len(tests), seed=session)
            p[session, k], tell[k] = found.image_p_value, tell[k] + (found.outcome == "cannot tell")
            if found.outcome == "differ":
                alarms.append(session)
                print(f"session {session}, {pool.name}: {found.conclusion}", flush=True)
        if session % 10 == 9:
            shares = _shares(p[: session + 1].ravel())
            seconds = time.process_time() - began
            print(f"{session + 1:4} x {len(tests)} tests{shares}{seconds:8.0f} s", flush=True)
    print(f"{'':46}{_HEADER}  cannot tell")
    for k, pool in enumerate(tests):
        print(f"{pool.name:46}{_shares(p[:, k])}{tell[k]:13}")
    print(f"{'all':46}{_shares(p.ravel())}{tell.sum():13}")
    count = len(set(alarms))
    ends = stats.binomtest(count, SESSIONS).proportion_ci(method="exact")
    print(f"{count / SESSIONS:.4f} [{ends.low:.4f}, {ends.high:.4f}] of sessions fail")
    assert count <= 0.02 * SESSIONS
    for k, pool in enumerate(tests):
        _check(p[::2, k], pool.name)
    _check_scenes(p.T)


@needs_pools
def test_false_alarms_of_renders_that_agree_in_the_mean(as_benchmark):
    """Tests by other integrators, or with Russian roulette from the start of each path."""
    print(f"\n{DRAWS} draws of each{'':42}{_HEADER}   differ  cannot tell")
    every = []
    for name in (name for name in pools() if like(name) != name and like(name) in pools()):
        other, pool = Pool(name), Pool(like(name))
        found = []
        for seed in range(DRAWS):
            rng = np.random.default_rng([seed, *map(ord, name)])
            test = _some(rng, other.parts[seed % len(other.parts)], TEST)
            reference = _some(rng, pool.parts[seed % len(pool.parts)], REFERENCE)
            found.append(pool.contrast(test, reference, alpha=ALPHA, seed=seed))
        p = np.array([one.image_p_value for one in found])
        outcomes = [one.outcome for one in found]
        line = (
            f"{name:56}{_shares(p)}{outcomes.count('differ'):9}{outcomes.count('cannot tell'):13}"
        )
        print(line, flush=True)
        every.append(p)
    _check_scenes(np.array(every))


Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
"""Draws samples of a shape (y, x, channel, sample)."""


def _level(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (0.2 + y / height + 2 * x / width)[:, :, np.newaxis, np.newaxis]


def _gamma(rng, size):
    return rng.gamma(0.5, 2.0, size) * _level(*size[:2])


def _fireflies(share, height):
    return lambda rng, size: _gamma(rng, size) + height * (rng.random(size) < share)


def _nulls(share):
    return lambda rng, size: rng.lognormal(-0.5, 1, size) * (rng.random(size) >= share)


def _lamps(rng, size):
    """Return noise beside a lamp that is constant."""
    x = _gamma(rng, size)
    x[: size[0] // 3] = 7
    return x


def _black(rng, size):
    """Return an image that is black but for a few pixels with one bright sample in a thousand."""
    x = np.zeros(size)
    x[:4, :4] = rng.gamma(1.0, size=(4, 4, *size[2:])) * (rng.random((4, 4, *size[2:])) < 1e-3)
    return x


def _filtered(rng, size):
    """Return passes whose neighbouring pixels share samples, as a filter makes them."""
    from scipy.ndimage import gaussian_filter1d

    x = _gamma(rng, size)
    for axis in (0, 1):
        x = gaussian_filter1d(x, 0.5, axis=axis, mode="nearest")
    return x


def _common(rng, size):
    """Return passes of which each has one light in common, whose brightness is random."""
    return _gamma(rng, size) * rng.gamma(4.0, 0.25, (1, 1, 1, size[-1]))


KINDS: dict[str, tuple[Draw, tuple[int, int, int], int]] = {
    "gamma": (_gamma, (32, 32, 3), 8),
    "fireflies, 1 of 2000 x 1000": (_fireflies(1 / 2000, 1000), (32, 32, 3), 8),
    "fireflies, 1 of 30,000 x 1000": (_fireflies(1 / 30_000, 1000), (32, 32, 3), 8),
    "fireflies, 1 of 300 x 10,000": (_fireflies(1 / 300, 10_000), (32, 32, 3), 8),
    "99 % nulls": (_nulls(0.99), (32, 32, 3), 8),
    "99.9 % nulls": (_nulls(0.999), (32, 32, 3), 8),
    "log-normal, sigma 2": (lambda rng, size: rng.lognormal(0, 2, size), (32, 32, 3), 8),
    "log-normal, sigma 3": (lambda rng, size: rng.lognormal(0, 3, size), (32, 32, 3), 8),
    "Pareto, infinite variance": (lambda rng, size: rng.pareto(1.2, size), (32, 32, 3), 8),
    "constant lamps": (_lamps, (32, 32, 3), 8),
    "nearly black": (_black, (32, 32, 3), 8),
    "negative values": (lambda rng, size: rng.gamma(1.0, size=size) - 0.9, (32, 32, 3), 8),
    "a filter": (_filtered, (32, 32, 3), 8),
    "light in common": (_common, (32, 32, 3), 8),
    "batches of 1 sample": (_gamma, (32, 32, 3), 1),
    "batches of 1 sample, log-normal": (
        lambda rng, size: rng.lognormal(0, 2, size),
        (32, 32, 3),
        1,
    ),
    "one channel": (_gamma, (32, 32, 1), 8),
    "16 x 16": (_gamma, (16, 16, 3), 8),
    "5 x 200": (_gamma, (5, 200, 3), 8),
    "128 x 128": (_gamma, (128, 128, 3), 1),
    "256 x 256": (_fireflies(1 / 2000, 1000), (256, 256, 3), 1),
}


@pytest.mark.parametrize("kind", KINDS)
def test_p_values_of_other_kinds(as_benchmark, kind):
    """No share of p-values up to a level is surely above it."""
    draw, size, each = KINDS[kind]
    draws = max(4, min(2 * DRAWS, round(2 * DRAWS * 64**2 / (size[0] * size[1]) / 4)))
    p, differ = np.ones(draws), 0
    for seed in range(draws):
        rng = np.random.default_rng([seed, *map(ord, kind)])
        x = np.stack(
            [draw(rng, (*size, each)).mean(axis=-1) for _ in range(TEST + REFERENCE)], axis=-1
        ).astype(np.float32)
        found = _contrast(x[..., :TEST], x[..., TEST:], each, alpha=ALPHA, seed=seed)
        p[seed], differ = found.image_p_value, differ + (found.outcome == "differ")
    line = f"{kind:32}{draws:4}{_shares(p)}{differ:9} differ"
    print(f"\n{line}", flush=True)
    _check(p[np.isfinite(p)], line)


# --- what would have been found -------------------------------------------------------------------


def _window(rng: np.random.Generator, height: int, width: int) -> tuple[slice, slice]:
    """Return a random window of a tenth of the image."""
    rows = min(height, round(np.sqrt(height * width / 10)))
    columns = min(width, round(height * width / 10 / rows))
    y, x = rng.integers(0, height - rows + 1), rng.integers(0, width - columns + 1)
    return slice(y, y + rows), slice(x, x + columns)


@needs_pools
@pytest.mark.parametrize("alpha", [0.05, ALPHA / 40])
def test_would_have_found_is_true(as_benchmark, alpha):
    """Of losses of the stated size, .85 to .95 are found, in the image and in a tenth of it."""
    print(f"\nalpha {alpha:g}: {DRAWS} draws of each{'':18}image  found      tenth  found  no size")
    every: dict[str, list[bool]] = {"image": [], "tenth": []}
    for name in right():
        pool = Pool(name)
        hits: dict[str, list[bool]] = {"image": [], "tenth": []}
        sizes: dict[str, list[float]] = {"image": [], "tenth": []}
        for seed in range(DRAWS):
            test, reference = pool.draw(20_000 + seed)
            stated = pool.contrast(test, reference, alpha=alpha, seed=seed).detectable
            rng = np.random.default_rng([seed, *map(ord, name), 1])
            for part in hits:
                where = _window(rng, *test.shape[:2]) if part == "tenth" else (slice(None),) * 2
                loss = stated.get(part, np.nan)
                if not loss < 1:
                    continue
                darker = test.copy()
                darker[where] *= np.float32(1 - loss)
                found = pool.contrast(darker, reference, alpha=alpha, seed=seed)
                hits[part].append(found.outcome == "differ")
                sizes[part].append(loss)
        line = f"{name:46}"
        for part, found in hits.items():
            every[part] += found
            if found:
                line += f"{np.median(sizes[part]):10.3%}{np.mean(found):7.2f}"
            else:
                line += f"{'':17}"
        print(f"{line}{DRAWS - len(hits['image']):9}", flush=True)
    for part, found in every.items():
        print(f"{part:10}found {np.mean(found):.3f} of {len(found)}")
    for part, found in every.items():
        assert 0.85 <= np.mean(found) <= 0.95, part


# --- cost -----------------------------------------------------------------------------------------


def _cost(scene: str, edge: int, spp: int) -> tuple[float, float]:
    """Return the processor time of the render, and of its contrast with a reference."""
    each = max(1, round(spp / TEST))
    start = time.process_time()
    batches = chd.rendering.render_batches(
        scene, spp=each * TEST, batch=each, size=(edge, edge), backend="llvm", progress=False
    )
    test = np.stack([x.mean(axis=-1, dtype=float) for x in batches], axis=-1).astype(np.float32)
    render = time.process_time() - start
    rng = np.random.default_rng(1)
    # In place of a reference of thrice the samples: the same batches, each moved by its noise.
    spread = test.std(axis=-1, keepdims=True)
    reference = test.mean(axis=-1, keepdims=True) + spread * rng.normal(
        size=(*test.shape[:3], REFERENCE)
    )
    reference = reference.astype(np.float32)
    _contrast(test[:8, :8], reference[:8, :8], each)  # imports
    start = time.process_time()
    _contrast(test, reference, each, alpha=ALPHA / 40)
    return render, time.process_time() - start


def test_cost_against_that_of_rendering(as_benchmark):
    """The contrast takes less than a tenth of the processor time of the render."""
    print(f"\n{'scene':12}{'pixels':>12}{'spp':>6}{'render':>9}{'contrast':>10}{'share':>8}")
    shares = []
    for scene, edge, spp in [
        *(("bathroom", edge, max(TEST, BUDGET // edge**2)) for edge in (64, 128, 256)),
        *(("bathroom", edge, 64) for edge in (64, 128, 256, 512)),
        ("cornell-box", 64, BUDGET // 64**2),
        ("cornell-box", 256, 64),
    ]:
        render, ours = _cost(scene, edge, spp)
        shares.append(ours / render)
        print(
            f"{scene:12}{f'{edge} x {edge}':>12}{spp:6}{render:8.2f}s{ours:9.2f}s{shares[-1]:8.1%}",
            flush=True,
        )
    assert max(shares) < 0.1


# --- samples drawn as needed ----------------------------------------------------------------------

MOST = 64
"""Largest number of samples that a function draws."""
RUNS = int(os.environ.get("CHDSTAT_RUNS", "500"))
DRAWN: dict[str, Draw] = {
    "gamma": _gamma,
    "fireflies, 1 of 2000 x 1000": _fireflies(1 / 2000, 1000),
    "90 % nulls": _nulls(0.9),
    "log-normal, sigma 1.5": lambda rng, size: rng.lognormal(0, 1.5, size) * _level(*size[:2]),
}


def _drawing(kind: str, seed: int, loss: float = 0) -> tuple[Callable, Reference]:
    """Return a function that draws one sample of each pixel from a seed, and a reference."""
    size = (24, 24, 3)
    rng = np.random.default_rng([seed, *map(ord, kind)])
    reference = DRAWN[kind](rng, (*size, 3 * MOST)).astype(np.float32)

    def draw(number: int) -> np.ndarray:
        own = np.random.default_rng([number, seed, *map(ord, kind)])
        return ((1 - loss) * DRAWN[kind](own, (*size, 1))).astype(np.float32)

    return draw, Reference.of_samples(reference)


def test_samples_drawn_as_needed_keep_alpha(as_benchmark):
    """At most .05 of the right renders differ, surely, and of each kind not surely more."""
    total = 0
    print()
    for kind in DRAWN:
        runs = RUNS // len(DRAWN)
        p = np.array(
            [
                chd.contrast(*_drawing(kind, seed), spp=MOST, alpha=0.05, seed=seed).image_p_value
                for seed in range(runs)
            ]
        )
        total += int((p <= 0.05).sum())
        line = f"{kind:32}{runs:4}{_shares(p)}{int((p <= 0.05).sum()):9} differ"
        print(line, flush=True)
        _check(p, line)
    assert total <= 0.05 * RUNS


def test_samples_drawn_as_needed_for_clear_differences(as_benchmark):
    """Losses of 2 to 4 times the smallest that all samples find take at most half of them."""
    print(f"\n{'loss over the smallest':32}  used   found")
    used: list[float] = []
    for kind in DRAWN:
        for factor in (2, 3, 4):
            spent, hits = [], 0
            for seed in range(max(5, RUNS // 50)):
                draw, reference = _drawing(kind, seed)
                every = np.concatenate([draw(number) for number in range(MOST)], axis=-1)
                loss = factor * chd.contrast(every, reference, alpha=0.05).detectable["image"]
                if not loss < 1:
                    continue
                found = chd.contrast(
                    _drawing(kind, seed, loss)[0], reference, spp=MOST, alpha=0.05, seed=0
                )
                spent.append(found.spp[0] / MOST)
                hits += found.outcome == "differ"
            if spent:
                print(
                    f"{kind:28}{factor:4}{np.mean(spent):6.2f}{hits / len(spent):8.2f}", flush=True
                )
                used += spent
    print(f"all: {np.mean(used):.2f}")
    assert np.mean(used) <= 0.5
