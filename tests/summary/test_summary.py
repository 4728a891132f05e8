"""Summary: the moments are right, bad samples stay apart, and merging loses nothing."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from chdstat.samples import Samples
from chdstat.summary.histograms import Histogram, linear_support
from chdstat.summary.statistics import Summary, summarize

MOMENTS = ("mean", "variance", "skewness", "kurtosis", "minimum", "maximum", "standard_error")
COUNTS = ("count", "null_count", "bad_count", "nan_count", "inf_count", "negative_count")
NIST = json.loads((Path(__file__).parent / "nist_univariate.json").read_text())


def radiance(shape=(4, 3, 300), *, seed=7, nulls=0.3):
    rng = np.random.default_rng(seed)
    x = rng.lognormal(-1, 1.2, shape).astype(np.float32)
    return x * (rng.random((*shape[:-2], 1, shape[-1])) >= nulls)


def with_bad(x):
    x = x.copy()
    x[0, 0, 3], x[0, 2, 3], x[1, 1, 200], x[2, :, 70:80] = np.nan, -np.inf, np.inf, np.nan
    return x


def assert_same(a, b):
    """Compare two Statistics: counts exactly, moments to rounding."""
    for field in fields(a):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, Histogram):
            np.testing.assert_array_equal(one.counts, other.counts, err_msg=field.name)
        else:
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12, err_msg=field.name)


def test_moments_are_those_of_scipy():
    x = radiance()
    s = Summary().update(x).read()
    wide = x.astype(np.float64)
    expected = {
        "mean": wide.mean(axis=-1),
        "variance": wide.var(axis=-1, ddof=1),
        "skewness": stats.skew(wide, axis=-1),
        "kurtosis": stats.kurtosis(wide, axis=-1),
        "minimum": wide.min(axis=-1),
        "maximum": wide.max(axis=-1),
        "standard_error": stats.sem(wide, axis=-1),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(s, name), value, rtol=1e-10, err_msg=name)
    nulls = (x == 0).all(axis=-2).sum(axis=-1)
    np.testing.assert_array_equal(s.null_count, nulls)
    np.testing.assert_array_equal(s.count, 300)
    np.testing.assert_allclose(s.null_share, nulls / 300)


def nist_data(case):
    if "data" in case:
        return np.array(case["data"], dtype=np.float64)
    cycle = np.resize(np.array(case["cycle"], dtype=np.float64), case["n"] - 1)
    return np.concatenate([[case["first"]], cycle])


def seen(x):
    """Summarise samples (channel, sample) that lie between -1000 and 10^8."""
    return Summary(support=(-1e3, 1e8), bins=1).update(x)


def exact_deviation(x):
    """Return the standard deviation of numbers, computed without rounding but that of the root."""
    numbers = [Fraction(number) for number in x]
    mean = sum(numbers, Fraction()) / len(numbers)
    return math.sqrt(sum((number - mean) ** 2 for number in numbers) / (len(numbers) - 1))


def merged_at_random(parts, rng):
    """Merge parts two by two, in random order, until one is left."""
    parts = list(parts)
    while len(parts) > 1:
        one, other = (parts.pop(rng.integers(len(parts))) for _ in range(2))
        parts.append(one.merge(other))
    return parts[0]


@pytest.mark.parametrize("name", sorted(NIST.keys() - {"source"}))
@pytest.mark.parametrize("step", [7, 100, 2000])
def test_nist_digits_in_any_order(name, step):
    """Mean and deviation have 12 digits, but where double precision rounds the data themselves.

    The decimals of NumAcc3 and NumAcc4 are rounded by 1e-10 and 1e-9, a share of 1e-9 and 1e-8 of
    the deviation, 0.1: their certified deviation is not that of any data in double precision.
    """
    case = NIST[name]
    x = nist_data(case)[np.newaxis]
    digits = {"NumAcc3": 1e-9, "NumAcc4": 2e-8}.get(name, 1e-12)
    parts = [seen(x[:, start : start + step]) for start in range(0, x.shape[1], step)]
    found = merged_at_random(parts, np.random.default_rng(0)).read()
    np.testing.assert_allclose(found.mean, case["mean"], rtol=2e-15)
    deviation = np.sqrt(found.variance)
    np.testing.assert_allclose(deviation, case["standard_deviation"], rtol=digits)


@pytest.mark.parametrize("name", ["NumAcc3", "NumAcc4"])
def test_rounded_nist_data_lose_nothing_more_at_once(name):
    x = nist_data(NIST[name])
    (variance,) = seen(x[np.newaxis]).read().variance
    assert math.sqrt(variance) == pytest.approx(exact_deviation(x.tolist()), rel=1e-14)


@pytest.mark.parametrize("seed", range(6))
def test_random_trees_of_merges_are_one_summary(seed):
    rng = np.random.default_rng(seed)
    x = radiance((3, 3, 400), seed=seed)
    x = with_bad(x) if seed % 2 else x
    support = linear_support(x)
    whole = Summary(support=support).update(x).read()
    cuts = np.sort(rng.choice(np.arange(1, 400), rng.integers(1, 40), replace=False))
    parts = [Summary(support=support).update(p) for p in np.split(x, cuts, axis=-1)]
    parts += [Summary(support=support) for _ in range(seed % 3)]  # that have seen nothing
    found = merged_at_random(parts, rng).read()
    for name in COUNTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name), err_msg=name)
    for name in MOMENTS:
        expected = getattr(whole, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-12, err_msg=name)
    for one, other in ((found.linear, whole.linear), (found.log, whole.log)):
        for name in ("counts", "underflow", "overflow", "null_count", "bad_count"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_merging_at_batch_bounds_keeps_the_batches():
    x = radiance(seed=3)
    support = linear_support(x)
    one, two = (Summary(support=support).update(p) for p in np.split(x, [96], axis=-1))
    before = two.read()
    assert_same(one.merge(two).read(), Summary(support=support).update(x).read())
    assert_same(two.read(), before)


def test_bad_samples_are_as_if_they_had_not_been_drawn():
    x = with_bad(radiance())
    s = Summary().update(x).read()
    assert s.nan_count.tolist() == [1, 0, 10, 0]
    assert s.inf_count.tolist() == [1, 1, 0, 0]
    assert s.bad_count.tolist() == [1, 1, 10, 0]
    assert s.count.tolist() == [299, 299, 290, 300]
    for pixel in range(4):
        good = np.isfinite(x[pixel]).all(axis=0)
        clean = Summary(support=(s.linear.low[pixel], s.linear.high[pixel]))
        expected = clean.update(x[pixel][:, good]).read()
        for name in MOMENTS:
            np.testing.assert_allclose(getattr(s, name)[pixel], getattr(expected, name), rtol=1e-12)
        np.testing.assert_array_equal(s.log.counts[pixel], expected.log.counts)
        np.testing.assert_array_equal(s.linear.counts[pixel], expected.linear.counts)
    np.testing.assert_array_equal(s.linear.bad_count, s.bad_count[:, np.newaxis].repeat(3, axis=1))


def test_what_cannot_be_computed_is_nan():
    x = np.full((3, 1, 70), 0.1, dtype=np.float32)
    x[1] = np.nan
    x[2, 0, 1:] = np.inf
    s = Summary().update(x[..., :1]).update(x[..., 1:]).read()
    assert s.count.tolist() == [70, 0, 1]
    np.testing.assert_allclose(s.mean[:, 0], [0.1, np.nan, 0.1], rtol=1e-6)
    np.testing.assert_array_equal(s.variance[:, 0], [0, np.nan, np.nan])
    np.testing.assert_array_equal(s.standard_error[:, 0], [0, np.nan, np.nan])
    for name in ("skewness", "kurtosis"):
        assert np.isnan(getattr(s, name)).all(), name
    for name in ("null_share", "minimum", "maximum"):
        np.testing.assert_array_equal(np.isnan(getattr(s, name)).ravel(), [False, True, False])
    np.testing.assert_array_equal(np.isnan(s.batch_means).all(axis=-1)[:, 0], [False, True, False])


@pytest.mark.parametrize("bad", [False, True])
def test_batch_means_are_those_of_consecutive_samples(bad):
    x = with_bad(radiance((4, 3, 288))) if bad else radiance((4, 3, 288))
    s = Summary().update(x[..., :50]).update(x[..., 50:]).read()
    good = np.isfinite(x).all(axis=-2, keepdims=True)
    wide = np.where(good, x, np.nan).astype(np.float64).reshape(4, 3, 9, 32)
    np.testing.assert_allclose(s.batch_means, np.nanmean(wide, axis=-1), rtol=1e-12)
    assert s.batch_spp.tolist() == [32] * 9


@pytest.mark.parametrize(
    ("spp", "expected"),
    [(5, [5]), (32, [32]), (40, [32]), (128, [32] * 4), (129, [64] * 2), (700, [256] * 2)],
)
def test_batches_double_when_they_are_full(spp, expected):
    x = radiance((1, 1, spp), seed=spp)
    summary = Summary(max_batches=4, support=(0, 9))
    for start in range(0, spp, 10):
        summary.update(x[..., start : start + 10])
    s = summary.read()
    assert s.batch_spp.tolist() == expected
    first = x[..., : expected[0]].mean(axis=-1, dtype=np.float64)
    np.testing.assert_allclose(s.batch_means[..., 0], first, rtol=1e-12)


@pytest.mark.parametrize("split", [1, 40, 100, 130, 700, 990])
def test_merged_batches_hold_every_draw_of_a_complete_batch(split):
    x = radiance((1, 1, 1000), seed=split).astype(np.float64)
    one, two = (
        Summary(max_batches=8, support=(0, 9)).update(part)
        for part in np.split(x, [split], axis=-1)
    )
    s = one.merge(two).read()
    assert s.draws == 1000
    assert len(s.batch_spp) <= 8
    assert (s.batch_spp >= 128).all()
    assert 1000 - s.batch_spp.sum() < 128


def test_batch_means_tell_correlation():
    """Under independence B S_b^2 / (S^2 / size) is chi-square with B - 1 degrees of freedom.

    2000 pixels, 63 degrees: the mean ratio has a standard error of sqrt(2 / 63 / 2000) = 0.004;
    five of them fail falsely with probability 6e-7.
    """
    rng = np.random.default_rng(23)
    x = rng.gamma(2.0, size=(2000, 1, 2048)).astype(np.float32)

    def ratio(samples):
        s = Summary().update(samples).read()
        return (32 * s.batch_means.var(axis=-1, ddof=1) / s.variance).mean()

    assert abs(ratio(x) - 1) < 0.02
    assert ratio(x[..., :1024].repeat(2, axis=-1)) > 1.5


def test_memory_does_not_grow_with_spp():
    summary = Summary(support=(0, 9))
    sizes = []
    for seed in range(40):
        summary.update(radiance((2, 3, 256), seed=seed))
        s = summary.read()
        sizes.append(s.batch_means.size + s.log.counts.size + s.linear.counts.size)
    assert max(sizes[10:]) <= 6 * (64 + 200)


def test_image_equals_its_pixels_whatever_the_tiles():
    x = radiance((2, 70, 3, 130), seed=1)  # two tiles across, three blocks each
    x[1, 3, 0, 100] = np.nan
    dataset = summarize(Samples.from_array(x, scene="noise"))
    s = Summary().update(x).read()
    for name in (*COUNTS, *MOMENTS, "null_share", "batch_means", "batch_spp"):
        np.testing.assert_allclose(dataset[name], getattr(s, name), rtol=1e-6, err_msg=name)
    for scale, h in (("linear", s.linear), ("log", s.log)):
        for name in ("counts", "underflow", "overflow", "low", "high", "reason"):
            np.testing.assert_array_equal(dataset[f"{scale}_{name}"], getattr(h, name))
    assert dataset.attrs == {"scene": "noise", "batch_size": 32}
    assert dataset["mean"].dims == ("y", "x", "channel")
    assert list(dataset["channel"].values) == ["R", "G", "B"]
    assert all({"long_name", "units"} <= set(v.attrs) for v in dataset.data_vars.values())
