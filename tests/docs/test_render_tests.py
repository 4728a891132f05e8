"""The page on render tests: its renderer is right, and what it tells people to type is run."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import chdstat as chd

FOLDER = Path(__file__).parents[2] / "docs" / "how-to" / "render-tests"
PAGE = FOLDER.with_name("replace-reference-images.rst").read_text("utf-8")
RENDERER = (FOLDER / "tiny_renderer.py").read_text("utf-8")
FAULTS = re.findall(r'^       \("([^"]+)", "([^"]+)", "([^"]*)"\),$', PAGE, re.MULTILINE)


# --- the renderer ---------------------------------------------------------------------------------


def tiny(right: str = "", wrong: str = "", size: int = 24) -> SimpleNamespace:
    """Return the renderer with a change, as small images."""
    assert right in RENDERER
    names: dict = {}
    exec(RENDERER.replace(right, wrong).replace("SIZE = 64", f"SIZE = {size}"), names)
    return SimpleNamespace(**names)


def samples(renderer: SimpleNamespace, spp: int, first: int = 0) -> np.ndarray:
    return np.stack([renderer.draw(first + i) for i in range(spp)], axis=-1)


def colour(value) -> dict:
    return {"type": "rgb", "value": [float(v) for v in value]}


def square(mi, at, towards, half: float, **others) -> dict:
    """Return a square about a point, whose normal shows somewhere."""
    up = (1, 0, 0) if abs(towards[1]) > 0 else (0, 1, 0)
    at, to = [float(v) for v in at], [float(a + t) for a, t in zip(at, towards, strict=True)]
    frame = mi.ScalarTransform4f().look_at(origin=at, target=to, up=up)
    scale = mi.ScalarTransform4f().scale(half)
    return {"type": "rectangle", "to_world": frame @ scale, **others}


def in_mitsuba(renderer: SimpleNamespace) -> dict:
    """Return its scene in Mitsuba's form.

    Planes end far away, behind which there is sky: that adds half a per cent to the light of the
    sky, and 1.6 % if they ended after a tenth of that distance.
    """
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    view = {"origin": renderer.CAMERA, "target": renderer.TARGET, "up": (0, 1, 0)}
    size = {"width": renderer.SIZE, "height": renderer.SIZE, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": -1},
        "sensor": {
            "type": "perspective",
            "fov": renderer.ANGLE,
            "to_world": mi.ScalarTransform4f().look_at(**view),
            "film": {"type": "hdrfilm", **size},
        },
        "sky": {"type": "constant", "radiance": colour(renderer.SKY)},
    }
    for i, (normal, offset, albedo) in enumerate(renderer.PLANES[:-1]):
        paint = {"type": "diffuse", "reflectance": colour(albedo)}
        at = np.multiply(normal, offset)
        scene[f"plane-{i}"] = square(mi, at, normal, 10_000, bsdf=paint)
    black = {"type": "diffuse", "reflectance": colour((0, 0, 0))}
    for side in (1, -1):
        shines = {"type": "area", "radiance": colour(renderer.LAMP)}
        at, towards = np.add(renderer.CENTRE, (0, 1e-5 * side, 0)), (0, side, 0)
        scene[f"lamp{side}"] = square(mi, at, towards, renderer.HALF, bsdf=black, emitter=shines)
    for i, (centre, radius, albedo, mirror) in enumerate(renderer.SPHERES):
        paint = {"type": "diffuse", "reflectance": colour(albedo)}
        if mirror:
            tint = colour(albedo)
            paint = {"type": "conductor", "material": "none", "specular_reflectance": tint}
        scene[f"ball-{i}"] = {"type": "sphere", "center": centre, "radius": radius, "bsdf": paint}
    return scene


@pytest.mark.slow
def test_the_renderer_agrees_with_mitsuba():
    renderer = tiny()
    other = chd.render(in_mitsuba(renderer), spp=512, size=(24, 24), seed=1)
    found = chd.contrast(samples(renderer, 512), other, alpha=1e-3)
    assert found.outcome == "no difference found"  # but for one of 1000 seeds
    assert found.detectable["image"] < 0.03


@pytest.mark.slow
def test_in_a_furnace_all_is_equally_bright():
    renderer = tiny()
    renderer.SKY[:], renderer.LAMP[:], renderer.ALBEDO[:] = 1, 1, 1
    means = samples(renderer, 256).mean(axis=-1)[..., 0]  # whose channels are equal
    error = means.std() / np.sqrt(means.size)
    assert abs(means.mean() - 1) < 5 * error < 0.01


def test_seeds_are_other_samples_and_repeat():
    renderer = tiny()
    assert np.array_equal(renderer.draw(1), renderer.draw(1))
    same = np.isclose(renderer.draw(1), renderer.draw(2)).all(axis=-1)
    assert same.mean() < 0.05  # where a mirror shows the sky or the lamp


@pytest.mark.parametrize(("right", "wrong"), [fault[1:] for fault in FAULTS[:2]])
def test_each_fault_of_the_page_is_found(right, wrong):
    found = chd.contrast(samples(tiny(), 256), samples(tiny(right, wrong), 256, 1000), alpha=1e-3)
    assert found.outcome == "differ"


# --- what is typed --------------------------------------------------------------------------------


def type_in(line: str, folder: Path, code: int = 0) -> str:
    """Type a line in a folder, and check its exit code; return all that it prints."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": "100"}
    call = ["bash", "-c", line]
    options = {"capture_output": True, "text": True, "check": False}
    done = subprocess.run(call, cwd=folder, env=environment, **options)
    assert done.returncode == code, f"{line}\n{done.stdout}{done.stderr}"
    return done.stdout


def files_of_the_page(folder: Path) -> Path:
    """Return a folder with the files of the page, whose image is small."""
    for file in ("test_tiny_renderer.py", "render-tests.sh", "requirements-test.txt"):
        shutil.copy(FOLDER / file, folder)
    (folder / "tiny_renderer.py").write_text(RENDERER.replace("SIZE = 64", "SIZE = 24"))
    return folder


@pytest.fixture(scope="module")
def guarded(tmp_path_factory) -> Path:
    """Return such a folder with references."""
    folder = files_of_the_page(tmp_path_factory.mktemp("guarded"))
    type_in("pytest -q --render-update", folder)
    return folder


COMMANDS = re.findall(r"^\.\. run:: console\n((?:   :exit: \d\n)?)\n   (.*)$", PAGE, re.MULTILINE)


@pytest.mark.slow  # the page runs most of it when the documentation is built
def test_from_nothing_to_a_test_that_finds_the_wrong_cosine(tmp_path):
    folder = files_of_the_page(tmp_path)
    printed = [type_in(line, folder, int(code[-2]) if code else 0) for code, line in COMMANDS]
    assert [line for _, line in COMMANDS].count("pytest -q") == 3
    written, _, passes, _, fails, _, again = printed
    assert "written" in written
    assert "1 passed" in passes
    assert "The means differ" in fails
    assert {file.suffix for file in folder.glob("render-report/room*")} == {".png", ".html"}
    assert "1 passed" in again


@pytest.mark.slow  # the page runs most of it when the documentation is built
def test_the_workflow_runs_and_its_artifacts_are_there(guarded):
    file = yaml.safe_load((FOLDER / "render-tests.yml").read_text("utf-8"))
    assert file[True].keys() == {"push", "pull_request"}  # YAML reads `on` as true
    (job,) = file["jobs"].values()
    steps = job["steps"]
    assert all(("uses" in step) != ("run" in step) for step in steps)
    assert (FOLDER / steps[1]["with"]["cache-dependency-path"]).exists()
    install, test = (step["run"] for step in steps if "run" in step)
    assert install == "pip install -r requirements-test.txt"
    type_in(test.replace("-n auto", "-n 2"), guarded)
    report = guarded / steps[-1]["with"]["path"]
    assert {"index.html", "tests.xml"} <= {file.name for file in report.iterdir()}
    assert len(list(report.glob("room*.html"))) == 1


@pytest.mark.slow  # the page runs most of it when the documentation is built
def test_the_script_runs_and_exits_as_pytest_does(guarded):
    (guarded / ".venv").symlink_to(sys.prefix)  # instead of a new one
    assert "1 passed" in type_in("sh render-tests.sh -q", guarded)
    assert (guarded / "render-report" / "tests.xml").exists()
    type_in("sh render-tests.sh -q -k nothing", guarded, code=pytest.ExitCode.NO_TESTS_COLLECTED)


STAND_IN = """#!/bin/sh
mv passes/"$(ls passes | head -n 1)" "$7"  # the next one, whatever the seed
"""
SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <film type="hdrfilm">
      <integer name="width" value="12"/> <integer name="height" value="12"/>
    </film>
    <transform name="to_world"><lookat origin="0 -4 2" target="0 0 0.5" up="0 0 1"/></transform>
  </sensor>
  <integrator type="path"/>
  <shape type="rectangle"/>
  <emitter type="constant"/>
</scene>
"""


@pytest.mark.slow  # the page runs most of it when the documentation is built
def test_other_renderers_are_guarded_as_the_page_says(tmp_path):
    tests = {path.name: path.read_text("utf-8") for path in FOLDER.glob("test_*.py")}
    del tests["test_tiny_renderer.py"]
    assert all(f"render-tests/{name}" in PAGE for name in tests)
    if shutil.which("g++"):
        tracer = FOLDER.parent / "cpp" / "tracer.cpp"
        options = f"-O2 -std=c++17 -pthread -I{shlex.quote(str(chd.io.get_include()))}"
        type_in(f"g++ {options} {tracer} -o tracer", tmp_path)
        tests["test_cpp.py"] = tests["test_cpp.py"].replace('"48", "48"', '"12", "12"')
    else:
        del tests["test_cpp.py"]
    (tmp_path / "renderer").write_text(STAND_IN)
    (tmp_path / "renderer").chmod(0o755)
    (tmp_path / "passes").mkdir()
    for i, image in enumerate(np.random.default_rng(1).gamma(2.0, size=(200, 8, 8, 3))):
        chd.io.write_exr(tmp_path / "passes" / f"{i:03}.exr", image)
    tests["test_exr.py"] = tests["test_exr.py"].replace("spp=64", "spp=16")
    (tmp_path / "kitchen").mkdir()
    (tmp_path / "kitchen" / "scene.xml").write_text(SCENE)
    for name, text in tests.items():
        (tmp_path / name).write_text(text)
    assert type_in("pytest -q --render-update", tmp_path).count("written: ") == len(tests)
    assert f"{len(tests)} passed" in type_in("pytest -q", tmp_path)


def test_the_example_has_the_length_that_the_page_says():
    lines = int(re.search(r"path tracer in (\d+) lines", PAGE)[1])
    assert 0 <= len(RENDERER.splitlines()) - lines < 10
    assert runpy.run_path(str(FOLDER / "tiny_renderer.py"))["draw"](0).shape == (64, 64, 3)
