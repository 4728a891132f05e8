"""Atlas: regions of one shape are found whatever their brightness, and noise is no shape."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from chdstat.errors import Reason
from chdstat.patterns import Atlas, atlas
from chdstat.samples import Samples
from chdstat.summary.histograms import histogram

EDGE, SPP = 32, 512


def gamma(rng, shape):
    return rng.gamma(2.0, size=shape)


def lognormal(rng, shape):
    return rng.lognormal(sigma=1.0, size=shape)


def bimodal(rng, shape):
    dark = rng.random(shape) < 0.5
    return np.where(dark, rng.lognormal(-3, 0.4, shape), rng.lognormal(1, 0.4, shape))


def heavy(rng, shape):
    return 0.01 + rng.pareto(1.6, size=shape)


KINDS = (gamma, lognormal, bimodal, heavy)


def image(*kinds, seed=0, nulls=0.3, decades=1.0, edge=EDGE, spp=SPP):
    """Return samples of an image in horizontal stripes, one for each kind, and the true stripes.

    Every pixel has a brightness of its own, within some decades of 1.
    """
    rng = np.random.default_rng(seed)
    stripe = np.arange(edge) * len(kinds) // edge
    x = np.concatenate(
        [kind(rng, ((stripe == i).sum(), edge, 1, spp)) for i, kind in enumerate(kinds)]
    )
    x *= 10 ** rng.uniform(-decades, decades, (edge, edge, 1, 1))
    x *= rng.random(x.shape) >= nulls
    return x.astype(np.float32), np.repeat(stripe[:, np.newaxis], edge, axis=1)


def agreement(found, truth):
    return adjusted_rand_score(truth.ravel(), found.labels.ravel())


def find(x, **options):
    return atlas(x, **({"max_clusters": 6} | options))


@pytest.fixture(scope="module")
def scene():
    return image(*KINDS)


@pytest.fixture(scope="module")
def found(scene) -> Atlas:
    return find(Samples.from_array(scene[0]))


@pytest.mark.parametrize("of_histograms", [False, True])
def test_regions_are_found_whatever_their_brightness(scene, found, of_histograms):
    """In a hundred other scenes, four shapes were found each time, with agreements above 0.99."""
    x, truth = scene
    result = find(histogram(Samples.from_array(x))) if of_histograms else found
    assert len(result.share) == 4
    assert agreement(result, truth) >= 0.95
    assert result.stability > 0.9
    # Shapes of about the same share may come in another order.
    one, other = (0.1 * np.cumsum(each.density, axis=-1) for each in (result, found))
    assert (np.abs(one[:, np.newaxis] - other).max(axis=-1).min(axis=-1) < 0.03).all()


@pytest.mark.parametrize("kind", KINDS)
def test_noise_is_no_shape(kind):
    """Of one shape, half the samples predict nothing of the other half beyond the mean shape."""
    x, truth = image(kind, edge=24, spp=128)
    result = find(Samples.from_array(x))
    assert result.share.tolist() == [1]
    assert (result.labels == truth).all()
    assert not (result.explained[1:] >= 0).any()


def test_clusters_beyond_the_shapes_predict_worse(found):
    """The negative control of the rule: the right number predicts best of all."""
    assert found.candidates[found.explained.argmax()] == 4
    assert found.explained[0] == 0
    assert found.explained[3] == pytest.approx(1, abs=0.01)
    assert found.repeatable > 0.9


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**10])
def test_radiance_of_another_scale_has_the_same_atlas(scene, found, factor):
    scaled = find(Samples.from_array(scene[0] * np.float32(factor)))
    np.testing.assert_array_equal(scaled.labels, found.labels)
    np.testing.assert_allclose(scaled.density, found.density, atol=1e-3)
    np.testing.assert_allclose(scaled.scale, factor * found.scale, rtol=1e-9)


def test_the_ends_of_float32_are_radiance_too():
    x, truth = image(gamma, bimodal, decades=0.5, edge=16)
    for factor in (1e-37, 1e30):
        assert agreement(find(Samples.from_array((x * factor).astype(np.float32))), truth) == 1


def test_moved_histograms_have_equal_shapes():
    x, _ = image(gamma, bimodal, decades=0.5, edge=16)
    counted = histogram(Samples.from_array(x))
    assert (counted["log_counts"][..., -20:] == 0).all()
    moved = counted.assign(log_counts=counted["log_counts"].roll(log_bin=20, roll_coords=False))
    one, other = find(counted), find(moved)
    np.testing.assert_array_equal(other.labels, one.labels)
    np.testing.assert_allclose(other.density, one.density, atol=1e-6)
    np.testing.assert_allclose(other.scale, 100 * one.scale, rtol=1e-9)


def test_pixels_without_a_shape_say_why():
    x, _ = image(gamma, bimodal, edge=16)
    x[0, 0] = 0
    x[1, 1] = 0.25
    x[2, 2] = np.nan
    x[3, 3, :, 31:] = 0
    x[4, 4] = np.inf
    x[4, 4, :, 0] = 1
    result = find(Samples.from_array(x))
    expected = {
        (0, 0): Reason.ALL_NULL,
        (1, 1): Reason.CONSTANT,
        (2, 2): Reason.ALL_BAD,
        (3, 3): Reason.TOO_FEW,
        (4, 4): Reason.TOO_FEW,
    }
    for place, reason in expected.items():
        assert result.reason[place] == reason
    missing = result.labels == -1
    assert missing.sum() == len(expected)
    np.testing.assert_array_equal(missing, result.reason != Reason.OK)
    np.testing.assert_array_equal(missing, np.isnan(result.distance))
    assert len(result.share) == 2
    assert result.share.sum() == pytest.approx(1)


@pytest.mark.parametrize("clusters", [None, 3])
def test_an_image_without_shapes_has_an_empty_atlas(clusters):
    result = find(Samples.from_array(np.zeros((3, 4, 3, 16))), clusters=clusters)
    assert result.density.shape == (0, 81)
    assert result.share_interval.shape == result.medoids.shape == (0, 2)
    assert (result.labels == -1).all()
    assert np.isnan(result.stability)
    assert "all null" in str(result)


def test_an_image_of_equal_pixels_has_one_shape():
    x = np.broadcast_to(gamma(np.random.default_rng(0), SPP), (6, 6, 3, SPP))
    assert find(Samples.from_array(x)).share.tolist() == [1]


def test_nulls_are_part_of_the_shape_only_if_asked():
    x, truth = image(gamma, gamma, nulls=0, edge=24)
    x[:12] *= np.random.default_rng(3).random((12, 24, 1, SPP)) > 0.6
    samples = Samples.from_array(x)
    assert len(find(samples).share) == 1
    result = find(samples, nulls=True)
    assert agreement(result, truth) == 1
    np.testing.assert_allclose(np.sort(result.null_share), [0, 0.6], atol=0.02)


def test_rare_shapes_count_from_their_smallest_share_on():
    x, _ = image(gamma, edge=24)
    x[0, :14] = bimodal(np.random.default_rng(5), (14, 1, SPP))
    samples = Samples.from_array(x)
    np.testing.assert_allclose(find(samples).share, [562 / 576, 14 / 576])
    assert len(find(samples, min_share=0.03).share) == 1


def test_the_largest_cluster_comes_first(found):
    assert (np.diff(found.share) <= 0).all()
    np.testing.assert_allclose(found.share, np.bincount(found.labels.ravel()) / EDGE**2)
    assert (found.share_interval[:, 0] < found.share).all()
    assert (found.share_interval[:, 1] > found.share).all()
    for k, (y, x) in enumerate(found.medoids):
        assert found.labels[y, x] == k
        assert found.distance[y, x] == found.distance[found.labels == k].min()


def test_typical_shapes_surround_their_scale(found):
    np.testing.assert_allclose(0.1 * found.density.sum(axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(0.1 * found.density @ found.positions, 0, atol=2e-3)
    low, high = np.moveaxis(found.density_band, -1, 0)
    assert (low <= high).all()
    # A log-normal shape with sigma 1 is Gaussian in decades, with deviation 1 / log(10).
    variances = 0.1 * found.density @ found.positions**2 - 0.1**2 / 12
    assert np.abs(variances - np.log(10) ** -2).min() < 0.01


def test_the_same_seed_gives_the_same_atlas(scene, found):
    again = find(Samples.from_array(scene[0]), seed=0)
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


def test_memory_does_not_grow_with_spp(monkeypatch):
    x, _ = image(gamma, edge=8)
    lengths = []
    read = Samples.read

    def spy(self, *where, **ends):
        block = read(self, *where, **ends)
        lengths.append(block.shape[-1])
        return block

    monkeypatch.setattr(Samples, "read", spy)
    find(Samples.from_array(x))
    assert max(lengths) <= 64
