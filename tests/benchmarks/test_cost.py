"""How the cost of each stage grows with pixels and with samples, as exponents of processor time.

Run with ``--benchmark-only -s -n 0``; CHDSTAT_EDGES, such as ``64,128,256,512``, and
CHDSTAT_COUNTS, such as ``64,256,1024,4096``, set edges of images and samples of a pixel.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd

EDGES = [int(n) for n in os.environ.get("CHDSTAT_EDGES", "32,64,128").split(",")]
COUNTS = [int(n) for n in os.environ.get("CHDSTAT_COUNTS", "64,256,1024").split(",")]
STAGES: dict[str, Callable[[Path], object]] = {
    "open": chd.open,
    "summarize": lambda path: chd.summarize(path, progress=False),
    "analyze": lambda path: chd.analyze(path, progress=False),
    "estimate": lambda path: chd.estimate(path, progress=False),
    "fits of summaries": lambda path: chd.fit.select(MAPS[path], progress=False),
}
MAPS: dict[Path, object] = {}


def taken(folder: Path, edge: int, spp: int) -> dict[str, float]:
    """Return the processor time of each stage."""
    path = folder / f"{edge}-{spp}.zarr"
    settings = {"size": (edge, edge), "spp": spp, "backend": "scalar", "progress": False}
    found, start = {}, time.process_time()
    chd.render("bathroom", out=path, **settings)
    found["render"] = time.process_time() - start
    MAPS[path] = chd.summarize(path, progress=False)
    for name, stage in STAGES.items():
        start = time.process_time()
        stage(path)
        found[name] = time.process_time() - start
    return found


@pytest.mark.parametrize("axis", ["pixels", "samples"])
def test_cost_grows_as_the_work(as_benchmark, tmp_path, axis):
    taken(tmp_path, 16, 32)  # what is loaded and cached once
    sizes = [(e, COUNTS[0]) for e in EDGES] if axis == "pixels" else [(EDGES[1], n) for n in COUNTS]
    rows = [taken(tmp_path, *size) for size in sizes]
    work = np.log([edge**2 if axis == "pixels" else spp for edge, spp in sizes])
    print(f"\n{axis}: edge, spp " + ", ".join(f"{edge}, {spp}" for edge, spp in sizes))
    for name in rows[0]:
        seconds = np.array([row[name] for row in rows])
        steps = np.diff(np.log(seconds)) / np.diff(work)
        slope = np.polyfit(work, np.log(seconds), 1)[0]
        print(
            f"{name:18}" + "".join(f"{s:9.2f}" for s in seconds) + f"   exponent {slope:.2f}, "
            f"at the end {steps[-1]:.2f}"
        )
