"""Recording: what keeping every pass costs, over drawing it.

Run with ``pytest benchmarks/test_recording.py --benchmark-only -s -n 0``. The renderer takes 5 ms
for 64 x 64 pixels, as fast ones do; the first of the pairs also pays for imports. What Cycles and
LuxCore pay is in `test_other_renderers`.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd

MOST_COST = 1.3
PASS = 0.005
"""Seconds of a pass."""


def draw(seed: int) -> np.ndarray:
    """Draw for as long as a fast renderer."""
    end = time.perf_counter() + PASS
    image = np.random.default_rng(seed).gamma(0.5, size=(64, 64, 3)).astype(np.float32)
    while time.perf_counter() < end:
        pass
    return image


@pytest.mark.parametrize("spp", [256, 1024])
def test_recording_costs_little(spp: int, benchmark, tmp_path: Path) -> None:
    ratios = []

    def measured() -> None:
        for turn in range(5):
            start = time.perf_counter()
            for seed in range(spp):
                draw(seed)
            alone = time.perf_counter() - start
            start = time.perf_counter()
            chd.record(draw, spp=spp, seed=turn, out=tmp_path / f"{turn}.zarr", progress=False)
            ratios.append((time.perf_counter() - start) / alone)

    benchmark.pedantic(measured, rounds=1)
    print(f"\n{spp} passes: {np.median(ratios):.2f} of drawing alone ({np.round(ratios, 2)})")
    assert spp == 256 or np.median(ratios) < MOST_COST
