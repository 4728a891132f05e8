"""Claim 17: the variance of averages of spread samples, and of independent ones in their place."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import chdstat as chd
from chdstat.samples.tiles import Region
from chdstat.studies.claims import CLAIMS, SceneData
from chdstat.studies.claims.between_renders import p_of_independence, variances

N = 16
CLAIM = next(claim for claim in CLAIMS if claim.number == 17)
REGIONS = (
    Region("left", "direct", (0.0, 0.0, 0.5, 1.0)),
    Region("right", "shadow", (0.5, 0.0, 1.0, 1.0)),
)


def stratified(rng: np.random.Generator, shape: tuple[int, ...], length: int = N) -> np.ndarray:
    """Return uniform samples (..., sequence, sample), one in each stratum of a sequence."""
    order = rng.permuted(np.broadcast_to(np.arange(length), (*shape, length)), axis=-1)
    return (order + rng.random(order.shape)) / length


def scene(x: np.ndarray, **more) -> SceneData:
    """Return a scene of which there are spread samples (y, x, sequence, sample)."""
    light = x.reshape(*x.shape[:2], 1, -1).astype(np.float32)
    spread = chd.Samples.from_array(light, sampler="stratified", sequence=x.shape[-1])
    samples = chd.Samples.from_array(np.ones((*x.shape[:2], 1, 64)))
    return SceneData("wall", samples, REGIONS, spread=spread, **more)


def test_the_ratio_is_known_for_uniform_strata():
    """Of n strata, an average has 1/n^2 of the variance; of half the pixels, it has all of it."""
    rng = np.random.default_rng(0)
    x = stratified(rng, (24, 24, 32))
    x[:, 12:] = rng.random((24, 12, 32, N))
    found = CLAIM.find(scene(x))
    assert found.verdict == "supported"
    assert found.test.interval.value == pytest.approx((1 + 1 / N**2) / 2, rel=0.03)
    left, right = (float(found.plot_data.series[name][1][0]) for name in ("left", "right"))
    assert left == pytest.approx(1 / N**2, rel=0.05)
    assert right == pytest.approx(1, rel=0.05)
    assert found.p_value < 0.01


DRAWS = {
    "uniform": lambda rng, shape: rng.random(shape),
    "long tail": lambda rng, shape: rng.lognormal(0, 1.5, size=shape),
    "nulls": lambda rng, shape: rng.gamma(1.0, size=shape) * (rng.random(shape) < 0.1),
}


def test_of_independent_samples_nothing_is_found():
    """At the level 5 %: each count of 6 exceeds 3 with a probability of 1 in 10,000."""
    verdicts, found_any = [], 0
    for seed in range(2):
        for draw in DRAWS.values():
            found = CLAIM.find(scene(draw(np.random.default_rng(seed), (16, 16, 16, N))))
            verdicts.append(found.verdict)
            found_any += found.p_value <= 0.05
            assert 0.8 < found.test.interval.value < 1.25
    assert len(verdicts) - verdicts.count("cannot tell") <= 3
    assert found_any <= 3


def test_variances_are_unbiased():
    rng = np.random.default_rng(1)
    x = rng.normal(10, 1, size=(20, 20, 8, N)) + rng.normal(0, 1, size=(20, 20, 8, 1))
    averages, single = variances(scene(x).spread)
    unit = (1 + 0.01) * 100
    assert averages.mean() * unit == pytest.approx(1 + N, rel=0.1)
    assert single.mean() * unit == pytest.approx(2, rel=0.05)


def test_a_firefly_adds_as_much_to_both_variances():
    x = np.random.default_rng(0).random((8, 8, 16, N))
    x[2, 3, 4, 5] = 1e6
    averages, single = variances(scene(x).spread)
    assert averages.argmax() == single.argmax() == 2 * 8 + 3
    assert averages.max() / single.max() == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize("name", DRAWS)
def test_p_values_of_independent_samples_are_uniform(name):
    x = DRAWS[name](np.random.default_rng(2), (100, 3, 12, 8))
    p = np.array([p_of_independence(pixels) for pixels in x])
    # More than 13 of 100 would happen once in 3000 runs.
    assert (p <= 0.05).sum() <= 13
    assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3
    assert p_of_independence(stratified(np.random.default_rng(2), (50, 12), 8)) == 0.002


def test_pixels_without_spread_are_not_tested():
    x = np.ones((3, 12, 8))
    x[1, 0, 0] = np.nan
    x[2] = 0
    assert p_of_independence(x) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda _: {"spread": None}, "rendered by a sampler that spreads samples"),
        (lambda s: {"spread": chd.Samples.from_array(s.spread.read())}, "samples in sequences"),
        (lambda s: {"spread": s.spread.first(7 * N)}, "8 sequences of 16 samples, has 7"),
        (lambda s: {"spread": s.spread.isel(y=slice(4))}, "spread samples in the same size"),
    ],
)
def test_what_is_missing_is_named(change, words):
    data = scene(np.random.default_rng(0).random((8, 8, 8, N)))
    found = CLAIM.find(replace(data, **change(data)))
    assert found.verdict == "cannot tell"
    assert words in found.reason


@pytest.mark.parametrize("value", [0.0, 1.0, np.nan, np.inf, 1e30, -1.0])
def test_hostile_samples_are_data(value):
    x = np.full((8, 8, 8, N), value, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = CLAIM.find(scene(x))
    assert found.verdict == "cannot tell"
    mixed = np.random.default_rng(0).random((8, 8, 8, N))
    mixed[0, 0] = value
    assert CLAIM.find(scene(mixed)).verdict in {"cannot tell", "supported", "not supported"}
