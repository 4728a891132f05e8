"""What it costs to keep where in its pixel each sample fell, and what is told by that.

Run with ``pytest benchmarks/test_film.py --benchmark-only -s -n 0``: ten minutes on a quiet core;
CHDSTAT_SPP sets other samples than 256 in a pixel of the timed renders, and CHDSTAT_SCENES names a
folder of more scenes. Times are of the processor. Renders with and without take turns; a busy
machine changes their ratio, but hardly that of a render's time to the time before its places, which
is what is asserted. A failure: a store of more than 1.35 times its size; of all scenes together a
render of more than 1.05 times its time; parts that do not add up.
"""

import os
import shutil
import statistics
import time
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.patterns import film_split
from chdstat.rendering import renders

SCENES = tuple(chd.scenes.BUILTIN)
SIZE, ROUNDS = (128, 128), 3
SPP = int(os.environ.get("CHDSTAT_SPP", "256"))
MOST_BYTES, MOST_TIME = 1.35, 1.05


@pytest.fixture
def of_places(monkeypatch):
    """Return a list of the seconds of processor time that renders spend on places."""
    draw, spent = renders._part, []

    def timed(*given, **options):
        begin = time.process_time()
        found = draw(*given, **options)
        spent.append(time.process_time() - begin)
        return found

    monkeypatch.setattr(renders, "_part", timed)
    return spent


def spent(scene, out, **options):
    """Return the seconds of processor time of a render, and the bytes of its store."""
    shutil.rmtree(out, ignore_errors=True)
    begin = time.process_time()
    chd.render(scene, out=out, progress=False, **options)
    seconds = time.process_time() - begin
    return seconds, sum(file.stat().st_size for file in out.rglob("*") if file.is_file())


def cost(scene, out, of_places, **options):
    """Return the median times without and with places, their share, and the ratio of stores."""
    plain, more, shares, sizes = [], [], [], {}
    for turn in range(ROUNDS):
        for film in (turn % 2 == 1, turn % 2 == 0):
            seconds, sizes[film] = spent(scene, out, film=film, **options)
            (more if film else plain).append(seconds)
            if film:
                shares.append(seconds / (seconds - of_places[-1]))
    found = map(statistics.median, (plain, more, shares))
    return *found, sizes[True] / sizes[False]


@pytest.mark.parametrize("backend", ["llvm", "scalar"])
def test_the_cost_of_places(as_benchmark, tmp_path, of_places, backend):
    scenes, view = SCENES if backend == "llvm" else SCENES[:3], {"size": SIZE, "spp": SPP}
    out = tmp_path / "a.zarr"
    spent(scenes[0], out, backend=backend, size=(8, 8), spp=16, film=True)  # imports
    found = {s: cost(s, out, of_places, backend=backend, **view) for s in scenes}
    for scene, (plain, more, share, size) in found.items():
        print(f"\n{backend} {scene:12} {plain:6.2f} s, with places {more / plain:.3f}", end=" ")
        print(f"of the time ({share:.3f} within one), {size:.3f} of the bytes", end="")
    plain, more, share, size = np.array(list(found.values())).T
    mean = float((share * plain).sum() / plain.sum())
    print(f"\n{backend}, all scenes: {more.sum() / plain.sum():.3f} of the time", end=" ")
    print(f"({mean:.3f} within one), at most {size.max():.3f} of the bytes")
    assert size.max() <= MOST_BYTES
    assert mean <= MOST_TIME


def test_the_parts_add_up(as_benchmark):
    """Variance less its parts, mean over the pixels, in standard errors.

    A right split is beyond 2 errors in 1 of 20 scenes, beyond 3.5 in any of 13 by 1 of 160.
    """
    folder = Path(os.environ.get("CHDSTAT_SCENES", "none"))
    real = [str(file) for file in sorted(folder.glob("*/scene.xml"))]
    print()
    for scene in (*SCENES, *real):
        samples = chd.render(scene, size=(64, 64), spp=256, seed=1, film=True, progress=False)
        split = film_split(samples, progress=False)
        variance, paths, places = (split[n].to_numpy() for n in ("variance", "paths", "places"))
        rest = (paths + places - variance)[split["reason"].to_numpy() == 0].astype(float)
        off = rest.mean() / (rest.std(ddof=1) / len(rest) ** 0.5)
        share = np.nanmean(places) / np.nanmean(paths + places)
        median = float(split["share"].median())
        name = Path(scene).parent.name or scene
        print(f"{name:18} parts less variance {off:+.2f} standard errors of", end=" ")
        print(f"{abs(rest.mean()) / np.nanmean(variance):.1e} of the variance;", end=" ")
        print(f"between places {share:.3f} of it, in the median pixel {median:.3f}")
        assert abs(off) < 3.5
