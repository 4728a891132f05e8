"""The main job from nothing: how long a cold report takes, and how much memory at its peak.

A child process with an empty cache renders, analyses, trains, compares and typesets the bathroom at
its defaults. The design wants at most 90 s on 2 cores and less than 2 GB. Run with
``--benchmark-only -s``.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import pytest

COMMAND = "from chdstat.cli import main; main()"


@pytest.mark.parametrize("backend", ["scalar", "auto"])
def test_cold_report(benchmark, tmp_path, backend):
    target = tmp_path / "report.pdf"
    arguments = ("report", "bathroom", "-o", str(target), "--backend", backend, "--quiet")

    def report() -> None:
        subprocess.run(
            [sys.executable, "-c", COMMAND, *arguments],
            check=True,
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        )

    benchmark.pedantic(report, rounds=1)
    # Of all children so far, the largest: the second figure is a bound where the first is larger.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(
        f"\ncold report, {backend}: {benchmark.stats.stats.mean:.0f} s (target 90), "
        f"peak memory {peak:.2f} GiB (target 2 GB), {target.stat().st_size / 1e6:.1f} MB PDF"
    )
