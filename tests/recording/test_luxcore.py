"""LuxCore as a source of passes, against images that it renders by itself."""

import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

import chdstat as chd
from chdstat.errors import InputError, RenderError, SceneError
from chdstat.recording.luxcore import LuxCoreSource
from chdstat.recording.pass_sources import seed_of_pass
from tests.recording import luxcore_scenes
from tests.recording.scene_renderers import LUXCORE, Sourced, samples_of

pytestmark = pytest.mark.skipif(bool(LUXCORE.why_not), reason=LUXCORE.why_not)
SIZE = (24, 16)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of all scenes."""
    return LUXCORE.make(tmp_path_factory.mktemp("luxcore"))


@pytest.fixture(scope="module")
def source(scenes: Path) -> Iterator[Sourced]:
    """Return the source of a scene by its name."""
    yield from LUXCORE.sources(scenes, SIZE)


# --- samples --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["glossy", "lights"])
def test_the_mean_is_that_of_luxcore(source: Sourced, scenes: Path, name: str) -> None:
    """A difference is found by accident in 5 % of seeds; the control has shorter paths."""
    reference = LUXCORE.images(scenes / f"{name}.cfg", SIZE, 256, 8)
    drawn = chd.Samples.from_array(samples_of(source(name), 192))
    assert chd.contrast(drawn, reference).outcome == "no difference found"
    cut = chd.Samples.from_array(samples_of(source(name, max_depth=2), 192))
    assert chd.contrast(cut, reference).outcome == "differ"


def test_samples_are_independent(source: Sourced) -> None:
    """Ranks keep rare bright samples from deciding; 4 standard deviations, each 1 in 16,000."""
    x = samples_of(source("glossy"), 256).mean(axis=2)
    z = rankdata(x, axis=-1) - 128.5  # of a pixel, whose mean is fixed
    random = z.std(-1) > 0
    z /= np.where(random, z.std(-1), 1)[..., np.newaxis]
    pairs = ((z[..., 1:], z[..., :-1]), (z[:, 1:], z[:, :-1]), (z[1:], z[:-1]))
    for a, b in pairs:
        expected = -1 / 255 if a.shape[-1] < 256 else 0
        one = 1 / np.sqrt((a * b != 0).sum())
        assert abs((a * b).sum() * one**2 - expected) < 4 * one


def test_a_pass_is_one_sample(tmp_path: Path) -> None:
    """Samples that meet a lamp or nothing are 9 or 0: averages would lie between."""
    view = "scene.camera.lookat.target = 0 0 3\n"
    (tmp_path / "lamp.scn").write_text(luxcore_scenes.CAMERA + luxcore_scenes.LAMP + view)
    source = LuxCoreSource(tmp_path / "lamp.scn", size=SIZE)
    x = samples_of(source, 64)
    source.close()
    assert set(np.unique(x[:, :, 0])) == {0, 9}
    edge = x[:, :, 0].mean(-1) / 9
    assert ((edge > 0.1) & (edge < 0.9)).any()


def test_equal_seeds_repeat_in_other_processes(source: Sourced) -> None:
    one = source("glossy")
    seeds = [seed_of_pass(0, n) for n in range(3)]
    first = [one(seed).image for seed in seeds]
    other = pickle.loads(pickle.dumps(one))
    for n in (2, 0, 1):
        np.testing.assert_array_equal(other(seeds[n]).image, first[n])
    other.close()
    np.testing.assert_array_equal(other(seeds[0]).image, first[0])  # it starts again
    other.close()
    assert not np.array_equal(first[0], first[1])


# --- features and parts ---------------------------------------------------------------------------


def test_features_are_those_of_the_geometry(source: Sourced) -> None:
    features = source("matte")(0).features
    floor = np.s_[-1, 0]
    np.testing.assert_allclose(features["normal"][floor], (0, 0, 1), atol=1e-5)
    np.testing.assert_allclose(features["albedo"][floor], (0.7, 0.7, 0.6), atol=1e-5)
    assert abs(features["position"][floor][2]) < 1e-5
    away = np.linalg.norm(features["position"][floor] - (0, -6, 2))
    np.testing.assert_allclose(features["depth"][floor], away, rtol=0.01)
    assert features["position"][-1, 0, 0] < 0 < features["position"][-1, -1, 0]


def test_a_crop_is_a_part_of_the_image(source: Sourced) -> None:
    """A pixel further, the mean differs by a fifth or more."""
    whole, part = source("matte"), source("matte", crop=(3, 9, 8, 4))
    assert part(0).features["position"].shape == (4, 8, 3)
    theirs, ours = (np.mean([one(n).image for n in range(100)], axis=0) for one in (whole, part))
    assert np.abs(ours - theirs[9:13, 3:11]).mean() < 0.1 * ours.mean()


def test_lights_add_up(source: Sourced) -> None:
    drawn = source("lights", by_light=("dot", "group-1", "dome"))(5)
    assert set(drawn.parts) == {"dot", "group-1", "dome"}
    np.testing.assert_allclose(sum(drawn.parts.values()), drawn.image, rtol=1e-5, atol=1e-7)
    assert all(part.any() for part in drawn.parts.values())


# --- provenance and refusals ----------------------------------------------------------------------


def test_provenance_names_what_matters(source: Sourced) -> None:
    one = source("matte")
    attrs = one.attrs
    assert attrs["renderer"].startswith("LuxCore 2")
    assert set(attrs["scene_files"]) == {"matte.cfg", "matte.scn", "ball.ply"}
    assert attrs["size"] == list(SIZE)
    assert attrs["integrator"]["total"] == 5
    told = " / ".join(attrs["notes"])
    for words in ("SOBOL", "BLACKMANHARRIS", "clamping of variance (10)", "image pipelines"):
        assert words in told


def test_wrong_options_are_refused(scenes: Path) -> None:
    path = scenes / "lights.cfg"
    for options in ({"frame": 3}, {"max_depth": 1}, {"size": (0, 4)}):
        with pytest.raises(InputError):
            LuxCoreSource(path, **options)
    with pytest.raises(InputError, match="crop"):
        LuxCoreSource(path, size=SIZE, crop=(20, 0, 8, 8))(0)
    with pytest.raises(SceneError, match="cannot tell direct light apart"):
        LuxCoreSource(path, size=SIZE, direct=True)(0)
    with pytest.raises(SceneError, match="beam"):
        LuxCoreSource(path, size=SIZE, by_light=("lamp",))(0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no file"),
        ("", "no property"),
        ("\0\1 nonsense", "propert"),
        ("scene.materials.a.type = matte\n", "no camera"),
        (luxcore_scenes.CAMERA + luxcore_scenes.BALL, "."),
        (luxcore_scenes.CAMERA + "scene.materials.a.type = mat\n", "mat"),
        (luxcore_scenes.CAMERA + "scene.objects.a.ply = gone.ply\n", "gone.ply"),
    ],
)
def test_files_that_are_no_scene_are_refused(tmp_path: Path, text: str, words: str) -> None:
    if text is not None:
        (tmp_path / "a.scn").write_text(text)
    with pytest.raises((SceneError, RenderError), match=words):
        LuxCoreSource(tmp_path / "a.scn", size=SIZE)(0)
