"""How often the variance is trusted, and what intervals hold where one sample dominates a pixel.

Run with ``pytest benchmarks/test_tails.py --benchmark-only -s``; CHDSTAT_SCENES names a
folder of real scenes. +- is the standard error of what is simulated or rendered.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import chdstat as chd

ROWS = 400
BODIES = {
    "exponential": stats.expon(),
    "gamma 0.2": stats.gamma(0.2),
    "gamma 0.3": stats.gamma(0.3),
    "gamma 0.5": stats.gamma(0.5),
    "gamma 2": stats.gamma(2),
    "uniform": stats.uniform(),
    "Beta(2, 5)": stats.beta(2, 5),
    "|normal|": stats.halfnorm(),
    "log-normal 0.5": stats.lognorm(0.5),
    "Weibull 0.7": stats.weibull_min(0.7),
    "Weibull 1.5": stats.weibull_min(1.5),
}
MUST = ("exponential", "gamma 0.5", "gamma 2", "uniform")


def _line(name, tail):
    verdicts = tail.variance_trusted, tail.variance_unidentified, tail.variance_suspect
    shares = "".join(f"{100 * v.mean():9.1f}" for v in verdicts)
    light = 100 * np.mean(tail.p_exponential < 0.05)
    far = np.nanmedian(tail.xi_far)
    return f"{name:34}{shares}{light:9.1f}{np.nanmedian(tail.xi):8.2f}{far:8.2f}"


HEADER = f"{'':34}{'trusted':>9}{'not id.':>9}{'suspect':>9}{'p < .05':>9}{'xi':>8}{'far':>8}"


@pytest.mark.parametrize("samples", [512, 2048, 8192])
def test_bodies_alone(benchmark, samples):
    rng = np.random.default_rng(samples)
    x = {name: body.rvs((ROWS, samples), random_state=rng) for name, body in BODIES.items()}
    found = benchmark.pedantic(
        lambda: {name: chd.fit.tail_index(values) for name, values in x.items()}, rounds=1
    )
    print(f"\n{HEADER}")
    for name, tail in found.items():
        print(_line(f"{name}, {samples} samples", tail))
    assert all(found[name].variance_trusted.mean() >= 0.9 - 0.045 for name in MUST)


GRAFTED = {
    "Pareto 0.7": (1.43, stats.pareto(0.7)),
    "Pareto 1": (1.0, stats.pareto(1.0)),
    "Pareto 1.5": (0.67, stats.pareto(1.5)),
    "Pareto 1.9": (0.53, stats.pareto(1.9)),
    "t(2) squared": (1.0, stats.f(1, 2)),
    "t(3) squared": (0.67, stats.f(1, 3)),
    "inverse gamma 1": (1.0, stats.invgamma(1)),
    "log-Cauchy": (np.inf, None),
}
GRAFTED_INTO = {
    "exponential": stats.expon(),
    "gamma 0.5": stats.gamma(0.5, scale=2),
    "log-normal 0.5": stats.lognorm(0.5),
}
OF_TAIL, BEYOND = (10, 15, 20, 25, 30, 40, 80), 5


def _share(found):
    error = np.sqrt(max(found.mean() * (1 - found.mean()), 1 / len(found)) / len(found))
    return f"{100 * found.mean():6.1f} +-{100 * error:4.1f}"


def _grafted(body, tail, of_tail, samples, start, rng):
    """Return samples, exactly so many of a tail, and how many of these lie above all others."""
    x = GRAFTED_INTO[body].rvs((1000, samples), random_state=rng)
    law = GRAFTED[tail][1]
    shape = len(x), of_tail
    heavy = (
        np.exp(np.clip(rng.standard_cauchy(shape), -99, 99))
        if law is None
        else law.rvs(shape, random_state=rng)
    )
    x[:, :of_tail] = start * heavy
    beyond = (x[:, :of_tail] > x[:, of_tail:].max(axis=-1, keepdims=True)).sum(axis=-1)
    return x, beyond


@pytest.mark.parametrize("samples", [100, 256, 1024, 4096])
@pytest.mark.parametrize("body", GRAFTED_INTO)
def test_exactly_so_many_of_a_tail(as_benchmark, body, samples):
    """All pixels, and those of which five samples of the tail or more lie above all others."""
    rng = np.random.default_rng(samples)
    print(f"\n{body}, {samples} samples: % trusted of all, with {BEYOND} beyond")
    print(f"{'':18}{'from':>5}" + "".join(f"{n:>29}" for n in OF_TAIL))
    for tail, (xi, _) in GRAFTED.items():
        for start in (1, 10):
            cells, seen = [], []
            for of_tail in OF_TAIL:
                if of_tail > samples // 3:
                    continue
                x, beyond = _grafted(body, tail, of_tail, samples, start, rng)
                trusted = chd.fit.tail_index(x).variance_trusted
                seen.append(trusted[beyond >= BEYOND])
                few = len(seen[-1]) < 20
                cells.append(_share(trusted) + (" " * 15 if few else f", {_share(seen[-1])}"))
            print(f"{tail:18}{start:5}" + "".join(f"{cell:>29}" for cell in cells))
            seen = np.concatenate(seen)
            allowed = 0.05 if xi >= 1 else 0.25 if xi < 0.6 else 0.15 if samples < 512 else 0.1
            if len(seen) >= 20:
                assert seen.mean() <= allowed + 3 * np.sqrt(allowed / len(seen))


DOMINATED = {"bathroom": 6, "night-room": 1, "caustic": 1, "many-lights": 1}
"""Scenes, and renders of them that pixels are looked for in."""
if folder := os.environ.get("CHDSTAT_SCENES"):
    DOMINATED[str(Path(folder) / "veach-bidir" / "scene.xml")] = 1


def _dominated(scene, renders):
    """Return (pixel, sample) of luminance of pixels with a sample above half of the sum."""
    few, many = [], []
    for seed in range(renders):
        image = chd.render(scene, spp=256, size=(64, 64), seed=200 + seed, progress=False)
        x = image.read().mean(axis=2)
        rows, columns = np.nonzero(x.max(axis=-1) > 0.5 * x.sum(axis=-1))
        some = np.random.default_rng(seed).permutation(len(rows))[:60]
        places = np.stack([rows, columns], axis=-1)[some]
        few.append(x[tuple(places.T)])
        for first in range(0, len(places), 8):
            some = places[first : first + 8]
            drawn = chd.rendering.render_pixels(scene, some, spp=16384, size=(64, 64), seed=7)
            many.append(drawn.mean(axis=1))
    return np.concatenate(few), np.concatenate(many)


@pytest.mark.parametrize("scene", DOMINATED)
def test_intervals_of_dominated_pixels(as_benchmark, scene):
    """The index of 16384 samples is itself known to about +- 0.15; only its estimate is looked for.

    Beside it: how often the intervals of both overlap, and the interval of the excesses alone.
    """
    few, many = map(chd.fit.tail_index, _dominated(scene, DOMINATED[scene]))
    known = np.isfinite(few.xi) & np.isfinite(many.xi)
    low, high = few.interval[known].T
    truth, (lowest, highest) = many.xi[known], many.interval[known].T
    ends = [(1 + few.xi[known]) * np.exp(s * 1.96 / np.sqrt(few.n[known])) - 1 for s in (-1, 1)]
    alone = (ends[0] <= truth) & (truth <= ends[1])
    held = (low <= truth) & (truth <= high)
    print(
        f"\n{scene}: of {known.sum()} pixels, % of intervals that hold {_share(held)}, overlap "
        f"{_share((low <= highest) & (lowest <= high))}, of the excesses alone {_share(alone)}; "
        f"median width {np.median(high - low):.2f}"
    )
    assert held.mean() >= 0.85
