"""What path guiding gains: errors over those of the scene's own integrator, and its cost.

``--benchmark-only -s`` prints, for each scene, relMSE and MSE over those of path tracing with as
many samples, the time of a sample over its time, the relMSE at equal time of both (as if the error
fell with the samples), training included, and the bias with its standard error. References have
4096 spp. CHDSTAT_GUIDED names other scenes, CHDSTAT_SEEDS the number of seeds, CHDSTAT_SPP the
samples; real scenes are found in CHDSTAT_SCENES.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.rendering.backend import resolve

SCENES = "caustic night-room bathroom/scene.xml veach-bidir/scene.xml white-room/scene_night.xml"
SEEDS, SPP = int(os.environ.get("CHDSTAT_SEEDS", "5")), int(os.environ.get("CHDSTAT_SPP", "64"))
VIEW = {"size": (128, 128), "backend": "llvm", "progress": False}


def rendered(scene: str, **settings: Any) -> tuple[np.ndarray, float]:
    """Return the mean image, and the seconds that it took."""
    start = time.perf_counter()
    samples = chd.render(scene, **VIEW, **settings)
    return samples.read().mean(axis=-1, dtype=np.float64), time.perf_counter() - start


def errors(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return MSE and relMSE."""
    squared = (image - truth) ** 2
    return np.array([squared.mean(), (squared / (truth**2 + 0.01 * truth.mean() ** 2)).mean()])


def test_errors_of_guided_renders(as_benchmark):
    if resolve("auto").name == "scalar":
        pytest.skip("guided renders need the llvm or cuda backend")
    folder = Path(os.environ.get("CHDSTAT_SCENES", ""))
    print(f"\n{SPP} spp, {SEEDS} seeds\n{'scene':28}   MSE relMSE  time  equal time    bias")
    for name in os.environ.get("CHDSTAT_GUIDED", SCENES).split():
        scene = str(folder / name) if "." in name else name
        if "." in name and not Path(scene).is_file():
            continue
        parts = [rendered(scene, spp=512, seed=100 + i)[0] for i in range(8)]
        truth, found = np.mean(parts, axis=0), {}
        for integrator in (None, "guided"):
            runs = [rendered(scene, spp=SPP, seed=i, integrator=integrator) for i in range(SEEDS)]
            found[integrator] = (
                np.mean([errors(image, truth) for image, _ in runs], axis=0),
                np.median([seconds for _, seconds in runs]),
                [image.mean() / truth.mean() - 1 for image, _ in runs],
            )
        ratio, cost = (found["guided"][i] / found[None][i] for i in (0, 1))
        bias = np.array(found["guided"][2])
        print(
            f"{name:28}{ratio[0]:6.2f}{ratio[1]:7.2f}{cost:6.2f}{ratio[1] * cost:12.2f}"
            f"{bias.mean():+8.3f} ± {bias.std(ddof=1) / len(bias) ** 0.5:.3f}"
        )
