"""Guides and README: what they tell people to type is run, smaller than it is written.

Python on the pages is run while they are built, and what the pages for C++ say in `test_cpp_pages`.
"""

from __future__ import annotations

import glob
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text("utf-8")
PAGES = {
    path.stem: path.read_text("utf-8")
    for path in sorted([*DOCS.glob("*.rst"), *(DOCS / "how-to").glob("*.rst")])
    if path.stem not in {"cpp-renderer", "pbrt"}
}
FILE = re.compile(r"""Path\("(\S+)"\)\.write_text\('''\n(.*?)'''""", re.DOTALL)
ELSEWHERE = {
    "--scheduler": "tests/rendering/test_workers.py",  # with a scheduler of its own
    "--workers": "tests/test_clusters.py",  # in processes of their own
    "chdstat doctor": "tests/cli/test_cli.py",  # renders in processes of its own
    "report bathroom": ".ci/wheels",  # as many lines say; here reports are of stores
    "python3 -m venv": ".ci/run",
    "pip install": ".ci/wheels",
    "sphinx-build": ".ci/run",
    "pytest --render-update": "tests/docs/test_render_tests.py",
    "study -o study.pdf": "tests/studies/test_study.py",  # the same with every scene
    "fog -o study.pdf": "tests/studies/test_study.py",
    "fog -o two.pdf": "tests/studies/test_study.py",
    "report attic.zarr": "README.md",  # has the line of another store, as
    "report kitchen.zarr": "README.md",
    "house.blend": "tests/recording/test_other_scenes.py",
    "house.cfg": "tests/recording/test_other_scenes.py",
    "report monkey.blend": "tests/recording/test_cycles.py",
}
SMALL = {
    "bench": "--size 8x8 --reference-spp 16",
    "render": "--spp 48 --size 12x12 --backend scalar",  # as many as a reference has batches
    "report": "--iterations 2",
    "train": "--iterations 2",
    "compare": "--estimator mean --n 2",
    "study": "--spp 8 --size 12x12 --backend scalar --estimator mean",
}
"""Options that make a command quick; the last one given holds."""
IN_PYTHON = {
    "spp=256, size=(128, 128)": "spp=64, size=(16, 16)",
    "[64, 64]": "[8, 8]",
    "plot(64, 64,": "plot(8, 8,",
    "pixel(64, 64)": "pixel(8, 8)",
    "chd.compare(samples)": "chd.compare(samples, ['mean', 'median_of_means'])",
    '["bathroom", "caustic"], spp=256, size=(64, 64)': (
        '["caustic"], spp=16, size=(8, 8), estimators=["mean"]'
    ),
    'finding(6, "bathroom")': 'finding(6, "caustic")',
    'chd.explore("bathroom.zarr")': 'chd.explore("bathroom.zarr", browser=False).stop()',
}
SCENE = """<scene version="3.0.0">
  <default name="lamp" value="10"/>
  <sensor type="perspective">
    <film type="hdrfilm"/>
    <transform name="to_world"><lookat origin="0 -4 2" target="0 0 0.5" up="0 0 1"/></transform>
  </sensor>
  <integrator type="path"/>
  <shape type="rectangle"/>
  <shape type="sphere">
    <point name="center" x="0.6" y="-0.4" z="1.6"/> <float name="radius" value="0.3"/>
    <emitter type="area"><rgb name="radiance" value="$lamp"/></emitter>
  </shape>
</scene>
"""


def lines() -> list[tuple[str, str]]:
    """Return each page with each line that it tells people to type, but for those run elsewhere."""
    found = [
        (page, line)
        for page, text in PAGES.items()
        for line in re.findall(r"^ +\$ (.*)$", text, re.MULTILINE)
    ]
    shell = "".join(re.findall(r"^```sh\n(.*?)^```$", README, re.MULTILINE | re.DOTALL))
    found += [("README", line) for line in shell.splitlines()]
    return [(page, line) for page, line in found if not any(part in line for part in ELSEWHERE)]


@pytest.fixture(scope="module")
def stores(stored, tmp_path_factory) -> dict[str, Path]:
    """Return samples of a built-in scene and of one in a file, by the name of the scene."""
    attic = tmp_path_factory.mktemp("attic") / "scene.xml"
    attic.write_text(SCENE)
    scenes = {"cornell-box": "cornell-box", "attic": attic}
    return {name: stored(scene, size=(12, 12)) for name, scene in scenes.items()}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch, stores) -> Path:
    """Return the current folder: with scenes, passes of a renderer, and what is made of them."""
    monkeypatch.chdir(tmp_path)
    for file in ("attic/scene.xml", "kitchen/scene.xml", "scene.xml"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(SCENE)
    recipe = re.search(r"code-block:: toml\n\n((?:   .*\n|\n)+)", PAGES["studies"])
    assert recipe
    (tmp_path / "attic.toml").write_text(textwrap.dedent(recipe[1]), "utf-8")
    for page in ("contrast-renders", "own-renderer"):
        for name, code in FILE.findall(PAGES[page]):
            (tmp_path / name).write_text(textwrap.dedent(code))
    code = (tmp_path / "distance.py").read_text().replace('"distance"', '"lamps"')
    (tmp_path / "lamps.py").write_text(code)
    rng = np.random.default_rng(1)
    for seed in range(16):
        image, albedo = rng.gamma(0.5, 2.0, (2, 12, 12, 3))
        chd.io.write_exr(tmp_path / f"pass-{seed}.exr", image, extra={"albedo": albedo})
    return tmp_path


def bring(words: list[str], stores: dict[str, Path]) -> None:
    """Copy samples to where a command reads them, if no line before has written them."""
    outputs = [words[i + 1] for i, word in enumerate(words[:-1]) if word in {"-o", "--out"}]
    for word in words:
        if word.endswith(".zarr") and word not in outputs and not Path(word).exists():
            of = "attic" if word == "attic.zarr" else "cornell-box"
            shutil.copytree(stores[of], word)


def type_in(line: str, stores: dict[str, Path], run) -> tuple[int, str]:
    """Type a line as in a terminal; return its exit code and what it says of errors."""
    words = shlex.split(line.split(">")[0], comments=True)
    words = [name for word in words for name in (sorted(glob.glob(word)) or [word])]  # noqa: PTH207
    assert words[0] == "chdstat", line
    bring(words, stores)
    small = SMALL.get(words[1], "")
    if words[1] == "estimate" and "--model" not in words:
        small = "--spp 16 --size 12x12"
    elif words[1] == "report" and words[3].endswith(".zarr"):
        small = ""  # several renders, which train nothing
    elif words[1:3] == ["study", "attic.zarr"]:
        small = "--estimator mean"
    if "--plugin" in words:  # which stays in the process that loads it
        call = [sys.executable, "-m", "chdstat", *words[1:], *small.split()]
        done = subprocess.run(call, check=False, capture_output=True, text=True)
        return done.returncode, done.stderr
    code, _, err = run(*words[1:], *small.split())
    return code, err


class Shown:
    """What stands for the explorer, which would wait for a browser."""

    url = "http://localhost"

    def __init__(self, source, *_, **others):
        paths = [source, others.get("other"), others.get("maps")]
        assert all(Path(p).exists() for p in paths if p and str(p).endswith(".zarr"))

    def wait(self) -> None:
        """Return at once."""


@pytest.mark.filterwarnings("ignore:A and B are renders of two scenes")  # one of which stands in
@pytest.mark.parametrize("page", dict(lines()))
def test_every_line_to_type_succeeds(page, folder, stores, monkeypatch, run):
    monkeypatch.setattr(chd, "explore", Shown)
    for of, line in lines():
        if of == page:
            code, err = type_in(line, stores, run)
            # Renders that differ are no error, and few samples reach none that is asked for.
            allowed = {0, 3, 4} if " contrast " in line else {0, 3} if " --error " in line else {0}
            assert code in allowed, f"{line}\n{err}"


def test_lines_that_are_run_elsewhere_are_there():
    text = "\n".join([README, *PAGES.values()])
    for part, where in ELSEWHERE.items():
        assert part in text
        assert (ROOT / where).exists()


def test_python_in_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall(r"^```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL))
    for written, small in IN_PYTHON.items():
        assert code.count(written) == 1, written
        code = code.replace(written, small)
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "study.pdf").stat().st_size > 10_000
