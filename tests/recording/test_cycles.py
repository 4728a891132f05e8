"""Cycles as a source of passes, against images that it renders by itself."""

import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

import chdstat as chd
from chdstat.errors import InputError, RenderError, SceneError
from chdstat.recording import cycles
from chdstat.recording.cycles import CyclesSource
from chdstat.recording.pass_sources import seed_of_pass
from tests.recording.scene_renderers import CYCLES, Sourced, samples_of

pytestmark = pytest.mark.skipif(bool(CYCLES.why_not), reason=CYCLES.why_not)
SIZE = (24, 16)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of all scenes."""
    return CYCLES.make(tmp_path_factory.mktemp("blender"))


@pytest.fixture(scope="module")
def source(scenes: Path) -> Iterator[Sourced]:
    """Return the source of a scene by its name."""
    yield from CYCLES.sources(scenes, SIZE)


# --- samples --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["focus", "light_groups"])
def test_the_mean_is_that_of_cycles(source: Sourced, scenes: Path, name: str) -> None:
    """A difference is found by accident in 5 % of seeds; the control has four bounces less."""
    reference = CYCLES.images(scenes / f"{name}.blend", SIZE, 128, 8)
    drawn = chd.Samples.from_array(samples_of(source(name), 128))
    assert chd.contrast(drawn, reference).outcome == "no difference found"
    cut = chd.Samples.from_array(samples_of(source(name, max_depth=2), 128))
    assert chd.contrast(cut, reference).outcome == "differ"


def test_samples_are_independent(source: Sourced) -> None:
    """Ranks keep rare bright samples from deciding; 4 standard deviations, each 1 in 16,000."""
    x = samples_of(source("focus"), 256).mean(axis=2)
    z = rankdata(x, axis=-1) - 128.5  # of a pixel, whose mean is fixed
    z /= z.std()
    one, expected = 1 / np.sqrt(z.size), -1 / 255
    assert abs((z[..., 1:] * z[..., :-1]).mean() - expected) < 4 * one
    for neighbours in (z[:, 1:] * z[:, :-1], z[1:] * z[:-1], z[1:, 1:] * z[:-1, :-1]):
        assert abs(neighbours.mean()) < 4 * one
    passes = z.mean((0, 1)).var() * z[..., 0].size
    assert abs(passes - 1) < 4 * np.sqrt(2 / 256)


def test_samples_lie_anywhere_in_a_pixel(source: Sourced) -> None:
    """The first sample of Cycles lies at the centre of pixel, lens and shutter."""
    x = samples_of(source("transparent"), 32)
    assert (x.min(-1) < x.max(-1)).all(axis=2).mean() > 0.9


def test_equal_seeds_repeat_in_other_processes(source: Sourced) -> None:
    one = source("focus")
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
    one = source("focus", size=(48, 32))
    found = one(1).features
    normal, position, depth = (found[n] for n in ("normal", "position", "depth"))
    floor = (abs(position[..., 2]) < 1e-4) & (depth > 0)
    assert floor.mean() > 0.2
    np.testing.assert_allclose(np.median(normal[floor], axis=0), (0, 0, 1), atol=1e-4)
    np.testing.assert_allclose(
        np.median(found["albedo"][floor], axis=0), (0.6, 0.5, 0.4), atol=1e-3
    )
    camera = np.array([0, -7, 2.5])
    np.testing.assert_allclose(
        depth[floor], np.linalg.norm(position[floor] - camera, axis=-1), rtol=0.2
    )
    sky = source("motion", size=(48, 32), crop=(0, 0, 48, 4))(1).features["depth"]
    assert np.isfinite(sky).all()


def test_a_crop_is_a_part_of_the_image(source: Sourced) -> None:
    whole, part = source("lights"), source("lights", crop=(5, 3, 12, 6))
    image = part(3)
    assert image.image.shape == (6, 12, 3)
    for name, values in image.features.items():
        if name in ("depth", "position"):
            np.testing.assert_allclose(
                values, whole(3).features[name][3:9, 5:17], rtol=1e-4, atol=1e-4
            )
    assert part.attrs["crop"] == [5, 3, 12, 6]
    assert part.attrs["size"] == list(SIZE)
    with pytest.raises(InputError, match="within the image of 24 x 16"):
        source("lights", crop=(20, 0, 5, 1))(0)


def test_parts_are_of_the_same_samples(source: Sourced) -> None:
    lamps = ("key", "fill", "World", "Sphere*")
    one = source("light_groups", direct=True, by_light=lamps)
    plain = source("light_groups")
    for seed in (1, 2):
        drawn = one(seed)
        np.testing.assert_array_equal(drawn.image, plain(seed).image)
        assert list(drawn.parts) == [2, *lamps]
        np.testing.assert_allclose(
            sum(drawn.parts[n] for n in lamps), drawn.image, rtol=1e-3, atol=1e-5
        )
        assert (drawn.parts[2] <= drawn.image * (1 + 1e-4) + 1e-5).all()
        assert 0.3 < drawn.parts[2].mean() / drawn.image.mean() < 1
    short = source("light_groups", direct=True, max_depth=2)(1)
    np.testing.assert_allclose(short.parts[2], short.image, rtol=1e-3, atol=1e-5)


def test_patterns_of_lights_are_groups(source: Sourced) -> None:
    drawn = source("light_groups", by_light=("Lamp.*",))(1)
    groups = source("light_groups", by_light=("key", "fill"))(1)
    both = groups.parts["key"] + groups.parts["fill"]
    np.testing.assert_allclose(drawn.parts["Lamp.*"], both, rtol=1e-3, atol=1e-5)


# --- what is said ---------------------------------------------------------------------------------


def test_provenance_names_what_matters(source: Sourced, scenes: Path) -> None:
    attrs = source("texture").attrs
    assert json.loads(json.dumps(attrs)) == attrs
    assert attrs["renderer"].startswith("Cycles ")
    assert attrs["integrator"] | {"type": "cycles", "max_bounces": 12} == attrs["integrator"]
    assert set(attrs["scene_files"]) == {"texture.blend", "checks.png"}
    assert attrs["scene_source"] == str(scenes / "texture.blend")
    assert attrs["parameters"] == {
        "frame": 1,
        "camera": "Camera",
        "view_layer": "ViewLayer",
        "scene": "Scene",
    }
    told = " ".join(attrs["notes"])
    for word in ("denoiser", "clamping of indirect light (10)", "adaptive", "BLACKMAN_HARRIS"):
        assert word in told


def test_frames_and_hashes_follow_parameters(source: Sourced) -> None:
    first, last = source("motion", frame=1), source("motion", frame=3)
    assert not np.array_equal(first(1).features["depth"], last(1).features["depth"])
    assert first.attrs["scene_hash"] != last.attrs["scene_hash"]
    assert source("motion").attrs["parameters"]["frame"] == 2


@pytest.mark.parametrize(
    ("options", "error", "told"),
    [
        ({"camera": "Kamera"}, SceneError, "no camera 'Kamera'.*'Camera'"),
        ({"view_layer": "x"}, SceneError, "no view layer 'x'.*'ViewLayer'"),
        ({"scene": "x"}, SceneError, "no scene 'x'.*'Scene'"),
        ({"by_light": ("Sun*",)}, SceneError, r"no light or light group 'Sun\*'.*key"),
        ({"by_light": ("key", "Lamp*")}, SceneError, "belongs to 'key' and to"),
        ({"shutter": 1}, InputError, "no parameter 'shutter'"),
        ({"max_depth": 1}, InputError, "max_depth"),
    ],
)
def test_wrong_parameters_are_refused(
    scenes: Path, options: dict[str, object], error: type[Exception], told: str
) -> None:
    with pytest.raises(error, match=told):
        CyclesSource(scenes / "light_groups.blend", size=SIZE, **options)(0)


def test_files_that_are_no_scene_are_refused(scenes: Path, tmp_path: Path) -> None:
    whole = (scenes / "focus.blend").read_bytes()
    (tmp_path / "empty.blend").write_bytes(b"")
    with zipfile.ZipFile(tmp_path / "zip.blend", "w") as archive:
        archive.writestr("scene.blend", "x" * 99)
    (tmp_path / "cut.blend").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "noise.blend").write_bytes(whole[:12] + bytes(range(256)) * 99)
    for name, told in (
        ("empty", "it is empty"),
        ("zip", "no file of Blender"),
        ("cut", "cannot open|no camera"),
        ("noise", "cannot open|has ended"),
    ):
        with pytest.raises((SceneError, RenderError), match=told):
            CyclesSource(tmp_path / f"{name}.blend")(0)
    with pytest.raises(SceneError, match="there is no file"):
        CyclesSource(tmp_path / "none.blend")(0)


def test_code_in_a_file_is_not_run_and_missing_files_are_named(tmp_path: Path) -> None:
    script = tmp_path / "make.py"
    script.write_text(f"""
import bpy
text = bpy.data.texts.new("evil.py")
text.write("open({str(tmp_path / "run")!r}, 'w')")
text.use_module = True
driver = bpy.context.scene.camera.driver_add("location", 0).driver
driver.expression = "open({str(tmp_path / "run")!r}, 'w') and 0"
image = bpy.data.images.new("gone", 2, 2)
image.filepath_raw = {str(tmp_path / "gone.png")!r}
image.file_format = "PNG"
image.save()
image = bpy.data.images.load(image.filepath_raw)
image.use_fake_user = True
bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / "evil.blend")!r})
""")
    CYCLES.run(script)
    (tmp_path / "gone.png").unlink()
    (tmp_path / "run").unlink(missing_ok=True)
    one = CyclesSource(tmp_path / "evil.blend", size=(8, 8))
    told = " ".join(one.attrs["notes"])
    one.close()
    assert "not run" in told
    assert "gone.png" in told
    assert "BLENDER_WORKBENCH" in told
    assert not (tmp_path / "run").exists()


def test_blender_is_where_the_variable_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scenes: Path
) -> None:
    monkeypatch.setenv("CHDSTAT_BLENDER", "/opt/blender/blender")
    assert cycles.blender()[:2] == ["/opt/blender/blender", "--background"]
    with pytest.raises(RenderError, match="cannot be started by /opt/blender/blender"):
        CyclesSource(scenes / "focus.blend")(0)
    monkeypatch.setenv("CHDSTAT_BLENDER", sys.executable)
    assert cycles.blender() == [sys.executable]
    monkeypatch.delenv("CHDSTAT_BLENDER")
    monkeypatch.setattr(cycles.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RenderError, match=r"\$CHDSTAT_BLENDER"):
        cycles.blender()
    (tmp_path / "blender").write_text("#!/bin/sh\nexit 1\n")
    os.chmod(tmp_path / "blender", 0o755)  # noqa: PTH101
    assert cycles.blender()[0] == str(tmp_path / "blender")


def test_animated_settings_do_not_undo_what_passes_need(tmp_path: Path) -> None:
    script = tmp_path / "make.py"
    script.write_text(f"""
import bpy
scene = bpy.context.scene
scene.render.engine = "CYCLES"
scene.driver_add("cycles.seed").driver.expression = "frame"
for frame, level in ((1, 0.5), (10, 2.0)):
    scene.cycles.sample_clamp_indirect = level
    scene.cycles.max_bounces = frame
    scene.keyframe_insert("cycles.sample_clamp_indirect", frame=frame)
    scene.keyframe_insert("cycles.max_bounces", frame=frame)
bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / "moving.blend")!r})
""")
    CYCLES.run(script)
    one = CyclesSource(tmp_path / "moving.blend", size=(16, 12), frame=10)
    told, first, second = one.attrs, one(1).image, one(2).image
    one.close()
    assert not np.array_equal(first, second)
    assert told["integrator"]["max_bounces"] == 10
    notes = " ".join(told["notes"])
    assert "animated settings stay as they are at frame 10: cycles.max_bounces" in notes
    assert "clamping of indirect light (2) is off" in notes


def test_a_report_is_made_of_a_file(run: Callable[..., tuple[int, str, str]], scenes: Path) -> None:
    report = scenes / "lights.pdf"
    given = ("--spp", 64, "--size", "24x16")
    code, said, err = run("report", scenes / "lights.blend", "-o", report, *given)
    assert code == 0, err
    assert "pages" in said
    assert report.stat().st_size > 20_000
