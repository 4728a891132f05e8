"""Error of an estimate, against errors that are known, and what a smaller error takes."""

import math

import numpy as np
import pytest
from scipy import ndimage

from chdstat.estimators import estimate
from chdstat.estimators.default_estimate.error import ErrorOfEstimate, error_of
from tests.luminance import relative_error


def halves_of(truth, n, change, seed=0, draw=np.random.Generator.exponential):
    """Return the error that is found for changed means of n samples, and the true one."""
    rng = np.random.default_rng(seed)
    means, squares = [], []
    for _ in range(2):
        x = truth[..., np.newaxis] * draw(rng, size=(*truth.shape[:2], 1, n // 2))
        means.append(x.mean(axis=-1))
        squares.append(x.var(axis=-1, ddof=1) / n)
    mean = np.mean(means, axis=0)
    error = np.sqrt(np.mean(squares, axis=0))
    halves = [(change(y), y) for y in means]
    found = error_of(change(mean), error, halves, np.full(mean.shape, n))
    return found, relative_error((change(mean) - truth) ** 2, truth)


def sky(edge=64, channels=(1.0, 0.8, 0.6)):
    y, x = np.indices((edge, edge))
    return (0.4 + 0.3 * np.sin(y / 9) * np.cos(x / 7))[..., np.newaxis] * np.array(channels)


def white(edge=64):
    return np.random.default_rng(9).uniform(0.6, 1, (edge, edge, 1))


def smoothed(image):
    return ndimage.gaussian_filter(image, (2, 2, 0), mode="nearest")


@pytest.mark.parametrize(
    ("truth", "change"),
    [
        (sky(), lambda mean: mean),
        (sky(channels=(1.0,)), lambda mean: 0.9 * mean),
        (sky(), lambda mean: 0.9 * mean + 0.1 * mean.mean(axis=(0, 1))),
        (sky(), smoothed),
        (white(), smoothed),
        (white(), lambda mean: (mean + smoothed(mean)) / 2),
        (sky(edge=37), smoothed),
    ],
)
@pytest.mark.parametrize("n", [16, 256])
def test_the_error_is_the_true_one(truth, change, n):
    ratios = []
    for seed in range(4):
        found, true = halves_of(truth, n, change, seed)
        ratios.append(found.relative / true)
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)
    assert max(ratios) < 1.6 * min(ratios)


def test_rare_light_and_signed_samples_keep_their_error():
    def rare(rng, size):
        return np.where(rng.random(size) < 0.03, rng.exponential(size=size) / 0.03, 0)

    def signed(rng, size):
        return rng.normal(1, 3, size)

    for draw, change in ((rare, smoothed), (signed, smoothed), (signed, lambda mean: mean)):
        ratios = []
        for seed in range(4):
            found, true = halves_of(sky(), 128, change, seed, draw)
            ratios.append(found.relative / true)
        assert np.mean(ratios) == pytest.approx(1, abs=0.25)


def test_noise_alone_shows_no_bias():
    # The negative control: noise alone is a small part of the error of what is too smooth.
    found, true = halves_of(white(), 256, smoothed)
    assert math.sqrt(found.noise) < 0.5 * true


def test_an_exact_image_has_no_error():
    image = sky()
    found = error_of(image, np.zeros(image.shape), [(image, image)] * 2, np.full(image.shape, 8))
    assert (found.relative, found.surely, found.spp_for(0.01)) == (0, 0, 8)
    assert found.reaches(1e-6)
    assert found.told() == "relative error 0\N{NO-BREAK SPACE}%"
    assert error_of(0 * image, 0 * image, [(0 * image,) * 2] * 2, image).relative == 0


def test_pixels_that_are_unknown_are_left_out():
    truth, hole = sky(), np.zeros((64, 64, 3))
    hole[10:20, 10:20] = np.nan
    whole, _ = halves_of(truth, 64, lambda mean: mean)
    holed, _ = halves_of(truth, 64, lambda mean: mean + hole)
    assert holed.relative == pytest.approx(whole.relative, rel=0.05)
    assert holed.relative != whole.relative


def test_what_nothing_is_known_of_stops_nothing():
    unknown = np.full((4, 4, 1), np.nan)
    found = error_of(unknown, unknown, [(unknown, unknown)] * 2, np.full((4, 4, 1), 8))
    for one in (found, ErrorOfEstimate()):
        assert np.isnan([one.relative, one.surely, one.spp_for(0.1)]).all()
        assert not one.reaches(1.0)
        assert one.told(0.1) == "the samples do not tell the relative error"


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_unit_changes_nothing(unit):
    found, scaled = (halves_of(size * sky(), 64, smoothed)[0] for size in (1, unit))
    assert scaled.relative == pytest.approx(found.relative)
    assert scaled.spp_for(0.01) == pytest.approx(found.spp_for(0.01))


def test_one_pixel_has_the_error_of_its_mean():
    x = np.random.default_rng(0).exponential(size=(1, 1, 3, 200))
    found = estimate(x)
    assert found.radiance == pytest.approx(found.mean, rel=0.2)
    assert found.relative_error == pytest.approx(1 / math.sqrt(200), rel=0.3)
    assert found.error.surely > 1.1 * found.relative_error


def test_half_the_error_takes_four_times_the_samples():
    found, _ = halves_of(sky(), 64, lambda mean: mean)
    assert found.spp_for(found.relative / 2) == pytest.approx(4 * 64, rel=0.1)
    assert found.spp_for(found.relative) == pytest.approx(64)
    errors = np.geomspace(0.001, 1, 20)
    assert (np.diff([found.spp_for(error) for error in errors]) < 0).all()


def test_the_forecast_is_about_right():
    # Samples of a smooth image: the true error at the forecast number is about half.
    x = sky()[..., np.newaxis] * np.random.default_rng(1).exponential(size=(64, 64, 1, 1024))
    found = estimate(x[..., :32])
    n = round(found.spp_for(found.relative_error / 2))
    assert 4 * 32 < n < 1024
    then, now = (
        relative_error((one.radiance - sky()) ** 2, sky()) for one in (estimate(x[..., :n]), found)
    )
    assert then / now == pytest.approx(0.5, abs=0.1)


def test_an_error_is_reached_only_if_it_is_sure():
    likely = ErrorOfEstimate(bias=0.0, noise=0.0099, of_mean=0.01, spread=0.005, spp=64)
    sure = ErrorOfEstimate(bias=0.0, noise=0.0099, of_mean=0.01, spread=0.0005, spp=64)
    assert sure.reaches(0.1)
    assert not likely.reaches(0.1)
    assert "is not yet sure" in likely.told(0.1)
    assert "takes about" in sure.told(0.05, seconds=10)
    assert "more" not in sure.told(0.05)


def test_a_render_that_stops_has_its_error():
    # Of small images, whose errors seem small by chance in one of many passes.
    truth, wrong, naive, asked = sky(edge=6), 0, 0, 0.15
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = truth[..., np.newaxis] * rng.gamma(0.3, 1 / 0.3, size=(6, 6, 1, 1024))
        passes = []
        for n in range(16, 1025, 16):
            means = [x[..., i:n:2].mean(axis=-1) for i in range(2)]
            error = x[..., :n].std(axis=-1, ddof=1) / math.sqrt(n)
            halves = [(0.7 * mean + 0.3 * smoothed(mean), mean) for mean in means]
            estimate = np.mean([half for half, _ in halves], axis=0)
            found = error_of(estimate, error, halves, np.full(truth.shape, n))
            passes.append((found, relative_error((estimate - truth) ** 2, truth)))
        wrong += next(true for found, true in passes if found.reaches(asked)) > 1.1 * asked
        naive += next(true for found, true in passes if found.relative <= asked) > 1.1 * asked
    assert wrong <= 2
    assert naive > wrong


def test_any_shape_has_its_error():
    for shape in ((1, 1), (1, 300), (300, 1), (8, 9), (65, 130), (3000, 12)):
        means = np.random.default_rng(0).normal(1, 0.1, (2, *shape, 1))
        error = np.full((*shape, 1), 0.1 / math.sqrt(2))
        found = error_of(means.mean(axis=0), error, [(y, y) for y in means], np.full(shape, 8))
        assert found.relative == pytest.approx(0.07, rel=0.2 if math.prod(shape) > 1 else 0.5)
        assert found.bias == 0


def test_extreme_values_are_no_trouble():
    truth = sky() * np.array((0.0, 1e30, 1e-30))
    found, _ = halves_of(truth, 64, smoothed)
    alone, _ = halves_of(sky(channels=(1.0,)), 64, smoothed)
    assert found.relative == pytest.approx(math.sqrt(2 / 3) * alone.relative, rel=0.05)
