"""Speed of stores, beside that of another version where CHDSTAT_BASE names its checkout."""

import json
import os
import subprocess
import sys
from pathlib import Path

CLICK = 50
"""Milliseconds in which a click in the explorer has its pixel."""
SLOWER = 1.1


def measured(package: Path, place: Path) -> dict[str, float]:
    script = Path(__file__).parent / "store_speed.py"
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, script, place]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(found.stdout)


def test_speed_of_stores(as_benchmark, tmp_path):
    base = os.environ.get("CHDSTAT_BASE")
    # By turns, as a busy machine slows down whoever runs.
    places = [Path(__file__).parents[2], *([Path(base)] if base else [])] * 3
    runs = [measured(p, tmp_path / f"{i}.zarr") for i, p in enumerate(places)]
    step = 2 if base else 1
    here, there = (
        {k: min(r[k] for r in part) for k in part[0]}
        for part in (runs[::step], runs[step - 1 :: step])
    )
    print("\n128 x 128 pixels, 1024 and then 1280 spp; ms of processor time")
    for name, took in here.items():
        print(
            f"{name:8}{took:8.1f}"
            + (f"{there[name]:8.1f}{took / there[name]:6.2f}" if base else "")
        )
    assert here["click"] < CLICK
    for pair in (("open", "read"), ("write", "append")):
        assert sum(here[n] for n in pair) < SLOWER * sum(there[n] for n in pair)
