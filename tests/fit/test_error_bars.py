"""Error bars: what is predicted is what batches show, and the pixels around count."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.fit import error_bars
from chdstat.fit.error_bars import Bar, pooled_bars, spp_in_words
from chdstat.summary.runner import measured

LAWS = {
    "exponential": stats.expon(),
    "gamma 0.5": stats.gamma(0.5),
    "log-normal 1": stats.lognorm(1),
    "log-normal 1.5": stats.lognorm(1.5),
    "rare": stats.bernoulli(0.01),
}


@pytest.mark.parametrize("n", [128, 512, 2048])
@pytest.mark.parametrize("name", LAWS)
def test_coverage_from_a_known_shape(name, n):
    """The shape is that of 400 000 samples; 4000 batches have an error of at most 0.007.

    Differences of 0.02 and less were measured, and of 0.06 for equal rare samples, whose last group
    is rounded; 256 draws are even, but have an error, too.
    """
    law, rng = LAWS[name], np.random.default_rng(71)
    many = measured(PositivePart.of(law.rvs(400_000, random_state=rng).astype(float)), Bar())
    counts = many.shape[np.newaxis] * (n / 400_000)
    predicted = float(error_bars._predicted(counts, np.array([n]))[0])
    batches = law.rvs((4000, n), random_state=rng)
    error = 1.96 * batches.std(axis=-1, ddof=1) / np.sqrt(n)
    held = np.mean(np.abs(batches.mean(axis=-1) - law.mean()) <= error)
    assert predicted == pytest.approx(held, abs=0.08 if name == "rare" else 0.04)


def lit(share, shape=(9, 9), spp=512, seed=72):
    """An image of gamma samples, of which a rare share is 300 times as bright."""
    rng = np.random.default_rng(seed)
    x = rng.gamma(2.0, size=(*shape, 1, spp))
    return np.where(rng.random(x.shape) < share, 300 * x, x).astype(np.float32)


def verdict_of(x):
    found = chd.fit.tail_index(chd.Samples.from_array(x), progress=False)
    return found["tail_coverage"].isel(channel=0), found["tail_variance_suspect"].isel(channel=0)


def test_the_pixels_around_see_what_a_pixel_has_missed():
    """A sample in 700 is 300 times as bright: half of the pixels have none among 512."""
    x = lit(1 / 700)
    missed = (x.max(axis=-1) < 100)[..., 0]
    assert 0.3 < missed.mean() < 0.7
    coverage, suspect = verdict_of(x)
    own = chd.fit.tail_index(x[..., 0, :])
    assert own.variance_suspect[missed].mean() < 0.1  # its own samples cannot tell
    assert suspect.to_numpy().all()
    assert float(coverage.max()) < 0.8
    # Negative control: without the rare samples, nothing fails.
    coverage, suspect = verdict_of(lit(0))
    assert not suspect.any()
    assert float(coverage.min()) > 0.9


def test_one_bright_sample_condemns_no_other():
    x = lit(0)
    x[4, 4, 0, 100] = 30 * x.mean()
    assert not verdict_of(x)[1].any()


def test_brightness_does_not_matter():
    x = lit(1 / 700)
    scaled = x * np.linspace(0.01, 100, 9, dtype=np.float32)[:, None, None, None]
    np.testing.assert_allclose(verdict_of(scaled)[0], verdict_of(x)[0], atol=0.03)


def test_what_is_not_known_has_no_verdict():
    x = lit(0)
    x[0] = 0  # black
    x[8] = 2.5  # constant
    coverage, suspect = verdict_of(x)
    assert np.isnan(coverage[8]).all()
    assert not suspect[8].any()
    assert np.isfinite(coverage[1:8]).all()
    few, suspect = verdict_of(lit(0, spp=32))
    assert np.isnan(few).all()
    assert not suspect.any()
    black = np.zeros((3, 3, 1, 128), np.float32)
    assert np.isnan(verdict_of(black)[0]).all()
    reasons = measured(
        PositivePart.of(np.stack([x[0, 0, 0], x[8, 0, 0], x[4, 0, 0]])), Bar()
    ).reason
    assert reasons.tolist() == [Reason.ALL_NULL, Reason.CONSTANT, Reason.OK]


def test_pixels_far_away_do_not_matter():
    x = lit(0, shape=(9, 30))
    other = x.copy()
    other[:, 20:] = lit(1 / 100, shape=(9, 10))
    np.testing.assert_array_equal(verdict_of(x)[0][:, :16], verdict_of(other)[0][:, :16])


def test_unequal_numbers_of_samples():
    """Frequencies are pooled, not counts: four times as many samples of a pixel change little."""
    bars = measured(PositivePart.of_pixels(lit(0)), Bar())
    shape, samples = bars.shape.copy(), bars.samples.copy()
    shape[::2], samples[::2] = 4 * shape[::2], 4 * samples[::2]
    more = pooled_bars(shape, samples).coverage
    np.testing.assert_allclose(more, pooled_bars(bars.shape, bars.samples).coverage, atol=0.02)


def test_verdicts_name_their_spp():
    image = chd.Samples.from_array(np.repeat(lit(0, spp=128), 3, axis=2))
    found = chd.classify(image, progress=False)
    for name in ("long_tail", "firefly_dominated"):
        assert "at 128 spp" in found[name].attrs["long_name"]
    assert spp_in_words(np.array([0, 64, 128])) == "64 to 128 spp"


def behind_a_lamp(rng, shape):
    """Samples of fog: a broad dark body, a narrow bright mode, and few brighter ones."""
    body, mode = rng.gamma(4, 0.05, shape), rng.uniform(0.40, 0.42, shape)
    x = np.where(rng.random(shape) < 0.2, mode, np.minimum(body, 0.4))
    return np.where(rng.random(shape) < 0.04, 0.42 + rng.exponential(0.15, shape), x)


def test_a_narrow_mode_on_top_is_no_tail():
    """The tail beyond the mode is exponential; the mode's edge would show an index of 1 to 3."""
    tail = chd.fit.tail_index(behind_a_lamp(np.random.default_rng(73), (100, 1024)))
    assert (tail.reason == Reason.EDGE).mean() > 0.8
    assert not (tail.interval[:, 0] >= 0.5).mean() > 0.05
    assert not tail.variance_suspect.mean() > 0.05
    # Negative control: a given share has an index, of the mode's edge.
    assert (
        np.nanmedian(
            chd.fit.tail_index(behind_a_lamp(np.random.default_rng(73), (100, 1024)), share=0.15).xi
        )
        > 0.5
    )
