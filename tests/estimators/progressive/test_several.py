"""Several scenes: training on all, and trust in a foreign model."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.estimators import Progressive, Stream
from chdstat.estimators.progressive.error_model import ERROR_TERMS
from chdstat.estimators.progressive.shrinkage import moves_between, shrinkage_factor
from chdstat.estimators.training import read_model, write_model
from chdstat.estimators.validation import judging_pixels


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
    inputs = options.pop("inputs", [])
    options = {"iterations": 8, "sizes": [8], "progress": False} | options
    return Progressive(inputs=inputs).train(samples, **options)


@pytest.fixture(scope="module")
def both():
    return trained([flat(), varied()])


@pytest.fixture(scope="module")
def foreign():
    return trained(flat(), iterations=200)


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


def test_both_scenes_teach():
    x = varied(seed=5).read(ss=slice(0, 8))
    both, one = (trained(scenes).predict(x, trust=1.0) for scenes in ([flat(), varied()], flat()))
    assert not np.array_equal(both, one)


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
        ([flat(), varied()], {"reference": False, "sizes": None}, "give the one image"),
        ([flat(), varied()], {"pixels": [[[0, 0], [1, 1]]]}, "each of 2 images, got 1"),
        (
            [flat(), chd.Samples.from_array(np.ones((8, 8, 3, 64)))],
            {},
            r"same channels, got \[1, 3\]",
        ),
        ([flat(), varied()], {"inputs": ["features"]}, "no first-hit features"),
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
        trained([one, two], inputs=["features"])


# --- files ---------------------------------------------------------------------------------------


def test_a_saved_model_is_the_same(both, tmp_path):
    x = varied(seed=7).read(ss=slice(0, 8))
    both.save(tmp_path / "model.safetensors")
    loaded = Progressive.load(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(loaded.predict(x), both.predict(x))
    assert loaded.provenance == both.provenance
    np.testing.assert_array_equal(loaded.train_pixels_of((24, 20)), both.train_pixels_of((24, 20)))


def test_a_file_whose_pixels_do_not_fit_its_scenes_is_refused(both, tmp_path):
    path = tmp_path / "model.safetensors"
    both.save(path)
    arrays, about = read_model(path)
    write_model(path, arrays | {"train_pixels": arrays["train_pixels"][1:]}, about)
    with pytest.raises(StoreError, match="does not hold a whole network"):
        Progressive.load(path)


# --- trust --------------------------------------------------------------------------------------


def share_of(samples, estimate):
    """Return how far a foreign estimate is followed, measured between halves of samples."""
    halves = samples[..., 0::2], samples[..., 1::2]
    return shrinkage_factor(
        [
            moves_between(half, estimate(half), other, unit=1.0)
            for half, other in zip(halves, halves[::-1], strict=True)
        ]
    )


@pytest.mark.parametrize("bias", [0.0, 0.2, 1.0])
def test_the_paying_share_is_that_of_theory(bias):
    """With variance v of the mean of a half, and an estimate y + b: v / (v + b^2), 0 below 0.2.

    It is the least of several shares, as errors are weighed by several powers of the radiance; that
    for relative errors presumes more dark pixels than there are, so that it is safe.
    """
    rng = np.random.default_rng(0)
    x = rng.gamma(2, 0.5, (40_000, 1, 16))
    variance = 0.5 / 8
    found = share_of(x, lambda half: np.full(half.shape[:-1], 1 + bias))
    expected = variance / (variance + bias**2)
    assert 0.5 * expected < found < expected + 0.01 or (found == 0 and expected < 0.2)


@pytest.mark.parametrize("bias", [-0.9, -0.3, 0.05, 0.2, 0.5, 3.0])
def test_the_mixture_at_all_samples_is_better_than_the_mean(bias):
    """The law of the module: trust is measured at half the samples, and pays at all of them.

    The expected error of the mixture is exact, so that only the share itself is random, with a
    standard error of 1 % of it; it must be off by more than its gain is large.
    """
    rng = np.random.default_rng(0)
    x = rng.gamma(2, 0.5, (40_000, 1, 16))
    variance = 0.5 / 16
    share = share_of(x, lambda half: np.full(half.shape[:-1], 1 + bias))
    assert (1 - share) ** 2 * variance + (share * bias) ** 2 <= variance


def test_what_pays_by_chance_alone_is_mostly_left_alone():
    """Moves at random: one standard error is passed with probability 0.16, in 100 images by 30
    with probability below 1e-3, and half of them would move without it.
    """
    rng = np.random.default_rng(0)
    moved = 0
    for _ in range(100):
        x = rng.gamma(2, 0.5, (500, 1, 8))
        moved += share_of(x, lambda half: half.mean(axis=-1) + rng.normal(size=half.shape[:-1])) > 0
    assert moved < 30


def test_what_moves_nothing_or_the_wrong_way_is_not_trusted():
    x = varied().read()
    assert share_of(x, lambda half: half.mean(axis=-1)) == 0
    # Away from where the other half will be: twice as far from the middle of the image.
    assert share_of(x, lambda half: 2 * half.mean(axis=-1)) == 0


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_trust_does_not_depend_on_the_unit_or_on_bad_pixels(foreign):
    x = varied().read(ss=slice(0, 16))
    for loss_weight in (0, 1):
        found = foreign.trust(x, loss_weight=loss_weight)
        assert foreign.trust(x * np.float32(2**-30), loss_weight=loss_weight) == found
    broken = np.concatenate([x, np.full_like(x[:1], np.nan)])
    assert foreign.trust(broken, unit=3.0) == pytest.approx(foreign.trust(x, unit=3.0))


@pytest.mark.parametrize("n", [1, 4, 16])
@pytest.mark.parametrize("loss_weight", [0, 0.5, 1])
def test_a_foreign_model_is_no_worse_than_the_mean(foreign, loss_weight, n):
    """One that learned a constant is much worse when it is followed: the negative control."""
    scene = varied(height=48, width=48, spp=512, seed=3)
    x, truth = scene.read(ss=slice(0, n)), scene.read().mean(axis=-1, dtype=np.float64)
    followed, found = (foreign.predict(x, loss_weight=loss_weight, trust=t) for t in (1.0, None))
    worse = []
    for power in (0, 1):
        weight = (truth**2 + 0.01 * truth.mean() ** 2) ** -float(power)
        of_mean, without, ours = (
            (weight * (estimate - truth) ** 2).mean()
            for estimate in (x.mean(axis=-1), followed, found)
        )
        worse.append(without > 1.1 * of_mean)
        assert ours < 1.02 * of_mean
    assert any(worse) or n < 16


def test_a_model_is_followed_as_far_from_a_store_a_stream_and_an_array(foreign):
    """All ways to estimate with a model of another scene are guarded alike."""
    scene = varied(height=48, width=48, spp=16, seed=3)
    x = scene.read()
    expected = foreign.predict(x)
    np.testing.assert_array_equal(chd.estimate(scene, foreign, progress=False).radiance, expected)
    np.testing.assert_array_equal(foreign.estimate(x).radiance, expected)
    stream = Stream(foreign)
    stream.update(x)
    # Means of octaves tell a little less of the noise than two means of samples do.
    np.testing.assert_allclose(stream.estimate().radiance, expected, rtol=0.1)
    plain = foreign.predict(x, trust=1.0)
    assert abs(stream.estimate(trust=1.0).radiance - plain).max() < 1e-3 * plain.mean()


def test_a_model_of_the_same_kind_of_scene_is_trusted(foreign):
    x = flat(height=48, width=48, seed=9).read(ss=slice(0, 16))
    assert foreign.trust(x, loss_weight=0) > 0.8
    assert ((foreign.predict(x) - 1) ** 2).mean() < 0.7 * ((x.mean(axis=-1) - 1) ** 2).mean()


@pytest.mark.parametrize("loss_weight", [0.0, 0.5, 1.0])
def test_the_interval_of_a_model_that_is_not_followed_is_not_narrower_than_the_means(
    foreign, loss_weight, tmp_path
):
    """What it expects of its own errors may rest on how far it moves, and here it does not."""
    x = varied(seed=7).read(ss=slice(0, 16))
    foreign.save(tmp_path / "a.safetensors")
    arrays, about = read_model(tmp_path / "a.safetensors")
    arrays["spread.weights"] = np.tile(np.eye(ERROR_TERMS)[2], (2, 1))
    write_model(tmp_path / "b.safetensors", arrays, about)
    model = Progressive.load(tmp_path / "b.safetensors")
    found = model.estimate(x, loss_weight=loss_weight, trust=0.0)
    error = x.std(axis=-1, ddof=1) / 4
    assert np.median((found.high - found.low) / error) > 2.5


def test_trust_mixes_with_the_mean(both):
    x = varied(seed=7).read(ss=slice(0, 8))
    mean = x.mean(axis=-1)
    whole, half, none = (both.estimate(x, trust=t) for t in (1.0, 0.5, 0.0))
    np.testing.assert_allclose(none.radiance, mean, rtol=1e-5)
    np.testing.assert_allclose(half.radiance, (whole.radiance + mean) / 2, rtol=1e-4)
    assert (whole.certainty / 2 - 1e-6 <= half.certainty).all()
    assert (half.certainty <= whole.certainty).all()
    assert not none.certainty.any()
    assert (none.low <= none.high).all()
    # Where the mean alone counts, its noise still makes an interval.
    assert (none.high - none.low).mean() > 0.1 * mean.mean()


def test_an_image_is_measured_and_a_part_of_one_is_not(both):
    x = varied(seed=7).read(ss=slice(0, 8))
    share = both.trust(x, loss_weight=0)
    assert 0 <= share <= 1
    np.testing.assert_array_equal(
        both.predict(x, loss_weight=0), both.predict(x, loss_weight=0, trust=share)
    )
    np.testing.assert_array_equal(
        both.predict(x, loss_weight=0, unit=1.0),
        both.predict(x, loss_weight=0, unit=1.0, trust=1.0),
    )


def test_trust_out_of_range_is_refused_and_few_samples_tell_nothing(both):
    x = varied().read(ss=slice(0, 3))
    assert both.trust(x) == 0
    for wrong in (1.5, -0.1, np.nan):
        with pytest.raises(InputError, match=r"between 0 and 1, or be None, got"):
            both.predict(x, trust=wrong)
    with pytest.raises(InputError, match="loss_weight must lie"):
        both.trust(x, loss_weight=2)
