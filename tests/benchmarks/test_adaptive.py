"""What adaptive sampling gains at equal numbers of samples, and how well it knows its error.

``--benchmark-only -s`` prints, for each scene: the relMSE of adaptive renders over that of renders
with as many samples in each pixel, the first samples counted; the error (root of relMSE) that the
first samples predict, and the one that all samples estimate, over the true one; the bias of the
image with its standard error; and the largest number of samples of a pixel over the mean.
References have CHDSTAT_REFERENCE_SPP samples (8192) in 64 x 64 pixels. CHDSTAT_ADAPTIVE names other
scenes, CHDSTAT_SEEDS the number of seeds, CHDSTAT_SPP the samples; real scenes are found in
CHDSTAT_SCENES.
"""

import os
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.rendering.adaptive import error_of, expected_error
from chdstat.rendering.backend import resolve

BUILTIN = "caustic cornell-box many-lights night-room bathroom fog"
REAL = "bathroom/scene.xml veach-bidir/scene.xml veach-mis/scene.xml white-room/scene_night.xml"
SEEDS, SPP = int(os.environ.get("CHDSTAT_SEEDS", "8")), int(os.environ.get("CHDSTAT_SPP", "64"))
VIEW = {"size": (64, 64), "progress": False}
PARTS = int(os.environ.get("CHDSTAT_REFERENCE_SPP", "8192")) // 512


def relative(image, truth):
    """Return the relMSE of an image."""
    return ((image - truth) ** 2 / (truth**2 + 0.01 * truth.mean(axis=(0, 1)) ** 2)).mean()


def mean_of(samples):
    """Return the mean image."""
    return np.nanmean(samples.read(), axis=-1, dtype=np.float64)


def test_errors_of_adaptive_renders(as_benchmark):
    view = {**VIEW, "backend": resolve("auto").name}
    folder, ratios = Path(os.environ.get("CHDSTAT_SCENES", "")), []
    print(f"\n{SPP} spp, {SEEDS} seeds, {view['backend']}")
    print(f"{'scene':28}relMSE predicted estimated          bias  most")
    for name in os.environ.get("CHDSTAT_ADAPTIVE", f"{BUILTIN} {REAL}").split():
        scene = str(folder / name) if "." in name else name
        if "." in name and not Path(scene).is_file():
            continue
        parts = [mean_of(chd.render(scene, spp=512, seed=1000 + i, **view)) for i in range(PARTS)]
        truth, settings = np.mean(parts, axis=0), view | {"spp": SPP}
        equal = [
            relative(mean_of(chd.render(scene, seed=i, **settings)), truth) for i in range(SEEDS)
        ]
        found = [chd.render(scene, adaptive=True, seed=i, **settings) for i in range(SEEDS)]
        images = [mean_of(samples) for samples in found]
        errors = [relative(image, truth) for image in images]
        true = np.mean(errors) ** 0.5
        told = [
            np.median([each.value for each in values]) / true
            for values in (
                [expected_error(samples.attrs) for samples in found],
                [error_of(samples) for samples in found],
            )
        ]
        bias = np.array([image.mean() for image in images]) / truth.mean() - 1
        noise = np.std([part.mean() for part in parts]) / truth.mean() / PARTS**0.5
        deviation = np.hypot(bias.std(ddof=1) / SEEDS**0.5, noise)
        most = np.mean([samples.spp for samples in found]) / SPP
        ratios.append(np.mean(errors) / np.mean(equal))
        print(
            f"{name:28}{ratios[-1]:6.2f}{told[0]:10.2f}{told[1]:10.2f}"
            f"{bias.mean():+9.4f} ± {deviation:.4f}{most:5.1f}",
            flush=True,
        )
        assert abs(bias.mean()) < 4 * deviation
    if not ratios:
        pytest.skip("no scenes")
    print(f"{'geometric mean':28}{np.exp(np.mean(np.log(ratios))):6.2f}")
