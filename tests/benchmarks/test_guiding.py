"""What path guiding gains: errors over those of the scene's own integrator, and its cost.

``--benchmark-only -s`` prints, for each scene, MSE and relMSE over those of path tracing with as
many samples, of all pixels and without the hundredth of them that has the largest errors (single
fireflies decide the former), the processor time over its time, training included, the trimmed
relMSE at equal time of both (as if the error fell with the samples), the bias with its standard
error, and how often ``integrator="auto"`` guides. References have 4096 spp. CHDSTAT_GUIDED names
other scenes, CHDSTAT_SEEDS the number of seeds, CHDSTAT_SPP the samples, CHDSTAT_SIZE the edge of
the image; real scenes are found in CHDSTAT_SCENES.
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
SEEDS, SPP, EDGE = (
    int(os.environ.get(f"CHDSTAT_{name}", number))
    for name, number in (("SEEDS", 5), ("SPP", 64), ("SIZE", 128))
)
VIEW = {"size": (EDGE, EDGE), "backend": "llvm", "progress": False}


def rendered(scene: str, **settings: Any) -> tuple[np.ndarray, float, str | None]:
    """Return the mean image, the seconds of the processor that it took, and its guide."""
    start = time.process_time()
    samples = chd.render(scene, **VIEW, **settings)
    image = samples.read().mean(axis=-1, dtype=np.float64)
    return image, time.process_time() - start, samples.attrs["guide"]


def errors(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return MSE and relMSE, and relMSE without the hundredth of pixels of the largest errors."""
    squared = (image - truth) ** 2
    relative = squared / (truth**2 + 0.01 * truth.mean() ** 2)
    usual = np.sort(relative, axis=None)[: int(0.99 * relative.size)]
    return np.array([squared.mean(), relative.mean(), usual.mean()])


def test_errors_of_guided_renders(as_benchmark):
    if resolve("auto").name == "scalar":
        pytest.skip("guided renders need the llvm or cuda backend")
    folder = Path(os.environ.get("CHDSTAT_SCENES", ""))
    print(f"\n{EDGE} x {EDGE} x {SPP} spp, {SEEDS} seeds")
    print(f"{'scene':28}   MSE relMSE  of 99%  time  equal time  guided by auto    bias")
    for name in os.environ.get("CHDSTAT_GUIDED", SCENES).split():
        scene = str(folder / name) if "." in name else name
        if "." in name and not Path(scene).is_file():
            continue
        truth = np.mean([rendered(scene, spp=512, seed=100 + i)[0] for i in range(8)], axis=0)
        plain, guided, auto = (
            [rendered(scene, spp=spp, seed=i, integrator=integrator) for i in range(SEEDS)]
            for spp, integrator in ((SPP, None), (SPP, "guided"), (1, "auto"))
        )
        ratio = np.divide(*(sum(errors(x, truth) for x, *_ in runs) for runs in (guided, plain)))
        cost = np.divide(*(np.median([s for _, s, _ in runs]) for runs in (guided, plain)))
        bias = np.array([image.mean() / truth.mean() - 1 for image, *_ in guided])
        print(
            f"{name:28}{ratio[0]:6.2f}{ratio[1]:7.2f}{ratio[2]:8.2f}{cost:6.2f}"
            f"{ratio[2] * cost:12.2f}{sum(g is not None for *_, g in auto):11} of {SEEDS}"
            f"{bias.mean():+13.3f} ± {bias.std(ddof=1) / len(bias) ** 0.5:.3f}",
            flush=True,
        )
