"""Peak memory of child processes by the number of samples: it does not follow them.

Samples are 96 x 96 pixels of a store. CHDSTAT_SPP, such as ``64,2048``, sets their numbers; the
last must not take more than 1.1 times the memory of the first in `analyze`, and of the one before
it in the others, some of which hold a batch at 64 and several later. Run with
``--benchmark-only -s -n 0``.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd

SPP = [*map(int, os.environ.get("CHDSTAT_SPP", "64,512,2048").split(","))]
MOST = 1.1
RUN = """
import sys, warnings
import chdstat as chd
warnings.simplefilter("ignore")
store, out = sys.argv[1:]
{}
print(*(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
STAGES = {
    "analyze": "chd.analyze(store, progress=False)",
    "classify": "chd.classify(store, progress=False)",
    "atlas": "chd.atlas(store, progress=False)",
    "contrast": "chd.contrast(store, store)",
    "report": "chd.report(store, out)",
}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Return stores of gamma samples by their samples per pixel; a third of the samples is null."""
    folder, found = tmp_path_factory.mktemp("memory"), {}
    for spp in SPP:
        rng = np.random.default_rng(spp)
        x = np.empty((96, 96, 3, spp), np.float32)
        for row in x:
            row[...] = rng.gamma(0.7, size=row.shape) * (rng.random((96, 1, spp)) > 1 / 3)
        found[spp] = chd.Samples.from_array(x).save(folder / f"{spp}.zarr").path
    return found


def peak(stage: str, store: Path, out: Path) -> float:
    """Return the largest resident memory of a process in MB."""
    command = [sys.executable, "-c", RUN.format(STAGES[stage]), str(store), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(done.stdout.split()[-1]) / 1e3


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
@pytest.mark.parametrize("stage", STAGES)
def test_memory_does_not_follow_spp(as_benchmark, stage, stores, tmp_path):
    found = {spp: peak(stage, store, tmp_path / "out.pdf") for spp, store in stores.items()}
    base = SPP[0] if stage == "analyze" else SPP[-2]
    ratio = found[SPP[-1]] / found[base]
    told = ", ".join(f"{mb:.0f} MB at {spp} spp" for spp, mb in found.items())
    print(f"\n{stage}: {told}; {SPP[-1]} over {base}: {ratio:.2f}", end="")
    assert ratio <= MOST
