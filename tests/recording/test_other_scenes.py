"""Scene files of renderers other than Mitsuba, drawn here by a renderer of a few lines."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, SceneError
from chdstat.recording import DrawnPass, renderers
from chdstat.rendering import render_batches, render_pixels
from chdstat.rendering.jobs import scene_integrator, scene_size
from chdstat.scenes import load_scene


class ToySource:
    """A renderer whose scene is a text: the mean of an exponential law."""

    def __init__(
        self,
        path: Path,
        size: tuple[int, int] | None = None,
        crop: tuple[int, int, int, int] | None = None,
        max_depth: int | None = None,
        direct: bool = False,
        by_light: tuple[str, ...] = (),
        **parameters: str,
    ) -> None:
        self.name, self.closed = path.stem, False
        self._mean, self._size = float(path.read_text()), size or (12, 8)
        self._parts = [2] * direct
        asked: Mapping[str, Any] = {"crop": crop, "max_depth": max_depth, "by_light": [*by_light]}
        self.attrs = {
            "scene": self.name,
            "renderer": "Toy 1.0",
            "scene_source": str(path),
            "scene_hash": load_scene(path).hash,
            "scene_files": load_scene(path).files(),
            "size": list(self._size),
            "integrator": {"type": "toy", **asked},
            "parameters": parameters,
            "filter": "box",
            "units": "linear radiance",
            "notes": [],
        }

    def __call__(self, seed: int) -> DrawnPass:
        width, height = self._size
        rng = np.random.default_rng(seed)
        image = rng.exponential(self._mean, (height, width, 3)).astype(np.float32)
        return DrawnPass(image, {}, dict.fromkeys(self._parts, image / 2))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a scene file of the renderer, in place of Cycles."""
    monkeypatch.setitem(renderers._SOURCES, "Cycles", ToySource)
    path = tmp_path / "toy.blend"
    path.write_text("1.0")
    return path


@pytest.fixture
def command(run) -> Callable[..., dict[str, Any]]:
    """Return what runs a command and reads its JSON."""

    def told(*words: object) -> dict[str, Any]:
        code, out, err = run(*words, "--json")
        assert code in (0, 3), err
        found: dict[str, Any] = json.loads(out)
        return found

    return told


def test_a_scene_is_recorded(scene: Path):
    samples = chd.render(load_scene(scene, frame=3), spp=5, size=(6, 4), max_depth=4, direct=True)
    assert samples.shape == (4, 6, 3, 5)
    assert samples.attrs["renderer"] == "Toy 1.0"
    assert samples.attrs["parameters"] == {"frame": "3"}
    assert samples.attrs["integrator"]["max_depth"] == 4
    assert samples.direct is not None
    np.testing.assert_array_equal(samples.direct.read(), samples.read() / 2)


def test_a_store_goes_on_at_its_size(scene: Path, tmp_path: Path):
    first = chd.render(scene, spp=3, size=(5, 4), out=tmp_path / "toy.zarr").read()
    more = chd.render(scene, spp=70, out=tmp_path / "toy.zarr").read()
    assert more.shape == (4, 5, 3, 70)
    np.testing.assert_array_equal(more[..., :3], first)
    assert len(np.unique(more)) == more.size


def test_a_changed_file_is_another_scene(scene: Path, tmp_path: Path):
    before = load_scene(scene).hash
    chd.render(scene, spp=3, out=tmp_path / "toy.zarr")
    scene.write_text("2.0")
    assert load_scene(scene).hash != before
    with pytest.raises(chd.errors.StoreError, match=r"toy\.blend"):
        chd.render(scene, spp=6, out=tmp_path / "toy.zarr")


def test_size_and_integrator_are_the_renderers(scene: Path):
    assert scene_size(scene) == (12, 8)
    assert scene_integrator(scene) == "toy"


@pytest.mark.parametrize(
    "options", [{"adaptive": True}, {"sampler": "stratified"}, {"by_depth": 3}, {"color": "mono"}]
)
def test_what_only_mitsuba_does_is_refused(scene: Path, options: dict[str, Any]):
    with pytest.raises(InputError, match=f"{next(iter(options))}: for scenes that Mitsuba"):
        chd.render(scene, **options)


def test_samples_on_demand_are_mitsubas(scene: Path):
    for draw in (lambda: render_batches(scene), lambda: render_pixels(scene, [(0, 0)])):
        with pytest.raises(InputError, match=r"which Cycles renders: first keep its samples with"):
            draw()


def test_commands_take_it(command, scene: Path, tmp_path: Path):
    store = tmp_path / "toy.zarr"
    command("render", scene, "-o", store, "--spp", 3 * 96, "--frame", 3, "-D", "camera=Top")
    assert chd.open(store).attrs["parameters"] == {"camera": "Top", "frame": "3"}
    same = command("contrast", scene, store)
    assert same["outcome"] == "no difference found"
    scene.write_text("0.8")
    assert command("contrast", scene, store)["outcome"] == "differ"


def test_an_estimate_and_a_page_take_it(command, scene: Path, tmp_path: Path):
    command("estimate", scene, "-o", tmp_path / "toy.exr", "--spp", 64)
    with chd.explore(scene, size=(6, 4)) as explorer:
        assert explorer.url.startswith("http://127.0.0.1")


def test_frames_are_of_blend_files(run, tmp_path: Path):
    code, _, err = run("render", "cornell-box", "-o", tmp_path / "x.zarr", "--frame", "3")
    assert code == 2
    assert "--frame is for .blend files, got cornell-box" in err


def test_other_files_are_refused(tmp_path: Path):
    path = tmp_path / "scene.usd"
    path.write_text("")
    with pytest.raises(SceneError, match=r"Blender's \(\*\.blend\) or LuxCore's"):
        load_scene(path)
