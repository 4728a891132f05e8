"""Peak memory of commands by the number of samples: it does not follow them.

Samples are simulated, in a store of 96 x 96 pixels; CHDSTAT_SIZE sets another size, CHDSTAT_SPP,
such as ``64,2048``, the numbers of samples. A failure: the last takes more than 1.1 times the
memory of the first in `analyze`, or of the one before it in the others, some of which hold a batch
at 64 and several later. Training may take more: the samples of the pixels that train. Run with
``--benchmark-only -s -n 0``.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

import chdstat as chd
from chdstat.samples.store import Store

WIDTH, HEIGHT = map(int, os.environ.get("CHDSTAT_SIZE", "96x96").split("x"))
SPP = [*map(int, os.environ.get("CHDSTAT_SPP", "64,512,2048").split(","))]
MOST = 1.1
WATCH = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True)
spent = resource.getrusage(resource.RUSAGE_CHILDREN)
print(spent.ru_maxrss, spent.ru_utime + spent.ru_stime)
"""
COMMANDS = {
    "analyze": "analyze {store} -o {out}.zarr",
    "atlas": "atlas {store}",
    "classify": "classify {store}",
    "contrast": "contrast {store} {store}",
    "estimate": "estimate {store} -o {out}.exr",
    "train": "train {store} --iterations=200 -o {out}.safetensors",
    "report": "report {store} -e mean -o {out}.pdf",
    "study": "study {store} -e mean -o {out}.pdf",
    "while-rendering": "estimate cornell-box --while-rendering {drawn} -o {out}.exr",
    "summary-only": "render cornell-box --summary-only {drawn} -o {out}.zarr",
}
FUNCTIONS = ("atlas", "classify", "contrast")
"""Those that are called from Python; as a command, the contrast of a store and itself fails."""
CALL = "import sys, chdstat as chd; getattr(chd, sys.argv[1])(*sys.argv[2:])"


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Return stores of gamma samples by their spp, half of them null, written chunk by chunk."""
    folder = tmp_path_factory.mktemp("memory")
    like = chd.render("cornell-box", spp=1, size=(WIDTH, HEIGHT), progress=False)
    for spp in SPP:
        rng, about = np.random.default_rng(spp), {**like.attrs, "spp": spp}
        shape = (HEIGHT, WIDTH, 3, spp)
        with Store.create(
            folder / f"{spp}.zarr", shape=shape, attrs=about, features=like.features
        ) as made:
            for chunk in made.pending():
                height, width, n = chunk.shape
                lit = rng.random((height, width, 1, n)) < 0.5
                grey = lit * rng.gamma(0.5, size=lit.shape)
                coloured = grey * np.array([1, 0.5, 0.2])[:, np.newaxis]
                made.write(chunk, coloured.astype(np.float32))
    return folder


def peak(stage: str, **values: object) -> tuple[float, float]:
    """Return the largest resident memory of a command in MB, and seconds of processor time."""
    words = COMMANDS[stage].format(**values).split()
    command = ["-c", CALL, *words] if stage in FUNCTIONS else ["-m", "chdstat", *words, "-q"]
    whole = [sys.executable, "-c", WATCH, sys.executable, *command]
    done = subprocess.run(whole, capture_output=True, text=True, check=True)
    memory, seconds = map(float, done.stdout.split()[-2:])
    return memory / 1e3, seconds


@pytest.mark.parametrize("stage", COMMANDS)
def test_memory_does_not_follow_spp(as_benchmark, stage, stores, tmp_path):
    found = {}
    for spp in SPP:
        drawn = f"--size={WIDTH}x{HEIGHT} --spp={spp}"
        of = {"store": stores / f"{spp}.zarr", "drawn": drawn, "out": tmp_path / f"{spp}"}
        found[spp] = peak(stage, **of)
    base = SPP[0] if stage == "analyze" else SPP[-2]
    least, most = found[base][0], found[SPP[-1]][0]
    trains = min(6400, WIDTH * HEIGHT // 2) * 3 * SPP[-1] * 4 / 1e6 if stage == "train" else 0
    told = ", ".join(f"{mb:.0f} MB, {s:.1f} s at {spp} spp" for spp, (mb, s) in found.items())
    print(
        f"\n{stage} of {WIDTH} x {HEIGHT}: {told}; {SPP[-1]} over {base}: {most / least:.2f}",
        end="",
    )
    assert most <= MOST * least + trains
