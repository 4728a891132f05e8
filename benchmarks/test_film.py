"""What it costs to keep where in its pixel each sample fell, and what is told by that.

Run with ``pytest benchmarks/test_film.py --benchmark-only -s -n 0``: ten minutes on a quiet core;
CHDSTAT_SPP sets other samples than 256 in a pixel of the timed renders. Renders with and without take turns, and their times are of the processor, which a busy machine
stretches least. A failure: a store of more than 1.35 times its size, or of all scenes together a
render of more than 1.05 times its time.
"""

import os
import shutil
import statistics
import time

import numpy as np
import pytest

import chdstat as chd
from chdstat.patterns import film_split

SCENES = tuple(chd.scenes.BUILTIN)
SIZE, ROUNDS = (128, 128), 3
SPP = int(os.environ.get("CHDSTAT_SPP", "256"))
MOST_BYTES, MOST_TIME = 1.35, 1.05


def spent(scene, out, **options):
    """Return the seconds of processor time of a render, and the bytes of its store."""
    shutil.rmtree(out, ignore_errors=True)
    begin = time.process_time()
    chd.render(scene, out=out, progress=False, **options)
    seconds = time.process_time() - begin
    return seconds, sum(file.stat().st_size for file in out.rglob("*") if file.is_file())


def cost(scene, out, **options):
    """Return the median times without and with places, and the ratio of the stores."""
    plain, more, sizes = [], [], {}
    for turn in range(ROUNDS):
        for film in (turn % 2 == 1, turn % 2 == 0):
            seconds, sizes[film] = spent(scene, out, film=film, **options)
            (more if film else plain).append(seconds)
    return statistics.median(plain), statistics.median(more), sizes[True] / sizes[False]


@pytest.mark.parametrize("backend", ["llvm", "scalar"])
def test_the_cost_of_places(as_benchmark, tmp_path, backend):
    scenes = SCENES if backend == "llvm" else ("cornell-box", "caustic")
    view = {"size": SIZE, "spp": SPP} if backend == "llvm" else {"size": (64, 64), "spp": SPP}
    spent(scenes[0], tmp_path / "first.zarr", backend=backend, size=(8, 8), spp=16)  # imports
    found = {s: cost(s, tmp_path / "a.zarr", backend=backend, **view) for s in scenes}
    for scene, (plain, more, size) in found.items():
        print(f"\n{backend} {scene:12} {plain:6.2f} s, with places {more / plain:.3f}", end=" ")
        print(f"of the time, {size:.3f} of the bytes", end="")
    plain, more, size = np.array(list(found.values())).T
    print(f"\n{backend}, all scenes: {more.sum() / plain.sum():.3f} of the time", end=" ")
    print(f"(median {np.median(more / plain):.3f}), at most {size.max():.3f} of the bytes")
    assert size.max() <= MOST_BYTES
    assert more.sum() / plain.sum() <= MOST_TIME


def test_the_parts_add_up(as_benchmark):
    """The mean over the image of variance less parts, in standard errors over blocks."""
    for scene in SCENES:
        samples = chd.render(scene, size=(64, 64), spp=SPP, seed=1, film=True, progress=False)
        print(scene, film_split(samples, progress=False))
