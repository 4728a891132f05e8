"""What `import chdstat` costs, as a multiple of `import numpy`; the design wants at most 3."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

ROUNDS = 10


def seconds(module: str) -> float:
    """Time an import in a fresh interpreter, without the start of the interpreter."""
    code = (
        "import time; start = time.perf_counter(); "
        f"import {module}; print(time.perf_counter() - start)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def test_import_against_numpy(benchmark):
    ratios: list[float] = []
    benchmark.pedantic(
        lambda: ratios.append(seconds("chdstat") / seconds("numpy")),
        rounds=ROUNDS,
        warmup_rounds=1,
    )
    ratio = statistics.median(ratios[1:])
    benchmark.extra_info["ratio"] = ratio
    print(f"\nimport chdstat costs {ratio:.2f} of import numpy (target 3)")


def test_start_of_the_interpreter_is_left_out():
    start = time.perf_counter()
    inside = seconds("sys")
    assert inside < (time.perf_counter() - start) / 4
