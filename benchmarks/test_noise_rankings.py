"""Memory and time of a report on three renders, over the time that the renders took.

Renders of the Cornell box, 256 x 256 pixels at 256 spp; CHDSTAT_SIZE and CHDSTAT_SPP set others. A
failure: the report takes more than 700 MB, or more than half of the processor time of the renders.
Run with ``--benchmark-only -s -n 0``.
"""

import os
import subprocess
import sys

from benchmarks.test_memory import WATCH

SIZE = os.environ.get("CHDSTAT_SIZE", "256x256")
SPP = os.environ.get("CHDSTAT_SPP", "256")
MOST_MB, MOST_TIME = 700, 0.5
RENDERS = {"path": ("--seed=1",), "short": ("--seed=2", "--max-depth=3"), "again": ("--seed=3",)}


def watched(*words: object) -> tuple[float, float]:
    """Return the largest resident memory of a command in MB, and seconds of processor time."""
    command = [sys.executable, "-m", "chdstat", *map(str, words), "-q"]
    done = subprocess.run(
        [sys.executable, "-c", WATCH, *command], capture_output=True, text=True, check=True
    )
    memory, seconds = map(float, done.stdout.split()[-2:])
    return memory / 1e3, seconds


def test_a_report_on_three_renders_takes_less_than_they_did(as_benchmark, tmp_path):
    stores = {name: tmp_path / f"{name}.zarr" for name in RENDERS}
    rendered = 0.0
    for name, options in RENDERS.items():
        about = (f"--size={SIZE}", f"--spp={SPP}", *options)
        rendered += watched("render", "cornell-box", "-o", stores[name], *about)[1]
    memory, seconds = watched("report", *stores.values(), "-o", tmp_path / "a.pdf")
    print(f"{SIZE} x {SPP} spp: {memory:.0f} MB, {seconds:.0f} s of processor time, "
          f"{seconds / rendered:.2f} of the {rendered:.0f} s of the renders")  # fmt: skip
    assert memory <= MOST_MB
    assert seconds <= MOST_TIME * rendered
