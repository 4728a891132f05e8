"""Processor time and memory of each stage, beside the version whose folder CHDSTAT_BASE names.

Each runs in a process of its own, both versions by turns, as a busy machine slows down whoever
runs; what counts is the least of CHDSTAT_ROUNDS. Samples are 512 in each pixel, drawn by the
backend that CHDSTAT_BACKEND names. A failure: a tenth more time, or a twentieth more memory. Run
with ``--benchmark-only -s -n 0``.
"""

import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROUNDS = int(os.environ.get("CHDSTAT_ROUNDS", "3"))
LARGE = {"spp": 512, "backend": os.environ.get("CHDSTAT_BACKEND", "scalar"), "progress": False}
MOST = {"s": 1.1, "MB": 1.05}
SMALL = {**LARGE, "size": (48, 48)}
STAGES: dict[str, Callable[[Any, Path], Any]] = {
    "import": lambda *_: None,
    "render": lambda chd, place: chd.render("bathroom", out=place / "b", size=(128, 128), **LARGE),
    "report": lambda chd, place: chd.report("bathroom", place / "r.pdf", **LARGE),
    "full report": lambda chd, place: chd.report(
        "bathroom", place / "r.pdf", contents="full", **LARGE
    ),
    "save": lambda chd, place: chd.open(place / "one").load().save(place / "b", progress=False),
    "read": lambda chd, place: chd.open(place / "one").read(),
    "pixel": lambda chd, place: chd.open(place / "one")[17, 23],
    "summarize": lambda chd, place: chd.summarize(chd.open(place / "one"), progress=False),
    "mixture": lambda chd, place: chd.fit.mixture(chd.open(place / "one"), progress=False),
    "modality": lambda chd, place: chd.modality(chd.open(place / "one"), progress=False),
    "analyze": lambda chd, place: chd.analyze(chd.open(place / "one"), progress=False),
    "estimate": lambda chd, place: chd.estimate(chd.open(place / "one"), progress=False),
    "contrast": lambda chd, place: chd.contrast(place / "one", place / "two"),
}


def measured(stage: str, place: Path) -> dict[str, float]:
    """Return what a stage costs in this process, after Mitsuba is loaded and caches are filled."""
    start = time.process_time()
    import chdstat as chd

    if stage != "import":
        small = chd.render("bathroom", seed=3, **{**SMALL, "size": (8, 8)})
        chd.analyze(small, progress=False)
        for seed, name in enumerate(("one", "two")):
            chd.render("bathroom", seed=seed, out=place / name, **SMALL)
        gc.collect()  # or its turn may come in the stage
        start = time.process_time()
    STAGES[stage](chd, place)
    seconds = time.process_time() - start
    return {"s": seconds, "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


def cost(package: Path, stage: str) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, __file__, stage]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.skipif("CHDSTAT_BASE" not in os.environ, reason="CHDSTAT_BASE names no other version")
@pytest.mark.parametrize("stage", STAGES)
def test_stage(as_benchmark, stage):
    places = Path(__file__).parents[1], Path(os.environ["CHDSTAT_BASE"])
    runs = [[cost(place, stage) for place in places] for _ in range(ROUNDS)]
    ratios = {}
    for unit in MOST:
        now, before = (min(run[i][unit] for run in runs) for i in range(2))
        ratios[unit] = now / before
        print(f"\n{stage}: {now:.3f} {unit}, before {before:.3f}, ratio {ratios[unit]:.2f}", end="")
    assert all(ratio <= MOST[unit] for unit, ratio in ratios.items())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measured(sys.argv[1], Path(folder))))
