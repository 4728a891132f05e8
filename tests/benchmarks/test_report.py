"""The main job from nothing: how long a cold report takes, how its stages, and how much memory.

A child process with an empty cache renders, analyses, trains, compares and typesets a scene at its
defaults. The design wants at most 1.6 times the time of its rendering, and less than 2 GB. Run with
``--benchmark-only -s``; CHDSTAT_SCENES names a folder of real scenes, of which the white room by
night has no recipe.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

REAL = Path(os.environ.get("CHDSTAT_SCENES", "")) / "white-room" / "scene_night.xml"


@pytest.mark.parametrize("backend", ["scalar", "auto"])
@pytest.mark.parametrize("scene", ["bathroom", pytest.param(str(REAL), marks=pytest.mark.external)])
def test_cold_report(benchmark, tmp_path, scene, backend):
    if scene == str(REAL) and not REAL.is_file():
        pytest.skip("CHDSTAT_SCENES names no folder of real scenes")
    target = tmp_path / "report.pdf"
    script = Path(__file__).with_name("report_stages.py")

    def report() -> str:
        return subprocess.run(
            [sys.executable, str(script), scene, backend, str(target)],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        ).stdout

    seconds = json.loads(benchmark.pedantic(report, rounds=1).splitlines()[-1])
    whole, render = seconds.pop("all"), seconds["rendering"]
    # Of all children so far, the largest: the figures after the first are bounds.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(
        f"\ncold report of {Path(scene).stem}, {backend}: {whole:.0f} s, {whole / render:.2f} of "
        f"rendering (target 1.6), peak memory {peak:.2f} GiB (target 2 GB), "
        f"{target.stat().st_size / 1e6:.1f} MB PDF"
    )
    for stage, took in seconds.items():
        print(f"  {took / render:6.2f}  {took:6.1f} s  {stage}")
