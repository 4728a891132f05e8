"""What it costs a path tracer to keep its samples, and what it costs to read them."""

from __future__ import annotations

import resource
import shutil
import statistics
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd

TRACER = Path(__file__).parents[2] / "docs/how-to/cpp/tracer.cpp"
ROUNDS = 9

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not there")


@pytest.fixture(scope="module")
def tracer(tmp_path_factory):
    program = tmp_path_factory.mktemp("cpp") / "tracer"
    include = f"-I{chd.io.get_include()}"
    command = ["g++", "-O2", "-std=c++17", "-pthread", include, TRACER, "-o", program]
    subprocess.run(command, check=True)
    return program


def seconds(command):
    """Return the processor time of a command, that of the system with it."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(list(map(str, command)), check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_writing_against_tracing(as_benchmark, tracer, tmp_path):
    size = (192, 192, 128)
    ratios = [
        seconds([tracer, tmp_path / "x.chds", *size]) / seconds([tracer, "-", *size])
        for _ in range(ROUNDS)
    ]
    ratio = statistics.median(ratios)
    print(f"\nkeeping its samples costs a path tracer {ratio - 1:.1%} of its time (target 5 %)")
    assert ratio < 1.05


def test_reading_against_raw_bytes(as_benchmark, tracer, tmp_path):
    stream, array = tmp_path / "x.chds", tmp_path / "x.npy"
    subprocess.run([tracer, stream, "256", "256", "256"], check=True)
    np.save(array, chd.io.read(stream).read())

    def spent(action):
        found = []
        for _ in range(5):
            start = time.process_time()
            action()
            found.append(time.process_time() - start)
        return statistics.median(found)

    def save(path):
        shutil.rmtree(tmp_path / "own.zarr", ignore_errors=True)
        chd.io.read(path, axes="yxcs" if path == array else None).save(tmp_path / "own.zarr")

    raw = spent(lambda: np.fromfile(stream, np.float32))
    walk = spent(lambda: [None for _ in chd.io.read(stream).blocks()])
    of_stream, of_array = spent(lambda: save(stream)), spent(lambda: save(array))
    print(
        f"\nreading all samples takes {walk / raw:.2f} of reading the raw bytes (target 3); "
        f"importing them {of_stream / of_array:.2f} of importing an array"
    )
    assert walk < 3 * raw
    assert of_stream < 3 * of_array
