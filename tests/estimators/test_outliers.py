"""Outliers: the formulas of their authors sample by sample, and what they do to fireflies."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from chdstat import estimators
from chdstat.estimators.outliers import BASE, LAYERS, layer_weights
from tests.luminance import LUMINANCE

BRIGHTNESS = BASE ** np.arange(LAYERS)


def image(seed=0, shape=(4, 5, 3, 32)):
    return np.random.default_rng(seed).lognormal(0, 2.5, size=shape)


def test_every_sample_counts_as_one():
    level = np.geomspace(1, BASE ** (LAYERS + 2), 10_001)
    counted = (layer_weights(level) * level[:, np.newaxis] / BRIGHTNESS).sum(axis=-1)
    assert np.abs(counted - 1).max() < 1e-12


def test_below_the_lowest_layer_and_above_the_top_one():
    assert layer_weights([0.0, 1e-310, 0.5]).tolist() == [[1, 0, 0, 0, 0, 0]] * 3
    top = BRIGHTNESS[-1]
    assert layer_weights([16 * top])[0] == pytest.approx([0, 0, 0, 0, 0, 1 / 16], abs=1e-15)


def split_by_hand(x):
    """Return layers (y, x, layer, channel), one sample after the other."""
    height, width, channels, n = x.shape
    layers = np.zeros((height, width, LAYERS, channels))
    for y, column, s in np.ndindex(height, width, n):
        colour = x[y, column, :, s]
        level = float(LUMINANCE @ colour)
        lower = int(np.clip(np.floor(np.log(level) / np.log(BASE)), 0, LAYERS - 2))
        if level < 1:
            w_lo, w_hi = 1.0, 0.0
        elif level > BRIGHTNESS[-1]:
            w_lo, w_hi = 0.0, BRIGHTNESS[-1] / level
        else:
            w_lo = (BRIGHTNESS[lower] / level - 1 / BASE) / (1 - 1 / BASE)
            w_hi = 1 - w_lo
        layers[y, column, lower] += w_lo * colour / n
        layers[y, column, lower + 1] += w_hi * colour / n
    return layers


def resolve_by_hand(layers, n, kappa, radius):
    height, width, _, channels = layers.shape
    result = np.zeros((height, width, channels))

    def reliability(y, column, i, r):
        total = 0.0
        for dy in range(-r, r + 1):
            for dx in range(-r, r + 1):
                here = layers[min(max(y + dy, 0), height - 1), min(max(column + dx, 0), width - 1)]
                s = n / (kappa * BASE**i)
                colour = s * here[i]
                colour = colour + (s * BASE * here[i - 1] if i > 0 else 0)
                colour = colour + (s / BASE * here[i + 1] if i + 1 < LAYERS else 0)
                total += LUMINANCE @ colour
        return total / (2 * r + 1) ** 2

    for y, column in np.ndindex(height, width):
        accepted = np.zeros(channels)
        for i in range(LAYERS):
            s = n / (kappa * BASE**i)
            reliable = reliability(y, column, i, radius) - 1 / kappa
            if reliable >= 0:
                reliable = reliability(y, column, i, 0) - 1 / kappa
            aim = min(max(1 / kappa, 0), 1)
            slack = (1 + 0.6 * (BASE - 1)) * (1 - aim) + aim
            bright = max(LUMINANCE @ accepted, 0.05) * s * slack
            accepted = accepted + np.clip((reliable + bright) / 2, 0, 1) * layers[y, column, i]
        result[y, column] = accepted
    return result


@pytest.mark.parametrize("kappa", [0.3, 1.0, 4.0, 32.0])
@pytest.mark.parametrize("radius", [0, 1])
def test_layers_are_the_authors_formulas(kappa, radius):
    x = image()
    found = (estimators.zirr2018 if radius else estimators.zirr2018_pixel)(x, kappa=kappa, unit=1.0)
    expected = resolve_by_hand(split_by_hand(x), 32, kappa, radius)
    assert found == pytest.approx(expected, rel=1e-5)  # luminance weights have float32 digits


def test_kappa_sweeps_from_the_mean_to_the_dark():
    x = np.minimum(image(1), 1e3)
    kappas = np.geomspace(1e-12, 1e3, 16)
    sweep = np.stack([estimators.zirr2018(x, kappa=k, unit=1.0) for k in kappas], axis=-1)
    assert sweep[..., 0] == pytest.approx(x.mean(axis=-1), rel=1e-9)  # kappa <= 1e-6: off
    assert (np.diff(sweep.mean(axis=(0, 1, 2))) <= 0).all()
    assert sweep[..., -1].mean() < 0.5 * x.mean()


def test_the_unit_makes_thresholds_relative():
    x = image(2)
    found = estimators.zirr2018(x, unit=3.0)
    assert estimators.zirr2018(x / 3.0, unit=1.0) * 3.0 == pytest.approx(found, rel=1e-12)
    assert estimators.zirr2018(x) != pytest.approx(found, rel=1e-3)


def scattered(seed=0, shape=(6, 7, 3, 5)):
    return np.random.default_rng(seed).lognormal(0, 1.5, size=shape)


@pytest.mark.parametrize("radius", [0, 1, 2, 3])
@pytest.mark.parametrize("neighbours", [1, 4])
def test_samples_with_near_neighbours_are_kept(radius, neighbours):
    x = scattered(shape=(6, 7, 3, 8))
    y, column, _ = np.indices((6, 7, 8))
    colours = np.log(np.moveaxis(x, 2, -1) + 0.01) / (1.2 * np.sqrt(3))
    places = np.stack([y, column], axis=-1) / (radius + 1)
    points = np.concatenate([places, colours], axis=-1).reshape(-1, 5)
    near = (cdist(points, points) < 1).sum(axis=1) > neighbours
    stays = near.reshape(6, 7, 8)
    assert 0 < stays.mean() < 1
    some = stays.any(axis=-1)
    expected = (x * stays[:, :, np.newaxis]).sum(axis=-1)[some] / stays.sum(axis=-1)[some][:, None]
    found = estimators.decoro2010(x, neighbours=neighbours, bandwidth=1.2, radius=radius, unit=1.0)
    assert found[some] == pytest.approx(expected, rel=1e-12)
    assert found[~some] == pytest.approx(x[~some].mean(axis=-1), rel=1e-12)


def test_dim_samples_are_no_outliers():
    x = np.ones((3, 3, 3, 8))
    x[..., :4] = 0
    x[1, 1, :, 0] = 1e-4
    expected = x.mean(axis=-1)
    assert estimators.decoro2010(x) == pytest.approx(expected, rel=1e-12)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_bad_samples_confirm_nothing_and_are_left_out():
    x = np.ones((3, 3, 3, 8))
    x[1, 1, :, 0] = 900.0
    x[:, :, 1, 1] = np.nan
    assert estimators.decoro2010(x) == pytest.approx(1)


def test_the_average_is_that_of_the_formula():
    x = np.random.default_rng(0).gamma(0.5, size=(4, 5, 1, 16))
    weight = 1 / (1 + x / 0.7)
    expected = (x * weight).sum(axis=-1) / weight.sum(axis=-1)
    assert estimators.karis2013(x, unit=0.7) == pytest.approx(expected, rel=1e-12)


def test_all_channels_of_a_sample_have_one_weight():
    x = np.array([[1.0, 900.0], [1.0, 0.0], [1.0, 0.0]])
    red, green, blue = estimators.karis2013(x, unit=1.0)
    assert green == blue < 1 < red


def test_samples_above_the_limit_keep_their_colour():
    x = np.array([[1.0, 40.0], [1.0, 20.0], [1.0, 0.0]])
    assert estimators.clamped(x, unit=1.0) == pytest.approx([5.5, 3.0, 0.5])
    assert estimators.clamped(x, unit=1.0, limit=100) == pytest.approx(x.mean(axis=-1))
    assert estimators.clamped(3 * x, unit=3.0) == pytest.approx([16.5, 9.0, 1.5])
