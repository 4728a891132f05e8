"""The pages for renderers in C++: all that they tell people to compile and to type is run."""

import os
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

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    name: (DOCS / "how-to" / f"{name}.rst").read_text("utf-8") for name in ("cpp-renderer", "pbrt")
}

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not there")


INCLUDE = Path(chd.__file__).parent / "io" / "include"  # as `chdstat include` prints, typed below


def blocks(page, language):
    """Return the code on a page by its caption, or by its number where it has none."""
    pattern = rf"^\.\. code-block:: {language}\n((?:   .*\n|\n)+)"
    found = {}
    for number, text in enumerate(re.findall(pattern, PAGES[page], re.MULTILINE)):
        caption = re.match(r"   :caption: (.*)\n", text)
        code = textwrap.dedent(text[caption.end() :] if caption else text).strip() + "\n"
        found[caption[1] if caption else str(number)] = code
    return found


@pytest.fixture
def type_in(tmp_path, monkeypatch, run):
    """Return what types lines of a terminal but for reports, which must succeed: all they print."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")

    def typed(line):
        if line.startswith("chdstat report"):  # as `test_guides` does
            return ""
        if line.startswith("chdstat "):
            code, out, err = run(*shlex.split(line)[1:])
        else:
            done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
            code, out, err = done.returncode, done.stdout, done.stderr
        assert code == 0, f"{line}\n{err}"
        return out

    return lambda lines: "".join(typed(line.removeprefix("$ ")) for line in lines.splitlines())


def test_the_shortest_program_becomes_samples(tmp_path, type_in):
    page, first = PAGES["cpp-renderer"], blocks("cpp-renderer", "cpp")["first.cpp"]
    own = [line for line in first.splitlines() if "writer" in line or "chdstat" in line]
    assert len(own) <= 20
    (tmp_path / "first.cpp").write_text(first)
    shutil.copy(DOCS / "how-to/cpp/tracer.cpp", tmp_path)
    printed = "".join(map(type_in, blocks("cpp-renderer", "console").values()))
    assert "box" in printed
    first = chd.open(tmp_path / "first.zarr")
    assert first.shape == (30, 40, 3, 64)
    assert abs(first.read().mean() - 1) < 0.02  # of 230400 gamma variables: 6 standard errors
    assert f"{len((tmp_path / 'tracer.cpp').read_text().splitlines()) // 10 * 10} lines" in page


FRAME = """
#include "chdstat_writer.h"

void render_tile(int, int, int width, int height, int spp, float *radiance) {
    for (int i = 0; i < width * height * spp * 3; ++i) radiance[i] = 1;
}

int main() {
    const int width = 32, height = 32, x = 16, y = 16, spp = 4;
    (void)width, (void)height, (void)x, (void)y, (void)spp;
"""


@pytest.mark.parametrize("caption", [c for c in blocks("cpp-renderer", "cpp") if c != "first.cpp"])
def test_every_other_block_is_compiled_and_run(tmp_path, type_in, caption):
    code, given = blocks("cpp-renderer", "cpp")[caption], ""
    if "chdstat::Writer writer" not in code:
        given = '    chdstat::Writer writer("x.chds", width, height);\n'
    (tmp_path / "block.cpp").write_text(f"{FRAME}{given}{code}}}\n")
    options = f"-std=c++11 -Wall -Wextra -Werror -pthread -I{INCLUDE}"
    type_in(f"g++ {options} block.cpp -o block\n./block")
    assert list(tmp_path.glob("*.chds"))


def test_pbrt_writes_its_samples(tmp_path, type_in):
    code = blocks("pbrt", "cpp")
    names = {
        "at the top": "top",
        "before the waves": "waves",
        "at the end": "end",
        "for each sample": "sample",
    }
    assert code.keys() == names.keys()
    for caption, name in names.items():
        (tmp_path / f"{name}.inc").write_text(code[caption])
    shutil.copy(Path(__file__).parent / "pbrt_stand_in.cpp", tmp_path)
    options = f"-std=c++17 -Wall -Wextra -Werror -pthread -I{INCLUDE}"
    type_in(f"g++ {options} pbrt_stand_in.cpp -o pbrt\n./pbrt")
    (commands,) = blocks("pbrt", "console").values()
    type_in(commands)
    samples = chd.open(tmp_path / "kitchen.zarr")
    assert samples.shape == (30, 40, 3, 24)
    assert samples.attrs["seed"] == 1
    assert samples.attrs["renderer"] == "pbrt-v4"
    y, x = np.mgrid[3:33, 5:45]
    assert np.array_equal(samples.read()[:, :, 0, 0], y * 100 + x)
    assert np.array_equal(
        np.sort(samples.read()[:, :, 1]), np.broadcast_to(np.arange(24), (30, 40, 24))
    )
