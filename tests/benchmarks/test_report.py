"""The main job from nothing: what a cold report costs, what its stages, and how much memory.

Child processes with an empty cache render a scene at 512 spp (`SPP`), and write its report. The
design wants at most 1.6 times the time of the processor that the render alone takes, 2.5 for a full
report, and less than 2 GB. Run with ``--benchmark-only -s``; CHDSTAT_SCENES names a folder of real
scenes, of which the white room by night has no recipe.
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
SPP = 512
MOST = {"short": 1.6, "full": 2.5}


@pytest.mark.parametrize("contents", ["short", "full"])
@pytest.mark.parametrize("backend", ["scalar", "auto"])
@pytest.mark.parametrize("scene", ["bathroom", pytest.param(str(REAL), marks=pytest.mark.external)])
def test_cold_report(benchmark, tmp_path, scene, backend, contents):
    if scene == str(REAL) and not REAL.is_file():
        pytest.skip("CHDSTAT_SCENES names no folder of real scenes")
    target = tmp_path / "report.pdf"
    script = Path(__file__).with_name("report_stages.py")

    def seconds_of(*what: str) -> dict[str, float]:
        told = subprocess.run(
            [sys.executable, str(script), scene, backend, str(SPP), *what],
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        ).stdout
        return json.loads(told.splitlines()[-1])

    render = seconds_of("render")["all"]
    seconds = benchmark.pedantic(lambda: seconds_of(contents, str(target)), rounds=1)
    whole, analysis = seconds.pop("all"), seconds["analysis"]
    # Of all children so far, the largest: the figures after the first are bounds.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(
        f"\n{contents} report of {Path(scene).stem}, {backend}: {whole:.0f} s of the processor, "
        f"{whole / render:.2f} of the render alone (target {MOST[contents]}), "
        f"{(whole - analysis) / render:.2f} without analyze; peak memory {peak:.2f} GiB "
        f"(target 2 GB), {target.stat().st_size / 1e6:.1f} MB PDF"
    )
    print(f"          {render:6.1f} s  render alone")
    for stage, took in seconds.items():
        print(f"  {took / render:6.2f}  {took:6.1f} s  {stage}")
