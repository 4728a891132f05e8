"""Histograms: every sample is counted once, where its value says, whatever the blocks."""

from __future__ import annotations

import numpy as np
import pytest

from chdstat import histogram
from chdstat.errors import Reason
from chdstat.samples import Samples
from chdstat.summary.histograms import StreamingHistogram, Support, linear_support

SCALES = ["linear", "log"]


@pytest.fixture
def radiance():
    """Radiance (pixel, channel, sample) with whole null samples, zeros and bad numbers."""
    rng = np.random.default_rng(11)
    x = rng.lognormal(-2, 2, (5, 3, 400)).astype(np.float32)
    x[rng.random((5, 1, 400)).repeat(3, axis=1) < 0.3] = 0
    x[1, 0, ::7] = 0
    x[2, 1, 5], x[2, 2, 60], x[3, 0, 99] = np.nan, np.inf, -1
    return x


def total(h):
    return h.counts.sum(axis=-1) + h.underflow + h.overflow + h.null_count + h.bad_count


@pytest.mark.parametrize("scale", SCALES)
def test_every_draw_is_counted_exactly_once(radiance, scale):
    h = histogram(radiance, scale=scale)
    assert h.n == 400
    assert (total(h) == 400).all()
    assert (h.counts >= 0).all()
    assert h.bad_count.tolist() == [[0] * 3, [0] * 3, [0, 1, 1], [0] * 3, [0] * 3]
    assert h.negative.tolist() == [[0] * 3, [0] * 3, [0] * 3, [1, 0, 0], [0] * 3]
    np.testing.assert_array_equal(h.null_count, (radiance == 0).sum(axis=-1))


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bins_are_those_of_numpy(scale, dtype):
    # Values at the middle of 1/1000 of a decade or bin: none is within rounding of an edge.
    rng = np.random.default_rng(3)
    x = (rng.integers(0, 40_000, 3000) + 0.5) / 10_000
    x = (10 ** (2 * x - 5) if scale == "log" else x).astype(dtype)
    support = (1e-4, 1e2) if scale == "log" else (0.5, 3.0)
    h = histogram(x, scale=scale, support=support)
    expected, _ = np.histogram(x, bins=h.edges)
    np.testing.assert_array_equal(h.counts, expected)
    assert h.underflow == (x < support[0]).sum() > 0
    assert h.overflow == (x > support[1]).sum() > 0


def test_edges_and_centers():
    h = histogram([[1.0], [2.0]], scale="linear", bins=4, support=([0, 1], [2, 3]))
    np.testing.assert_allclose(h.edges, [[0, 0.5, 1, 1.5, 2], [1, 1.5, 2, 2.5, 3]])
    np.testing.assert_allclose(h.centers, [[0.25, 0.75, 1.25, 1.75], [1.25, 1.75, 2.25, 2.75]])
    log = histogram([1.0])
    np.testing.assert_allclose(log.edges, np.logspace(-5, 5, 101))
    np.testing.assert_allclose(log.centers, np.sqrt(log.edges[1:] * log.edges[:-1]))


@pytest.mark.parametrize("scale", SCALES)
def test_density_integrates_to_the_share_inside(scale):
    x = np.random.default_rng(5).gamma(0.3, 2.0, (4, 2000))
    h = histogram(x, scale=scale, support=(1e-2, 3.0))
    edges = np.log10(h.edges) if scale == "log" else h.edges
    inside = ((x >= 1e-2) & (x < 3)).mean(axis=-1)
    np.testing.assert_allclose((h.density * np.diff(edges)).sum(axis=-1), inside)


def test_density_without_samples_is_nan():
    assert np.isnan(histogram([0.0, 0.0]).density).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_support_spans_the_first_fifty():
    x = np.concatenate([[0.0, np.nan, 3.0, 5.0], np.full(46, 4.0), [1000.0]])
    support = linear_support(x)
    assert (support.low, support.high) == (2.5, 5.5)
    h = histogram(x, scale="linear")
    assert (h.overflow, h.null_count, h.bad_count) == (1, 1, 1)


def test_the_fiftieth_draw_counts_and_the_next_does_not():
    x = np.ones(51)
    x[49], x[50] = 2, 3
    assert linear_support(x).high == 2.25


def test_one_value_gets_a_support_around_it():
    support = linear_support(np.full(60, 0.1, dtype=np.float32))
    np.testing.assert_allclose([support.low, support.high], [0.075, 0.125], rtol=1e-6)
    # Neighbours in float32 are no extent either: bins cannot be finer than floats.
    near = np.array([1, np.nextafter(np.float32(1), np.float32(2))], dtype=np.float32)
    np.testing.assert_allclose(linear_support(near).high, 1.25, rtol=1e-6)
    h = histogram(near, scale="linear")
    assert h.counts.sum() == 2


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_no_support_is_data_with_a_reason():
    late = np.zeros((4, 60))
    late[:, 55] = 2
    late[1, :50] = np.nan
    late[3] = 1
    null = late == 0
    null[2] = False  # pixel 2: zeros of a channel whose sample is not null
    h = histogram(late, scale="linear", null=null)
    assert h.reason.tolist() == [Reason.ALL_NULL, Reason.ALL_BAD, Reason.CONSTANT, Reason.OK]
    assert np.isnan(h.low[:3]).all()
    assert np.isnan(h.edges[:3]).all()
    assert h.overflow.tolist() == [1, 1, 60, 0]
    assert h.counts.sum(axis=-1).tolist() == [0, 0, 0, 60]
    assert (total(h) == 60).all()


def test_zero_channel_of_a_lit_sample_is_log_underflow():
    x = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 3.0]])  # (channel, sample): sample 1 is null
    null = (x == 0).all(axis=0)
    h = histogram(x, null=null)
    assert h.null_count.tolist() == [1, 1]
    assert h.underflow.tolist() == [0, 1]
    linear = histogram(x, scale="linear", null=null, support=(-1, 4))
    assert linear.counts.sum(axis=-1).tolist() == [2, 2]


def test_a_bad_mask_takes_the_whole_sample_out():
    x = np.array([[1.0, 2.0, 4.0], [np.nan, 3.0, 0.0]])
    h = histogram(x, bad=np.isnan(x).any(axis=0), null=np.zeros(3, dtype=bool))
    assert h.bad_count.tolist() == [1, 1]
    assert h.counts.sum(axis=-1).tolist() == [2, 1]


@pytest.mark.parametrize("scale", SCALES)
def test_blocks_and_merges_equal_all_at_once(radiance, scale):
    support = linear_support(radiance) if scale == "linear" else None
    whole = histogram(radiance, scale=scale)
    streams = [StreamingHistogram(scale=scale, support=support) for _ in range(3)]
    for stream, part in zip(streams, np.split(radiance, [1, 250], axis=-1), strict=True):
        stream.update(part[..., :1])
        if part.shape[-1] > 1:
            stream.update(part[..., 1:])
    empty = StreamingHistogram(scale=scale, support=support)
    merged = empty.merge(streams[2]).merge(streams[0]).merge(streams[1]).read()
    for name in ("counts", "underflow", "overflow", "null_count", "bad_count", "n"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(whole, name), err_msg=name)
    assert streams[2].read().n == 150


def test_chunks_do_not_show():
    x = np.random.default_rng(2).lognormal(size=150_000)  # more than one chunk in one row
    h = histogram(x)
    np.testing.assert_array_equal(h.counts, np.histogram(x, bins=h.edges)[0])


def test_extreme_radiance_is_counted_without_warnings():
    x = np.array([1e-45, 1e-40, 3e-39, 1e38, 3.3e38], dtype=np.float32)
    assert total(histogram(x)) == 5
    for part in (x, x[:2], x[3:]):
        assert total(histogram(part, scale="linear")) == part.size


def test_a_support_with_reasons_passes_through():
    support = Support(np.array([np.nan]), np.array([np.nan]), np.array([1], dtype=np.int8))
    h = histogram([[3.0]], scale="linear", support=support)
    assert h.overflow.tolist() == [1]


@pytest.mark.parametrize("scale", SCALES)
def test_image_equals_its_pixels(radiance, scale):
    x = np.concatenate([radiance, radiance[:3]]).reshape(2, 4, 3, 400)
    dataset = histogram(Samples.from_array(x), scale=scale)
    null = (x == 0).all(axis=-2, keepdims=True)
    bad = ~np.isfinite(x).all(axis=-2, keepdims=True)
    h = histogram(x, scale=scale, null=null, bad=bad)
    assert dataset[f"{scale}_counts"].dims == ("y", "x", "channel", f"{scale}_bin")
    for name in ("counts", "underflow", "overflow", "negative", "low", "high", "reason"):
        np.testing.assert_array_equal(dataset[f"{scale}_{name}"], getattr(h, name), err_msg=name)
    np.testing.assert_array_equal(dataset["null_count"], null.sum(axis=(-2, -1)))
    np.testing.assert_array_equal(dataset["bad_count"], bad.sum(axis=(-2, -1)))
    if scale == "log":
        np.testing.assert_allclose(dataset["log_bin"], np.logspace(-5, 5, 201)[1::2])


# --- tests of the binned part ---------------------------------------------------------------------


def test_log_statistics_agree_with_those_of_the_samples():
    rng = np.random.default_rng(2)
    log = rng.normal(size=(6, 4096)) * np.linspace(0.25, 1.5, 6)[:, np.newaxis]
    x = np.exp(log)
    mean = x.mean(axis=-1)
    binned = histogram(x).positive.log_statistics
    # The centres themselves would be off by h^2 / 12 = 0.0044 in variance, 7 % of the first row's.
    np.testing.assert_allclose(binned.log_variance, log.var(axis=-1), rtol=0.02)
    np.testing.assert_allclose(binned.gap, np.log(mean) - log.mean(axis=-1), rtol=0.03)
    np.testing.assert_allclose(binned.mean, mean, rtol=5e-3)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_the_counts_are_those_of_the_samples():
    x = np.array([0, 0, 1e-7, 0.5, 2, 3e6, np.nan, -1])
    part = histogram(x).positive
    assert (part.n, part.n_null, part.n_zero, part.n_negative, part.n_bad) == (3, 2, 1, 1, 1)
    assert part.n_good == 7
    assert part.counts[-1] == 1


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize(
    ("x", "reason"),
    [
        ([0.0, 0.0, 0.0], Reason.ALL_NULL),
        ([np.nan, np.nan], Reason.ALL_BAD),
        ([-2.0, 0.0], Reason.NONE_POSITIVE),
        ([0.0, 2.0], Reason.TOO_FEW),
        ([2.0, 2.0, 2.01], Reason.CONSTANT),
        ([1.0, 2.0, 5.0], Reason.OK),
        ([1e-9, 2.0, 5.0], Reason.OK),
        ([1e-7, 2e-7, 0.0], Reason.OUTSIDE),
        ([1e-6, 2e-6, 1.02e-5, 1e-6], Reason.OUTSIDE),
        ([1.0, 2e5, 3e5], Reason.OUTSIDE),
    ],
)
def test_reasons(x, reason):
    assert histogram(x).positive.reason() == reason
