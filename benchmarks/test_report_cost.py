"""What a short report costs beside the render that it is about, and the memory that it takes.

The bathroom and the fog are rendered as a report renders them, 128 x 128 pixels with 512 spp, with
the places where samples fell; CHDSTAT_SIZE and CHDSTAT_SPP set others. The third store has as many
own samples, of null-heavy log-normal laws; its report is compared with the render of the bathroom.
Every command runs in a process of its own, so that its peak memory is its own; times are of the
processor, which a busy machine stretches least. A failure: a report takes more than 1.5 times its
render, or 700 MB.
Run with ``pytest benchmarks/test_report_cost.py --benchmark-only -s -n 0``.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

import chdstat as chd

WIDTH, HEIGHT = map(int, os.environ.get("CHDSTAT_SIZE", "128x128").split("x"))
SPP = int(os.environ.get("CHDSTAT_SPP", "512"))
MOST, MEMORY = 1.5, 700e6
WATCH = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, capture_output=True)
spent = resource.getrusage(resource.RUSAGE_CHILDREN)
print(spent.ru_maxrss, spent.ru_utime + spent.ru_stime)
"""


def cost(*asked):
    """Return the seconds of processor time and the peak memory in bytes of a command."""
    command = [sys.executable, "-c", WATCH, sys.executable, "-m", "chdstat", *map(str, asked)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return float(told[1]), 1024 * int(told[0])


@pytest.fixture(scope="module")
def renders(tmp_path_factory):
    """Return stores by name, each with what its render took."""
    folder, size = tmp_path_factory.mktemp("report"), ("--size", f"{WIDTH}x{HEIGHT}")
    made = {}
    for name in ("bathroom", "fog"):
        store = folder / f"{name}.zarr"
        made[name] = store, cost("render", name, "-o", store, "--film", "--spp", SPP, *size, "-q")
    rng = np.random.default_rng(0)
    sigma = np.linspace(0.2, 2.0, WIDTH)[:, np.newaxis]
    x = np.exp(rng.standard_normal((HEIGHT, WIDTH, SPP), np.float32) * sigma)
    x *= rng.random(x.shape, np.float32) < np.linspace(0.05, 1, HEIGHT)[:, np.newaxis, np.newaxis]
    grey = np.repeat(x[:, :, np.newaxis], 3, axis=2).astype(np.float32)
    chd.Samples.from_array(grey).save(folder / "own.zarr")
    return made | {"own samples": (folder / "own.zarr", made["bathroom"][1])}


@pytest.mark.parametrize("name", ["bathroom", "fog", "own samples"])
def test_a_report_costs_little_beside_its_render(as_benchmark, renders, tmp_path, name):
    store, (rendered, _) = renders[name]
    seconds, memory = cost("report", store, "-o", tmp_path / "report.pdf", "-q")
    print(
        f"\n{name}: render {rendered:.1f} s, report {seconds:.1f} s, {seconds / rendered:.2f} "
        f"times; peak memory {memory / 1e6:.0f} MB"
    )
    assert seconds <= MOST * rendered
    assert memory <= MEMORY
