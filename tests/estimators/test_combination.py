"""Combination: weights of candidates per pixel, their intervals, and what is told of them."""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import InputError, LeftOutWarning
from chdstat.estimators import (
    Combination,
    CombinationStream,
    estimate,
)
from chdstat.estimators.default_estimate import candidates as halves
from chdstat.estimators.default_estimate import weighting_network as network
from chdstat.estimators.default_estimate.candidates import Measured, candidates, through_denoiser
from chdstat.estimators.default_estimate.light import lost_light
from chdstat.estimators.default_estimate.weighting_network import (
    LEVELS,
    WeightingNetwork,
    comparisons,
    unit_of,
)
from chdstat.estimators.default_estimate.weights import Proposal, weight_of_mean
from chdstat.estimators.registry import interval_of_mean
from chdstat.io import read_exr, write_estimates
from chdstat.rendering.backend import probe
from tests.luminance import relative_error


@pytest.fixture(scope="module")
def samples():
    return chd.render("bathroom", spp=64, size=(64, 64), seed=3, backend="scalar", progress=False)


@pytest.fixture(scope="module")
def found(samples):
    return estimate(samples)


@pytest.fixture(scope="module")
def reference():
    backend = "llvm" if probe("llvm").works else "scalar"  # which takes twice as long
    rendered = chd.render(
        "bathroom", spp=256, size=(64, 64), seed=4, backend=backend, progress=False
    )
    x = rendered.read().astype(np.float64)
    return x.mean(axis=-1), x.std(axis=-1, ddof=1) / np.sqrt(256)


def test_each_candidate_has_its_share(samples, found):
    total = sum(weight.astype(np.float64) for weight in found.weights.values())
    assert np.allclose(total, 1, atol=1e-5)
    assert min(weight.min() for weight in found.weights.values()) >= 0
    assert np.allclose(found.certainty, 1 - found.weights["mean"], atol=1e-6)
    measured = Measured.of(samples)
    made = candidates(measured.starts[0], samples.features)
    assert made.keys() == found.weights.keys()
    mixed = sum(found.weights[name][..., np.newaxis] * made[name] for name in made)
    # Weights of channels differ from their average, and light is given back, of rooms by little.
    apart = np.abs(found.radiance / measured.unit - mixed) / np.maximum(mixed, 1e-4)
    assert np.median(apart) < 0.01
    assert np.quantile(apart, 0.95) < 0.05


def rare_light(part, events):
    """Return an image, and what `lost_light` takes, that lacks as much light as it has.

    Rare samples have that light. They fall on `part` of the image, from the left; the others vary
    by a tenth.
    """
    image = np.linspace(0.5, 1.5, 64)[:, np.newaxis, np.newaxis] * np.ones((64, 64, 3))
    lit = np.broadcast_to(np.arange(64) < 64 * part, (64, 64))
    rng, each = np.random.default_rng(1), 64 * 64 / events * image
    one, other = rng.poisson(lit * events / lit.sum(), (2, 64, 64))[..., np.newaxis]
    parts = [
        Proposal(image, image + found * each, np.hypot(np.sqrt(found) * each, 0.1 * image))
        for found in ((one + other) / 2, one, other)
    ]
    return image, (parts, [image] * 3, [np.ones_like(image)] * 3)


def test_rare_light_that_may_be_anywhere_is_given_back():
    image, asked = rare_light(part=1, events=4000)
    (given, *_), error = lost_light(*asked)
    assert 0.7 < given.mean() / image.mean() <= 1
    assert np.quantile(error / image, 0.9) < 0.4  # of what is lost, most is known


def test_light_of_one_place_is_given_to_no_other():
    image, asked = rare_light(part=1 / 16, events=400)
    given = lost_light(*asked)[0][0] / image
    assert given[:, 48:].max() < 0.026  # a quarter of the standard error
    assert given[:, :4].mean() > 5  # of 16


def test_light_of_one_half_is_given_to_none():
    x = np.random.default_rng(8).exponential(0.1, size=(64, 64, 3, 16))
    before = estimate(x).radiance
    x[20, 30, :, ::4] = 500  # four samples of a lamp, all of them even
    after = estimate(x).radiance
    assert np.median(after / before) == pytest.approx(1, abs=0.015)


def test_noise_and_certainty_get_nothing():
    image, asked = rare_light(part=1, events=2)
    assert (lost_light(*asked)[0][0] < 1e-3 * image).all()
    image, (parts, estimates, moved) = rare_light(part=1, events=4000)
    moved = [np.where(np.arange(64)[:, np.newaxis, np.newaxis] < 8, 0, one) for one in moved]
    for part in parts:
        part.mean[32:], part.error[32:] = image[32:], 1e-6
    given = lost_light(parts, estimates, moved)[0][0] / image
    assert (given[:8] == 0).all()
    assert np.abs(given[45:]).max() < 1e-2 < given[20].min()


def test_an_image_that_is_its_mean_lacks_nothing():
    image = np.ones((40, 33, 3))
    parts = [Proposal(image, image, 0.3 * image) for _ in range(3)]
    (given, *_), _ = lost_light(parts, [image] * 3, [np.ones_like(image)] * 3)
    assert (given == 0).all()


def quiet_and_loud(quiet, channel=None, n=64):
    """Return truth, samples, and where they have little noise: a half, or all but a channel."""
    rng = np.random.default_rng(4)
    texture = np.exp(0.5 * rng.normal(size=(48, 48)))
    loud = np.zeros((48, 48, 3), bool)
    if channel is None:
        loud[:, :24] = True
    else:
        loud[..., channel] = True
    truth = 0.4 * np.where(loud, 1, texture[..., np.newaxis]) * np.array((1, 0.8, 0.6))
    rare = np.where(rng.random((48, 48, 1, n)) < 0.05, 20 * rng.exponential(size=(48, 48, 1, n)), 0)
    calm = 1 + quiet * rng.normal(size=(48, 48, 1, n))
    return truth, truth[..., np.newaxis] * np.where(loud[..., np.newaxis], rare, calm), ~loud


@pytest.mark.parametrize("channel", [None, 0, 2])
@pytest.mark.parametrize("quiet", [0.01, 0.1])
def test_loud_pixels_do_not_speak_for_quiet_ones(quiet, channel):
    """They made squared errors up to 2,500 times as large."""
    truth, x, calm = quiet_and_loud(quiet, channel)
    found = estimate(x)
    error, of_mean = (np.square(image - truth) for image in (found.radiance, x.mean(axis=-1)))
    assert error[calm].mean() < 1.1 * of_mean[calm].mean()
    assert error[~calm].mean() < 0.25 * of_mean[~calm].mean()
    inside = (found.low <= truth) & (truth <= found.high)
    assert inside[calm].mean() > 0.85


@pytest.mark.parametrize("n", [8, 64])
def test_what_is_known_exactly_is_the_estimate(n):
    rng = np.random.default_rng(1)
    x = np.where(rng.random((48, 48, 3, n)) < 0.05, 6 * rng.exponential(size=(48, 48, 3, n)), 0)
    exact = np.zeros((48, 48, 3), bool)
    exact[5::8, 3::8] = exact[:12] = exact[30:40, 30:40, 1] = True
    x[exact] = 2.0
    found = estimate(x)
    assert (found.radiance[exact] == 2).all()
    assert ((found.low <= 2) & (found.high >= 2))[exact].all()


def test_equal_by_chance_is_not_certain():
    truth = np.full((48, 48, 1), 0.9)
    x = np.where(np.random.default_rng(2).random((48, 48, 1, 8)) < truth[..., np.newaxis], 1.0, 0.0)
    found = estimate(x)
    equal = (x == 1).all(axis=-1)
    assert (found.radiance[equal] == 1).all()
    assert ((found.low <= truth) & (truth <= found.high))[equal].mean() > 0.5


def test_the_weight_of_the_mean_falls_with_its_noise():
    rng = np.random.default_rng(3)
    noise = np.geomspace(0.01, 3, 96)[np.newaxis, :, np.newaxis] * np.ones((96, 1, 1))
    detail = 0.3 * rng.normal(size=noise.shape)
    halves = [1 + detail + noise * rng.normal(size=noise.shape) for _ in range(2)]
    means, errors = [sum(halves) / 2, *halves], [noise / np.sqrt(2), noise, noise]
    image = np.ones(noise.shape)
    parts = [Proposal(image, m, e) for m, e in zip(means, errors, strict=True)]
    weight = next(weight_of_mean(*parts)).mean(axis=(0, 2))
    best = 0.09 / (0.09 + noise[0, :, 0] ** 2 / 2)
    assert weight == pytest.approx(best, abs=0.2)
    assert np.mean(np.abs(weight - best)) < 0.08
    assert np.corrcoef(np.argsort(np.argsort(-weight)), np.arange(96))[0, 1] > 0.9


def test_it_is_better_than_the_mean_and_than_a_denoiser(samples, found, reference):
    truth, _ = reference
    measured = Measured.of(samples)
    made = candidates(measured.starts[0], samples.features)
    made = {name: image * measured.unit for name, image in made.items()}
    weight = 1 / (truth**2 + 0.01 * truth.mean() ** 2)

    def errors(image):
        squared = (image - truth) ** 2
        return np.array([squared.mean(), (squared * weight).mean()])

    denoised = min((errors(made[n]) for n in ("denoised", "denoised with features")), key=np.prod)
    assert (errors(found.radiance) < 0.6 * errors(made["mean"])).all()
    assert (errors(found.radiance) < 1.1 * denoised).all()


def test_intervals_hold_the_reference(samples, found, reference):
    truth, error = reference
    noisier = truth + error * np.random.default_rng(0).standard_normal(truth.shape)
    inside, less = (np.mean((found.low <= y) & (y <= found.high)) for y in (truth, noisier))
    # As much noise again as the reference has tells what it took (simulation extrapolation).
    assert 0.8 < 2 * inside - less < 0.97
    widths = [np.mean(estimate(samples, level=level).high) for level in (0.4, *LEVELS, 0.995)]
    assert (np.diff(widths) > 0).all()


def test_widths_are_those_of_thirds_of_brightness():
    steps = np.arange(1, 6) * np.array([[1.0], [2.0], [4.0]])
    weighting = WeightingNetwork([], np.zeros(1), np.ones(1), steps)
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


def test_the_order_of_samples_makes_no_difference(samples):
    x = samples.read()
    shuffled = chd.estimators.combination(x[..., ::-1])
    assert np.array_equal(chd.estimators.combination(x), shuffled)


def test_a_black_image_stays_black():
    black = estimate(np.zeros((8, 8, 3, 16)))
    assert (black.radiance == 0).all()
    assert np.isnan(black.bias)


def test_a_lamp_that_many_samples_find_is_no_firefly():
    rng = np.random.default_rng(0)
    x = rng.exponential(0.02, size=(48, 48, 3, 64)).astype(np.float32)
    x[20, 20, :, rng.random(64) < 0.3] = 500  # the edge of a lamp
    x[30, 30, :, 5] = 500  # a firefly
    found = estimate(x).radiance
    assert (found[20, 20] > 40).all()
    assert (found[30, 30] < 4).all()


def test_it_is_denoised_as_far_as_samples_agree(samples, found):
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
    least = estimate(x).least
    for pixel, good in (((4, 5), 4), ((9, 9), 32)):
        kept = x[pixel][:, :good].astype(np.float64)
        error = kept.std(axis=-1, ddof=1) / np.sqrt(good)
        expected = kept.mean(axis=-1) - stats.t(good - 1).isf(0.001) * error
        assert least[pixel] == pytest.approx(expected, rel=1e-5)


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


def test_the_file_holds_what_each_candidate_was_given(samples, found, tmp_path):
    held = read_exr(write_estimates(tmp_path / "a.exr", samples))
    assert held.attributes["estimator"] == "combination"
    assert np.array_equal(
        held.extra["weight_denoised_shared_shape"], found.weights["denoised shared_shape"]
    )
    assert np.allclose(held.image, found.radiance)


def test_a_network_sees_ratios_only(samples):
    x = samples.read(slice(0, 32), slice(0, 32))

    def seen(x):
        measured = Measured.of(chd.Samples.from_array(x))
        made = [candidates(start, {}) for start in measured.starts]
        return comparisons(made, measured, unit_of(made[0]))

    inputs, scaled = seen(x), seen(x * 256)
    assert np.allclose(inputs, scaled, atol=0.05)
    assert np.isfinite(inputs).all()
    assert WeightingNetwork.shipped(with_features=False).centre.shape == inputs.shape[-1:]


def test_bands_of_rows_are_parts_of_the_whole(monkeypatch):
    x = np.random.default_rng(0).gamma(0.5, size=(128, 8, 3, 16)).astype(np.float32)
    x[60:70] *= 40
    at_once = estimate(x)
    monkeypatch.setattr(halves, "_BAND", 30 * 8 * 3)
    monkeypatch.setattr(network, "_BAND", 20 * 8)
    in_bands = estimate(x)
    for name in ("radiance", "low", "high", "certainty"):
        # Matrix products of other shapes round otherwise.
        assert np.allclose(getattr(at_once, name), getattr(in_bands, name), atol=1e-4)


def test_bad_samples_make_nothing_certain():
    x = np.random.default_rng(0).gamma(0.5, size=(24, 24, 3, 16)).astype(np.float32)
    x[6, 6, 1], x[12, 12, 0, 0] = np.nan, -np.inf
    x[18, 18, :, 1:], x[18, 18, :, 0] = np.nan, 1000
    found = estimate(x)
    assert np.argwhere(np.isnan(found.radiance)).tolist() == [[6, 6, 1]]
    kept = np.isfinite(found.radiance)
    assert np.isfinite(found.high[kept]).all()
    assert (found.low[kept] >= 0).all()  # no finite sample is negative
    assert (found.high - found.low)[kept].min() > 0
    assert (found.radiance[18, 18] < 100).all()  # of a single bright sample, nothing is known


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_lost_pixels_spoil_no_others(share):
    """As black holes in what is denoised, they made errors 20 times as large."""
    x = np.random.default_rng(1).exponential(size=(48, 48, 3, 32)).astype(np.float32)
    lost = np.random.default_rng(2).random((48, 48)) < share
    x[lost] = np.nan
    with pytest.warns(LeftOutWarning, match="left out"):
        found = estimate(x)
    mean = x[~lost].mean(axis=-1)
    assert np.array_equal(np.isnan(found.radiance).all(axis=-1), lost)
    assert np.square(found.radiance[~lost] - 1).mean() < 0.08 * np.square(mean - 1).mean()
    assert ((found.low <= 1) & (found.high >= 1))[~lost].mean() > 0.85


def exponential(truth, n, seed):
    return truth[..., np.newaxis] * np.random.default_rng(seed).exponential(size=(*truth.shape, n))


def images_that_refute_a_prior():
    """Yield the name, the truth and the samples of images whose detail is no noise."""
    rng = np.random.default_rng(2)
    y, x = np.indices((48, 48))
    glints = np.where(rng.random((48, 48)) < 0.01, 30.0, 0.1)
    lamp = np.where((y == 20) & (x == 30), 50.0, 0.1)
    for name, truth in {
        "glints": glints,
        "lamp": lamp,
        "checker": np.where((x + y) % 2, 1.0, 0.1),
        "white noise": rng.uniform(0.05, 1, (48, 48)),
        "lines": np.where(x % 7 == 0, 1.0, 0.1),
    }.items():
        yield name, np.repeat(truth[..., np.newaxis], 3, axis=2)


def test_a_negative_image_has_its_radiance():
    x = -np.random.default_rng(0).exponential(size=(48, 48, 3, 4))
    found = chd.estimate(x, progress=False)
    assert found.radiance.mean() == pytest.approx(-1, abs=0.02)


@pytest.mark.parametrize(("name", "truth"), list(images_that_refute_a_prior()))
def test_detail_is_kept_and_held(name, truth):
    """Before held-out samples were asked, squared errors were 2 to 50 times the mean's."""
    x = exponential(truth, 128, seed=5)
    found, mean = estimate(x), x.mean(axis=-1)
    weight = 1 / (truth**2 + 0.01 * truth.mean() ** 2)
    for w in (1, weight):
        assert (w * (found.radiance - truth) ** 2).mean() <= 1.05 * (w * (mean - truth) ** 2).mean()
    inside = (found.low <= truth) & (truth <= found.high)
    assert inside.mean() > 0.8
    assert inside[truth == truth.max()].mean() > 0.5  # none before


@pytest.mark.parametrize(("n", "most"), [(4, 0.4), (16, 1 / 6), (64, 1 / 6)])
def test_rare_light_of_a_third_comes_back(n, most):
    rng = np.random.default_rng(7)
    level = np.linspace(0.5, 1.5, 64)[:, np.newaxis, np.newaxis] * np.array((1, 0.9, 0.7))
    truth = 1.5 * level * np.ones((64, 64, 3))
    rare = rng.random((64, 64, 1, n)) < 1e-3
    x = level[..., np.newaxis] * rng.exponential(size=(64, 64, 1, n)) * np.where(rare, 500, 1)
    found = estimate(x)
    # 16 events are too few to give much back; of more, at least a half comes back.
    assert abs(found.radiance.mean() / truth.mean() - 1) < most
    assert ((found.low <= truth) & (truth <= found.high)).mean() > 0.85


def test_where_nothing_refutes_it_the_proposal_is_taken():
    truth = np.full((48, 48, 3), 0.4)
    x = exponential(truth, 32, seed=6)
    found = estimate(x)
    assert ((found.radiance - truth) ** 2).mean() < 0.05 * ((x.mean(axis=-1) - truth) ** 2).mean()
    assert found.certainty.mean() > 0.9


@pytest.mark.parametrize("value", [1e8, 1e21, 1e37])
def test_one_absurd_sample_changes_no_other_pixel(samples, value):
    x = samples.read()[..., :16].copy()
    before = estimate(x)
    x[30, 31, :, 7] = value
    after = estimate(x)
    other = np.ones((64, 64), bool)
    other[30, 31] = False
    moved = np.abs(after.radiance - before.radiance)[other]
    assert (moved <= (before.high - before.low)[other] + 1e-4).all()
    assert np.allclose(after.radiance[30, 31], x[30, 31].mean(axis=-1), rtol=1e-5)
    assert np.isfinite(after.low).all()


@pytest.mark.parametrize("unit", [2.0**-100, 2.0**100])
def test_an_image_may_be_in_any_unit(samples, unit):
    x = samples.read()[..., :16]
    first, scaled = estimate(x), estimate(x * np.float32(unit))
    rounding = 0.02 * (first.high - first.low)
    for name in ("radiance", "low", "high"):
        apart = getattr(first, name) - getattr(scaled, name) / np.float32(unit)
        assert (np.abs(apart) <= rounding).all()
    assert scaled.bias == pytest.approx(first.bias, abs=1e-4)


def test_intervals_of_means_hold_skewed_truths():
    # Exact for exponential samples, but for the error that is estimated.
    rng = np.random.default_rng(3)
    x = rng.exponential(size=(4000, 16))
    mean, error = x.mean(axis=-1), x.std(axis=-1, ddof=1) / 4
    count = np.full(4000, 16)
    low, high = interval_of_mean(mean, error, count, 0.9, signed=False)
    missed = np.mean(high < 1), np.mean(low > 1)
    assert max(missed) < 0.09
    student = interval_of_mean(mean, error, count, 0.9, signed=True)[1]
    assert np.mean(student < 1) > missed[0] + 0.02


def test_a_stream_is_what_all_its_samples_are(samples, found):
    x = samples.read()
    stream = CombinationStream(x.shape[:3])
    left, right = slice(0, 21), slice(21, None)
    stream.update(x[:, left, :, :3], columns=left)
    with pytest.raises(InputError, match="as many"):
        stream.update(x[..., :3])
    stream.update(x[:, right, :, :3], columns=right)
    for batch in np.split(x[..., 3:], (13, 30), axis=-1):
        stream.update(batch)
    streamed = stream.estimate(features=samples.features)
    for name in ("radiance", "low", "high", "certainty"):
        assert np.array_equal(getattr(streamed, name), getattr(found, name))
    assert stream.spp == 64
    with pytest.raises(InputError, match=r"\(64, 64, 3"):
        stream.update(x[:5])


def test_the_relative_error_is_about_that_of_the_image(samples, found, reference):
    truth, error = reference
    squared = (found.radiance - truth) ** 2 - error**2
    assert found.relative_error == pytest.approx(relative_error(squared, truth), rel=0.5)


def test_without_the_denoiser_others_are_combined(samples, monkeypatch):
    monkeypatch.setattr(halves, "works", lambda: False)
    x = samples.read()[..., :32].copy()
    x[10, 10, :, 3] = 1e4  # a firefly
    image = chd.Samples.from_array(x, features=samples.features)
    found, mean = estimate(image), x.mean(axis=-1)
    assert found.weights.keys() == {"mean", "shared_shape"}
    assert found.radiance[10, 10].max() < 0.1 * mean[10, 10].max()
    assert np.median(np.abs(found.radiance - mean)) < 0.05 * np.median(mean)
    assert (found.low <= found.radiance).all()
    assert (found.radiance <= found.high).all()


@pytest.mark.parametrize("shape", [(50, 1), (8, 8)])
def test_intervals_of_small_images_hold(shape):
    rng = np.random.default_rng(2)
    held = []
    for _ in range(12):
        found = estimate(rng.exponential(size=(*shape, 3, 16)), level=0.9)
        held.append(((found.low <= 1) & (found.high >= 1)).mean())
    assert np.mean(held) > 0.84  # it was .41 and .81
