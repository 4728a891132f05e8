"""Combination: weights of candidates per pixel, their intervals, and what is told of them."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import combine, estimate, write_estimates
from chdstat.estimators.estimates import through_denoiser
from chdstat.estimators.halves import Measured, candidates, compare_halves
from chdstat.estimators.weighting import LEVELS, Combination, Weighting
from chdstat.io import read_exr


@pytest.fixture(scope="module")
def samples():
    return chd.render("bathroom", spp=64, size=(64, 64), seed=3, backend="scalar", progress=False)


@pytest.fixture(scope="module")
def found(samples):
    return estimate(samples)


@pytest.fixture(scope="module")
def reference():
    rendered = chd.render(
        "bathroom", spp=512, size=(64, 64), seed=4, backend="scalar", progress=False
    )
    x = rendered.read().astype(np.float64)
    return x.mean(axis=-1), x.std(axis=-1, ddof=1) / np.sqrt(512)


def test_it_is_the_default_and_each_candidate_has_its_share(samples, found):
    total = sum(weight.astype(np.float64) for weight in found.weights.values())
    assert np.allclose(total, 1, atol=1e-5)
    assert min(weight.min() for weight in found.weights.values()) >= 0
    assert np.allclose(found.certainty, 1 - found.weights["mean"], atol=1e-6)
    x = samples.read()
    made = candidates(Measured.of(samples).starts[0], samples.features)
    assert made.keys() == found.weights.keys()
    mixed = sum(found.weights[name][..., np.newaxis] * made[name] for name in made)
    error = x.std(axis=-1, ddof=1) / 8
    kept = mixed > made["mean"] - 3 * error  # above the floor
    assert kept.mean() > 0.9
    assert (np.abs(found.radiance - mixed)[kept] <= error[kept] + 1e-4).all()


def test_light_that_denoisers_lose_is_given_back_but_not_to_what_is_certain(monkeypatch):
    # Whatever the samples say, a sixth of an image that has lost light.
    weights = {
        "denoised": 5 / 6,
        "denoised shared_shape": 1 / 6,
        "mean": 1e-9,
        "shared_shape": 1e-9,
    }
    centre = Weighting.shipped(with_features=False).centre
    scores = np.array([*np.log(list(weights.values())), 0.0])
    fixed = Weighting(
        [(np.zeros((5, len(centre))), scores)], centre, np.ones_like(centre), np.ones((3, 5))
    )
    monkeypatch.setattr(Weighting, "shipped", lambda **_: fixed)
    rng = np.random.default_rng(1)
    found_one = rng.random((64, 64, 1, 16)) < 0.1
    x = np.where(found_one, 5, 0.1) * rng.exponential(size=found_one.shape)
    x = np.repeat(x, 3, axis=2).astype(np.float32)
    x[:8, :8] = 0.7
    found, made = combine(x), candidates(Measured.of(chd.Samples.from_array(x)).starts[0], {})
    mixed = sum(weights[name] * made[name] for name in made)
    assert mixed.mean() / x.mean() - 1 < -2 * found.bias_error
    assert -1.6 * found.bias_error < found.bias < 0
    certain = slice(8), slice(8)
    assert np.allclose(found.radiance[certain], np.maximum(mixed, 0.7)[certain], rtol=1e-4)


def test_it_is_better_than_the_mean_and_than_a_denoiser(samples, found, reference):
    truth, _ = reference
    made = candidates(Measured.of(samples).starts[0], samples.features)
    weight = 1 / (truth**2 + 0.01 * truth.mean() ** 2)

    def errors(image):
        squared = (image - truth) ** 2
        return np.array([squared.mean(), (squared * weight).mean()])

    denoised = min((errors(made[n]) for n in ("denoised", "denoised with features")), key=np.prod)
    assert (errors(found.radiance) < 0.6 * errors(made["mean"])).all()
    assert (errors(found.radiance) < 1.1 * denoised).all()


def test_intervals_hold_the_reference_and_are_wider_for_more(samples, found, reference):
    truth, error = reference
    noisier = truth + error * np.random.default_rng(0).standard_normal(truth.shape)
    inside, less = (np.mean((found.low <= y) & (y <= found.high)) for y in (truth, noisier))
    # As much noise again as the reference has tells what it took (simulation extrapolation).
    assert 0.8 < 2 * inside - less < 0.97
    widths = [
        np.mean(combine(samples.read(), features=samples.features, level=level).high)
        for level in (0.4, *LEVELS, 0.995)
    ]
    assert (np.diff(widths) > 0).all()


def test_widths_are_those_of_thirds_of_brightness():
    steps = np.arange(1, 6) * np.array([[1.0], [2.0], [4.0]])
    weighting = Weighting([], np.zeros(1), np.ones(1), steps)
    unit = np.random.default_rng(0).permutation(600).reshape(20, 30)
    # 0.998 is as far from 0.99 as that is from 0.95: errors fall off exponentially.
    for level, place in ((0.5, 1), (0.9, 3), (0.99, 5), (0.998, 6)):
        widths = weighting.quantile(level, unit)
        assert widths[unit < 100] == pytest.approx(place)
        assert widths[(unit == 299) | (unit == 300)] == pytest.approx(2 * place, rel=0.01)
        assert widths[unit >= 500] == pytest.approx(4 * place)
        assert (np.diff(widths.ravel()[np.argsort(unit.ravel())]) >= 0).all()
    assert (weighting.quantile(0.9, np.ones((4, 4))) == 6).all()


def test_bias_stands_beside_it(samples, found):
    mean = samples.read().mean(axis=-1, dtype=np.float64)
    assert found.bias == pytest.approx(
        found.radiance.mean(dtype=np.float64) / mean.mean() - 1, rel=1e-3
    )
    # The standard error of the image's mean, of independent pixels.
    luminance = samples.read().mean(axis=2, dtype=np.float64)
    right = np.sqrt((luminance.var(axis=-1, ddof=1) / 64).sum()) / luminance.mean(axis=-1).sum()
    assert right <= found.bias_error < 1.2 * right


def test_the_unit_of_radiance_and_the_order_of_samples_make_no_difference(samples):
    x = samples.read()
    first = combine(x, features=samples.features)
    scaled = combine(x * np.float32(1024), features=samples.features)
    assert np.allclose(scaled.radiance, 1024 * first.radiance, rtol=1e-3, atol=1e-4)
    shuffled = chd.estimators.combination(x[..., ::-1])
    assert np.array_equal(chd.estimators.combination(x), shuffled)


def test_bad_pixels_stay_bad_and_touch_no_other(samples):
    x = samples.read().copy()
    x[5, 6], x[9, 9, 0, 3], x[20, 20] = np.nan, np.inf, 0
    found = combine(x)
    assert np.isnan(found.radiance[5, 6]).all()
    assert np.isfinite(np.delete(found.radiance.reshape(-1, 3), 5 * 64 + 6, axis=0)).all()
    black = combine(np.zeros((8, 8, 3, 16)))
    assert (black.radiance == 0).all()
    assert np.isnan(black.bias)


def test_a_lamp_that_many_samples_find_is_no_firefly():
    rng = np.random.default_rng(0)
    x = rng.exponential(0.02, size=(48, 48, 3, 64)).astype(np.float32)
    x[20, 20, :, rng.random(64) < 0.3] = 500  # the edge of a lamp
    x[30, 30, :, 5] = 500  # a firefly
    found = combine(x).radiance
    assert (found[20, 20] > 40).all()
    assert (found[30, 30] < 4).all()


def test_it_is_denoised_once_more_as_far_as_the_samples_agree(samples, found):
    def row(*values):
        return np.array(values, np.float32).reshape(1, -1, 1)

    # Not denoised; half; denoised; out of the interval of the mean to each side; outside before.
    seen = row(0, 0.5, 1, 1, 1, 1)[..., 0]
    estimates = Combination(
        *[row(2, 2, 2, 2, 2, 0.5)] * 4,
        level=0.9,
        mean=row(2, 2, 2, 2, 2, 2),
        least=row(1, 1, 1, 1, 1, 1),
        weights={"mean": 1 - seen, "denoised": seen},
    )
    denoised = row(1.5, 1.5, 1.5, 9, 0.1, 0.7)
    assert estimates.guarded(denoised).ravel() == pytest.approx([2, 1.75, 1.5, 3, 1, 0.7])
    again = estimate(samples, denoise=True).radiance
    expected = found.guarded(through_denoiser(found.radiance, samples.features))
    assert np.array_equal(again, expected)


def test_a_mean_of_few_good_samples_is_less_certain():
    x = np.random.default_rng(0).exponential(size=(16, 16, 3, 32)).astype(np.float32)
    x[4, 5, :, 4:] = np.nan
    least = combine(x).least
    for pixel, good in (((4, 5), 4), ((9, 9), 32)):
        kept = x[pixel][:, :good].astype(np.float64)
        error = kept.std(axis=-1, ddof=1) / np.sqrt(good)
        expected = kept.mean(axis=-1) - stats.t(good - 1).isf(0.001) * error
        assert least[pixel] == pytest.approx(expected, rel=1e-5)


def test_one_channel_is_taken():
    x = np.random.default_rng(0).gamma(0.3, size=(24, 24, 1, 16))
    assert abs(combine(x).radiance.mean() - 0.3) < 0.03


def test_a_store_is_read_by_tiles_and_never_as_a_whole(tmp_path, monkeypatch):
    x = np.random.default_rng(0).gamma(0.3, size=(96, 72, 3, 16)).astype(np.float32)
    held, sizes = chd.Samples.from_array(x), []
    stored, expected, read = held.save(tmp_path / "a.zarr"), estimate(held), chd.Samples.read

    def reading(self, *places):
        block = read(self, *places)
        sizes.append(block.shape[:2])
        return block

    monkeypatch.setattr(chd.Samples, "read", reading)
    found = estimate(stored)
    assert np.array_equal(found.radiance, expected.radiance)
    assert np.array_equal(found.low, expected.low)
    assert max(sizes) <= (64, 64)


def test_signed_samples_are_combined_too():
    x = np.random.default_rng(0).normal(0.2, 3, size=(16, 16, 1, 16))
    found = estimate(chd.Samples.from_array(x, axes="yxcs"), progress=False)
    for image in (found.radiance, found.low, found.high):
        assert np.isfinite(image).all()


@pytest.mark.parametrize("shape", [(8, 8, 3, 3), (8, 8, 2, 16), (8, 3, 16)])
def test_what_cannot_be_combined_is_refused(shape):
    with pytest.raises(InputError, match=r"1 or 3 channels, at least 4"):
        combine(np.ones(shape))


def test_the_file_holds_what_each_candidate_was_given(samples, found, tmp_path):
    held = read_exr(write_estimates(tmp_path / "a.exr", samples))
    assert held.attributes["estimator"] == "combination"
    assert np.array_equal(
        held.extra["weight_denoised_shared_shape"], found.weights["denoised shared_shape"]
    )
    assert np.allclose(held.image, found.radiance)


def test_a_network_sees_ratios_only(samples):
    x = samples.read(slice(0, 32), slice(0, 32))
    inputs = compare_halves(Measured.of(chd.Samples.from_array(x)), {})[2]
    scaled = compare_halves(Measured.of(chd.Samples.from_array(x * 256)), {})[2]
    assert np.allclose(inputs, scaled, atol=0.05)
    assert np.isfinite(inputs).all()
    assert Weighting.shipped(with_features=False).centre.shape == inputs.shape[-1:]


def test_bad_samples_of_one_pixel_spoil_no_other_and_make_nothing_certain():
    x = np.random.default_rng(0).gamma(0.5, size=(24, 24, 3, 16)).astype(np.float32)
    x[6, 6, 1], x[12, 12, 0, 0] = np.nan, -np.inf
    x[18, 18, :, 1:], x[18, 18, :, 0] = np.nan, 1000
    found = combine(x)
    assert np.argwhere(np.isnan(found.radiance)).tolist() == [[6, 6, 1]]
    kept = np.isfinite(found.radiance)
    assert np.isfinite(found.high[kept]).all()
    assert (found.low[kept] >= 0).all()  # no finite sample is negative
    assert (found.high - found.low)[kept].min() > 0
    assert (found.radiance[18, 18] < 100).all()  # of a single bright sample, nothing is known
