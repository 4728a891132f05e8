"""Memory and processor time of large stores, of simulated samples, each stage in a child process.

CHDSTAT_SIZE, such as ``1920x1080x64``, sets width, height and samples of a pixel. Run with
``--benchmark-only -s -n 0``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.samples.store import Store

WIDTH, HEIGHT, SPP = map(int, os.environ.get("CHDSTAT_SIZE", "256x256x2048").split("x"))

WATCH = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True)
spent = resource.getrusage(resource.RUSAGE_CHILDREN)
print(spent.ru_maxrss, spent.ru_utime + spent.ru_stime)
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Return a store of gamma samples of which half are null, written chunk by chunk."""
    path: Path = tmp_path_factory.mktemp("size") / "large.zarr"
    like = chd.render("cornell-box", spp=1, size=(WIDTH, HEIGHT), progress=False)
    shape, rng = (HEIGHT, WIDTH, 3, SPP), np.random.default_rng(0)
    about = {**like.attrs, "spp": SPP}
    with Store.create(path, shape=shape, attrs=about, features=like.features) as made:
        for chunk in made.pending():
            height, width, n = chunk.shape
            lit = rng.random((height, width, 1, n)) < 0.5
            grey = lit * rng.gamma(0.5, size=lit.shape)
            made.write(chunk, (grey * np.array([1, 0.5, 0.2])[:, np.newaxis]).astype(np.float32))
    return path


def commands(store: Path, folder: Path) -> dict[str, list[str]]:
    """Return what reads or makes as many samples, by name."""
    size = [f"--size={WIDTH}x{HEIGHT}", f"--spp={SPP}"]
    return {
        "estimate": ["estimate", str(store), "-o", str(folder / "out.exr")],
        "analyze": ["analyze", str(store), "-o", str(folder / "out.zarr")],
        "train": ["train", str(store), "--iterations=200", "-o", str(folder / "out.safetensors")],
        "report": ["report", str(store), "-e", "mean", "-o", str(folder / "out.pdf")],
        "study": ["study", str(store), "-e", "mean", "-o", str(folder / "out.pdf")],
        "while-rendering": [
            *("estimate", "cornell-box", "--while-rendering"),
            *(*size, "-o", str(folder / "live.exr")),
        ],
        "summary-only": ["render", "cornell-box", *size, "--summary-only", "-o", str(folder / "m")],
    }


@pytest.mark.parametrize("stage", commands(Path(), Path()))
def test_memory_of_a_large_store(as_benchmark, store, stage, tmp_path):
    command = [sys.executable, "-m", "chdstat", *commands(store, tmp_path)[stage], "-q"]
    done = subprocess.run(
        [sys.executable, "-c", WATCH, *command], capture_output=True, text=True, check=True
    )
    peak, seconds = map(float, done.stdout.split()[-2:])
    raw = WIDTH * HEIGHT * SPP * 12
    print(
        f"\n{stage} of {WIDTH} x {HEIGHT} x {SPP} ({raw / 1e9:.1f} GB): at most "
        f"{peak / 1e6:.2f} GB of memory, {12e9 * seconds / raw:.0f} ns of processor time a sample"
    )
