"""Several scenes: training on all of them, as if each were alone."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive
from chdstat.estimators.held_out import judging_pixels

pytestmark = pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")


def flat(height=24, width=24, spp=64, seed=0):
    """Return an image of one radiance under strong noise: the best estimate is a constant."""
    rng = np.random.default_rng(seed)
    return chd.Samples.from_array(rng.gamma(0.2, 5, (height, width, 1, spp)), scene="flat")


def varied(height=24, width=20, spp=64, seed=1, scale=1.0):
    """Return an image of many radiances under noise that does not tell them apart."""
    rng = np.random.default_rng(seed)
    radiance = rng.lognormal(0, 1.5, (height, width, 1, 1))
    x = scale * radiance * rng.gamma(0.5, 2, (height, width, 1, spp))
    return chd.Samples.from_array(x, scene="varied")


def trained(samples, **options):
    given = options.pop("with_features", False)
    options = {"iterations": 8, "sizes": [8], "progress": False} | options
    return Progressive(with_features=given).train(samples, **options)


@pytest.fixture(scope="module")
def both():
    return trained([flat(), varied()])


# --- training on several ------------------------------------------------------------------------


def test_one_scene_in_a_list_is_that_scene():
    x = flat().read(ss=slice(0, 8))
    alone, listed = trained(flat()), trained([flat()])
    np.testing.assert_array_equal(alone.predict(x), listed.predict(x))


def test_each_scene_counts_in_its_own_unit():
    """A scene that is 1024 times as bright as before teaches the same to the last bit."""
    x = varied(seed=5).read(ss=slice(0, 8))
    plain = trained([flat(), varied()])
    bright = trained([flat(), varied(scale=1024.0)])
    np.testing.assert_array_equal(plain.predict(x), bright.predict(x))


def test_pixels_with_more_samples_than_others_train_by_as_many_and_are_estimated_from_all():
    """What only some pixels have is no bad sample: nothing warns of it."""
    whole = varied(spp=64)
    counts = np.where(np.arange(20) < 10, 16, 64) * np.ones((24, 1), int)
    samples = chd.Samples.from_array(whole.read(), counts=counts, scene="varied")
    model = trained(samples)
    assert model.provenance["pixels_used"] == 24 * 20 // 2
    found = chd.estimate(samples, model=model, progress=False).radiance
    few, many = (model.estimate(whole.first(n)).radiance for n in (16, 64))
    assert np.isfinite(found).all()
    unlike = [np.abs(np.log(found / other)).mean(axis=(0, 2)) for other in (few, many)]
    assert (unlike[0] < unlike[1])[:10].all()
    assert (unlike[1] < unlike[0])[10:].all()


def test_the_scene_with_the_fewest_samples_sets_their_number():
    model = trained([flat(spp=64), varied(spp=16)])
    assert model.provenance["pixels_used"] == 24 * 24 // 2 + 24 * 20 // 2
    with pytest.raises(InputError, match="at least 32 spp, got 16"):
        trained([flat(spp=64), varied(spp=16)], sizes=[16])


def test_seen_pixels_are_told_by_the_shape_of_the_image():
    drawn = [[[0, 0], [1, 2], [3, 4]], [[5, 6], [7, 8]], [[1, 2], [9, 9]]]
    model = trained([flat(), varied(), flat(seed=3)], pixels=drawn)
    assert model.train_pixels_of((24, 24)).tolist() == [[0, 0], [1, 2], [3, 4], [9, 9]]
    assert model.train_pixels_of((24, 20)).tolist() == [[5, 6], [7, 8]]
    assert model.train_pixels_of((8, 8)).shape == (0, 2)
    assert model.train_shape == (24, 24)
    np.testing.assert_array_equal(model.train_pixels, model.train_pixels_of((24, 24)))


def test_a_comparison_leaves_out_what_was_seen_in_any_scene_of_that_shape():
    expected = judging_pixels((24, 24), seed=0)
    one, two, three = np.argwhere(expected)[[3, 50, 70]]
    model = trained([flat(), flat(seed=3)], pixels=[[one, two], [two, three]])
    found = chd.compare(flat(seed=4), ["progressive"], n=8, model=model)
    expected[tuple(np.transpose([one, two, three]))] = False
    np.testing.assert_array_equal(found.test_pixels, expected)


def test_provenance_lists_the_scenes(both):
    scenes = both.provenance["scenes"]
    assert [scene["scene"] for scene in scenes] == ["flat", "varied"]
    assert [scene["samples_shape"] for scene in scenes] == [[24, 24, 1, 64], [24, 20, 1, 64]]
    assert sum(scene["pixels_used"] for scene in scenes) == both.provenance["pixels_used"]
    assert repr(both) == "<Progressive scene 'flat, varied'>"


def test_pixels_with_a_bad_sample_are_left_out_of_their_own_scene():
    bad = flat().read()
    bad[0, :12, 0, 3] = np.nan
    every = np.argwhere(np.ones((24, 24), bool))
    model = trained([chd.Samples.from_array(bad), flat()], pixels=[every, every])
    assert [s["pixels_used"] for s in model.provenance["scenes"]] == [24 * 24 - 12, 24 * 24]
    assert model.provenance["pixels_excluded"] == 12


@pytest.mark.parametrize(
    ("images", "options", "words"),
    [
        ([], {}, "at least one image"),
        ([flat(), varied()], {"pixels": [[[0, 0], [1, 1]]]}, "each of 2 images, got 1"),
        (
            [flat(), chd.Samples.from_array(np.ones((8, 8, 3, 64)))],
            {},
            r"same channels, got \[1, 3\]",
        ),
        ([flat(), varied()], {"with_features": True}, "no first-hit features"),
    ],
)
def test_scenes_that_do_not_fit_are_refused(images, options, words):
    with pytest.raises(InputError, match=words):
        trained(images, **options)


def test_scenes_with_different_features_are_refused():
    rng = np.random.default_rng(0)
    x, depth = rng.exponential(size=(8, 8, 1, 64)), np.ones((8, 8))
    one = chd.Samples.from_array(x, features={"depth": depth})
    two = chd.Samples.from_array(x, features={"depth": depth, "albedo": np.ones((8, 8, 3))})
    with pytest.raises(InputError, match="same numbers of the first hit"):
        trained([one, two], with_features=True)


# --- files ---------------------------------------------------------------------------------------


def test_a_saved_model_is_the_same(both, tmp_path):
    x = varied(seed=7).read(ss=slice(0, 8))
    both.save(tmp_path / "model.safetensors")
    loaded = Progressive.load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(loaded.predict(x), both.predict(x))
    assert loaded.provenance == both.provenance
    np.testing.assert_array_equal(loaded.train_pixels_of((24, 20)), both.train_pixels_of((24, 20)))
