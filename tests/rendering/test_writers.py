"""Two processes at one store: the samples are right, and who is late is told so."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

import chdstat as chd
from chdstat.samples import inspect

BOX = {"scene": "cornell-box", "size": (66, 5), "backend": "scalar", "progress": False}


def started(out, spp):
    """Start a render in a process of its own."""
    asked = ("cornell-box", "--size", "66x5", "--backend", "scalar", "--spp", str(spp), "-q")
    command = [sys.executable, "-m", "chdstat", "render", *asked, "-o", str(out)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=out.parent
    )


def test_of_two_writers_one_may_be_refused_and_the_samples_are_right(tmp_path):
    path, most = tmp_path / "box.zarr", 512
    pair = [started(path, 320), started(path, most)]
    for process in pair:
        _, told = process.communicate(timeout=600)
        assert process.returncode == 0 or (
            process.returncode == 2
            and ("is being written by" in told or "run the command again" in told)
        ), told
    assert 0 in [process.returncode for process in pair]
    chd.render(**BOX, spp=most, out=path)
    assert inspect(path, verify=True)["damaged"] == []
    assert np.array_equal(chd.open(path).read(), chd.render(**BOX, spp=most).read())
    left = [p.name for p in tmp_path.rglob("*") if ".partial" in p.name or p.name == ".lock"]
    assert left == []
