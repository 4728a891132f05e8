"""The default estimate against Open Image Denoise from the mean, on scenes with other references.

For each scene and number of samples: MSE and relMSE over those of the better denoiser (with or
without features: the smaller product of both), without the noise of the reference; the bias of the
image, the share of estimates that got better than the mean, and the share of references in 90 %
intervals by thirds of brightness. Built-in scenes trained the network, those of CHDSTAT_SCENES did
not. Run with ``--benchmark-only -s``; CHDSTAT_REFERENCES names a folder that keeps the renders.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators.halves import Measured, candidates
from chdstat.rendering import render_batches

REAL = {
    "bathroom": "bathroom/scene.xml",
    "white room, day": "white-room/scene.xml",
    "white room, night": "white-room/scene_night.xml",
    "veach-bidir": "veach-bidir/scene.xml",
    "veach-mis": "veach-mis/scene.xml",
    "volumetric caustic": "volumetric-caustic/scene.xml",
}
BUILT_IN = ("bathroom", "fog", "many-lights", "night-room")
NUMBERS = 16, 64, 256
SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
REFERENCE_SPP = 2048


def scenes() -> dict[str, str]:
    folder = os.environ.get("CHDSTAT_SCENES")
    real = {} if folder is None else {n: str(Path(folder) / p) for n, p in REAL.items()}
    return {**real, **{f"{name} (built in)": name for name in BUILT_IN}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return Path(os.environ.get("CHDSTAT_REFERENCES") or tmp_path_factory.mktemp("references"))


def reference_of(folder: Path, name: str, scene: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a reference and its variance, of a seed that no estimate has."""
    path = folder / f"{name}.npz"
    if not path.exists():
        size = (128, 128)
        batches = render_batches(
            scene, spp=REFERENCE_SPP, batch=64, size=size, seed=12, progress=False
        )
        means = [batch.mean(axis=-1, dtype=np.float64) for batch in batches]
        variance = np.var(means, axis=0, ddof=1) / len(means)
        np.savez(path, ref=np.mean(means, axis=0), var=variance)
    held = np.load(path)
    return held["ref"], held["var"]


def test_errors_against_the_denoiser(as_benchmark, folder):
    rows = []
    print(f"\n{'scene':24s}{'spp':>5s}{'MSE':>7s}{'relMSE':>8s}{'bias':>8s}{'better':>8s}  90 %")
    for name, scene in scenes().items():
        reference, noise = reference_of(folder, name, scene)
        weight = 1 / (np.maximum(reference, 0) ** 2 + 0.01 * reference.mean() ** 2)

        def errors(image, reference=reference, noise=noise, weight=weight):
            squared = (image - reference) ** 2 - noise
            return np.array([squared.mean(), (squared * weight).mean()])

        for seed in range(SEEDS):
            store = chd.render(scene, spp=256, size=(128, 128), seed=31 + seed, progress=False)
            for n in NUMBERS:
                few = store.first(n)
                found = chd.estimate(few)
                made = candidates(Measured.of(few).starts[0], few.features)
                denoised = min(
                    (errors(made[k]) for k in ("denoised", "denoised with features")), key=np.prod
                )
                ratio = errors(found.radiance) / denoised
                mean = made["mean"]
                differ = np.abs(found.radiance - mean) > 1e-6 * np.abs(mean)
                closer = np.abs(found.radiance - reference) < np.abs(mean - reference)
                inside = (found.low <= reference) & (reference <= found.high)
                light = reference.mean(axis=-1)
                edges = np.quantile(light, [1 / 3, 2 / 3])
                thirds = [inside[np.digitize(light, edges) == k].mean() for k in range(3)]
                bias = found.radiance.mean() / reference.mean() - 1
                rows.append(ratio)
                print(
                    f"{name:24s}{n:5d}{ratio[0]:7.2f}{ratio[1]:8.2f}{bias:+8.1%}"
                    f"{closer[differ].mean():8.0%}  "
                    + " ".join(f"{share:.2f}" for share in thirds),
                    flush=True,
                )
    whole = np.exp(np.log(np.maximum(rows, 0.01)).mean(axis=0))
    worse = int((np.array(rows) > 1.02).any(axis=1).sum())
    print(f"geometric mean {whole[0]:.2f} {whole[1]:.2f}; above 1.02 in {worse} of {len(rows)}")


def test_time_against_rendering(as_benchmark):
    scene = scenes().get("bathroom", "bathroom")
    start, spent = time.perf_counter(), time.process_time()
    samples = chd.render(scene, spp=64, size=(256, 256), progress=False)
    rendered = time.perf_counter() - start, time.process_time() - spent
    chd.estimate(samples.isel(y=slice(64), x=slice(64)))  # the denoiser loads its network
    start, spent = time.perf_counter(), time.process_time()
    chd.estimate(samples)
    took = time.perf_counter() - start, time.process_time() - spent
    print(
        f"\n256 x 256 x 64: {took[0] / rendered[0]:.2f} of the time of rendering (target .5), "
        f"{took[1] / rendered[1]:.2f} of its processor time"
    )
