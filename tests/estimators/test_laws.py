"""Laws that hold for every fixed estimator, whatever it does with the samples."""

import inspect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from chdstat import estimators
from chdstat.errors import InputError

NAMES = estimators.names("fixed")
ENTRIES = {name: estimators.lookup(name) for name in NAMES}
NEIGHBOURS = [name for name in NAMES if ENTRIES[name].uses_neighbours]
OF_PIXELS = [name for name in NAMES if not ENTRIES[name].uses_neighbours]
PARAMETERS = {
    name: {*inspect.signature(entry.function).parameters} for name, entry in ENTRIES.items()
}
DEALT = [name for name in NAMES if PARAMETERS[name] & {"buckets", "resamples"}]
"""What deals samples by their order, so that in another one they are dealt otherwise."""
SPLIT = {*DEALT, "rousselle2012"}
"""What splits samples into parts, others of which arise where one sample is left out."""
ORDER_FREE = [name for name in NAMES if name not in DEALT]

TOLERATED = {
    "median": 15,
    "trimmed_mean": 3,
    "winsorized_mean": 3,
    "huber": 15,
    "tukey": 15,
    "median_of_means": 5,
    "gmon_binary": 5,
    "gmon_adaptive": 3,
    "lee_valiant": 1,
}
"""Fireflies of any size, one per bucket, among 32 samples that do not carry the estimate away."""


def images(seed=0, shape=(4, 5, 3, 32)):
    return np.random.default_rng(seed).gamma(0.7, size=shape)


def unit_of(entry):
    """Return a unit of radiance for those that would take it from all pixels of an image."""
    return {"unit": 1.0} if "unit" in PARAMETERS[entry.name] else {}


def test_the_mean_comes_first():
    assert NAMES[0] == "mean"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [1e-290, 0.3, 2.0**90])
def test_scaling_the_radiance_scales_the_estimate(name, factor):
    x = images()
    assert ENTRIES[name](factor * x) == pytest.approx(factor * ENTRIES[name](x), rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [1e-45, 7.0, 3e38])
def test_equal_samples_give_their_value(name, value):
    x = np.full((3, 3, 3, 32), value, np.float32)
    assert ENTRIES[name](x) == pytest.approx(x[..., 0], rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_null_samples_give_zero_in_their_dtype(name):
    for dtype in (np.float32, np.float64):
        estimate = ENTRIES[name](np.zeros((3, 3, 3, 32), dtype))
        assert estimate.dtype == dtype
        assert not estimate.any()


@pytest.mark.parametrize("name", ORDER_FREE)
def test_the_order_of_the_samples_does_not_matter(name):
    x = images()
    shuffled = np.random.default_rng(1).permuted(np.arange(32))
    assert ENTRIES[name](x[..., shuffled]) == pytest.approx(ENTRIES[name](x), rel=1e-9)


@pytest.mark.parametrize("name", DEALT)
def test_buckets_and_resamples_do_depend_on_the_order(name):
    """Negative control of the law above."""
    x = images()
    estimate = ENTRIES[name](x)
    assert ENTRIES[name](np.sort(x)) != pytest.approx(estimate, rel=1e-9)


@pytest.mark.parametrize("name", OF_PIXELS)
def test_a_pixel_is_estimated_from_its_own_samples(name):
    x = images()
    options = unit_of(ENTRIES[name])
    together = ENTRIES[name](x, **options)
    for y, row in enumerate(x):
        for column, pixel in enumerate(row):
            alone = ENTRIES[name](pixel, **options)
            assert alone == pytest.approx(together[y, column], rel=1e-9)


@pytest.mark.parametrize("name", [n for n in OF_PIXELS if not ENTRIES[n].joint_channels])
def test_a_channel_is_estimated_from_its_own_samples(name):
    x = images()
    assert ENTRIES[name](x[1, 2, 1]) == pytest.approx(ENTRIES[name](x)[1, 2, 1], rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_estimates_lie_within_the_samples(name):
    x = images()
    estimate = ENTRIES[name](x)
    assert (estimate >= 0).all()
    assert (estimate <= x.max(axis=-1)).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=25)
@given(
    hnp.arrays(
        np.float32,
        (2, 2, 3, 12),
        elements=st.one_of(
            st.floats(0, 1, width=32),
            st.sampled_from([0.0, 1.0, 1e-45, 1e-20, 1e30, 3e38, np.nan, np.inf, -1.0]),
        ),
    )
)
def test_it_is_finite_exactly_where_the_mean_is(name, x):
    finite = np.isfinite(estimators.mean(x.astype(np.float64)))
    assert (np.isfinite(ENTRIES[name](x)) == finite).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", NAMES)
def test_bad_samples_are_left_out(name):
    x = images(shape=(3, 3, 3, 64))
    spoilt = x.copy()
    spoilt[..., 32:] = np.nan
    spoilt[0, 0, :, 32] = np.inf
    spoilt[1, 1, :, 32] = -np.inf
    if ENTRIES[name].joint_channels:  # of which one bad channel spoils the sample
        spoilt[2, 2, :, 32] = 1.0, np.nan, 1.0
    if name in SPLIT:
        assert np.isfinite(ENTRIES[name](spoilt)).all()
    else:
        assert ENTRIES[name](spoilt) == pytest.approx(ENTRIES[name](x[..., :32]), rel=1e-9)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", NEIGHBOURS)
def test_a_lost_pixel_neither_takes_nor_gives(name):
    x = images(12, (6, 6, 3, 16))
    x[2, 3, :, :] = np.nan
    x[4, 4, 0, :] = -np.inf
    found = ENTRIES[name](x)
    assert np.isnan(found[2, 3]).all()
    assert np.isnan(found[4, 4, 0])
    elsewhere = np.ones((6, 6), bool)
    elsewhere[[2, 4], [3, 4]] = False
    assert np.isfinite(found[elsewhere]).all()
    assert (found[elsewhere] < 20).all()


@pytest.mark.parametrize("name", NEIGHBOURS)
def test_one_pixel_and_one_row_are_images(name):
    one, row = images(15, (1, 1, 3, 16)), images(16, (1, 9, 3, 16))
    assert ENTRIES[name](one).shape == (1, 1, 3)
    assert ENTRIES[name](row).shape == (1, 9, 3)


@pytest.mark.parametrize(
    ("name", "option", "values"),
    [
        ("trimmed_mean", "share", (-0.1, 0.5, np.nan)),
        ("winsorized_mean", "share", (-0.1, 0.5, np.nan)),
        ("huber", "c", (0.0, np.nan)),
        ("tukey", "c", (-1.0, np.nan)),
        ("catoni", "delta", (0.0, 1.0, np.nan)),
        ("median_of_means", "buckets", (0, 33)),
        ("lee_valiant", "delta", (0.0, 1.0)),
        ("lee_valiant", "buckets", (33,)),
        ("bayesian_median_of_means", "alpha", (0.0,)),
        ("jung2015", "resamples", (0, 9.5)),
        ("jung2015", "seed", (-1, 0.5)),
        ("jung2015", "location", ("mode",)),
        ("zirr2018", "kappa", (0.0, -1.0)),
        ("zirr2018", "unit", (0.0,)),
        ("clamped", "limit", (0,)),
        ("decoro2010", "neighbours", (0, 1.5)),
        ("decoro2010", "bandwidth", (0.0,)),
        ("decoro2010", "radius", (-1,)),
        ("delbracio2014", "radius", (-1,)),
        ("delbracio2014", "threshold", (0.0,)),
        ("delbracio2014", "patch", (-1,)),
        ("delbracio2014", "unit", (0.0,)),
        ("sakai2024", "alpha", (1.0,)),
        ("sakai2024", "radius", (-1,)),
        ("sakai2024", "spread", (0,)),
        ("sakai2024", "features", ({"albedo": np.zeros((2, 3, 3))},)),
        ("sakai2025", "alpha", (0.0,)),
        ("sakai2025", "radius", (-1,)),
        ("sakai2025", "spread", (0,)),
        ("sakai2025", "transforms", ((1.0, 0.0), (np.nan,))),
        ("sakai2025", "variances", ("smoothed",)),
        ("sakai2025", "features", ({"normal": np.zeros((2, 3, 3))},)),
        ("sakai2025", "film", (np.zeros((3, 3, 32)), np.zeros((3, 3, 2, 16)))),
        ("shared_patches", "threshold", (np.nan,)),
        ("shared_patches", "fireflies", ("hunt",)),
        ("shared_shape", "alpha", (0.0,)),
        ("shared_shape", "limit", (0.0,)),
        ("rousselle2012", "damping", (0,)),
        ("boughida2017", "threshold", (0,)),
        ("boughida2017", "scales", (0,)),
    ],
)
def test_options_out_of_range_are_refused(name, option, values):
    for value in values:
        with pytest.raises(InputError, match="got"):
            ENTRIES[name](np.ones((3, 3, 3, 32)), **{option: value})


@pytest.mark.parametrize("name", NAMES)
def test_the_least_number_of_samples_is_named(name):
    least = ENTRIES[name].minimum_samples
    with pytest.raises(InputError, match=f"{least} sample.* with {least - 1}"):
        ENTRIES[name](np.ones((2, 2, 3, least - 1)))
    assert np.isfinite(ENTRIES[name](np.ones((2, 2, 3, least)))).all()


@pytest.mark.parametrize("name", [n for n in NAMES if ENTRIES[n].joint_channels])
def test_colours_need_channels(name):
    shape = r"\(.*channel, sample\), got \(32,\)"
    message = rf"x must (have shape|be an image of shape) {shape}"
    with pytest.raises(InputError, match=message):
        ENTRIES[name](np.ones(32))


@pytest.mark.parametrize("name", TOLERATED)
def test_fireflies_up_to_the_breakdown_do_no_harm(name):
    x = images(shape=(50, 32)) + 0.1
    dirty = x.copy()
    dirty[:, : TOLERATED[name]] = 1e30
    assert (ENTRIES[name](dirty) <= x.max(axis=-1)).all()


@pytest.mark.parametrize("name", TOLERATED)
def test_one_firefly_more_does(name):
    """Negative control; the mean, which tolerates none, is the first example."""
    x = images(shape=(50, 32)) + 0.1
    for entry, count in ((ENTRIES["mean"], 1), (ENTRIES[name], TOLERATED[name] + 1)):
        dirty = x.copy()
        dirty[:, :count] = 1e30
        assert (entry(dirty) > 1e20).all()
