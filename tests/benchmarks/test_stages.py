"""Processor time and memory of each stage, beside another version where CHDSTAT_BASE names it.

Each runs in a process of its own, both versions by turns, as a busy machine slows down whoever
runs; what counts is the least of CHDSTAT_ROUNDS. Run with ``--benchmark-only -s -n 0``.
"""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("stage_cost.py")
ROUNDS = int(os.environ.get("CHDSTAT_ROUNDS", "3"))


def cost(package: Path, stage: str) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, SCRIPT, stage]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("stage", runpy.run_path(str(SCRIPT))["STAGES"])
def test_stage(as_benchmark, stage):
    base = os.environ.get("CHDSTAT_BASE")
    places = [Path(__file__).parents[2], *([Path(base)] if base else [])]
    runs = [[cost(place, stage) for place in places] for _ in range(ROUNDS)]
    for unit in ("s", "MB"):
        least = [min(run[i][unit] for run in runs) for i in range(len(places))]
        beside = f", before {least[1]:.2f}, ratio {least[0] / least[1]:.2f}" if base else ""
        print(f"\n{stage}: {least[0]:.2f} {unit}{beside}", end="")
