"""The default estimate against Open Image Denoise from the mean, on scenes with other references.

For each scene and number of samples: MSE and relMSE over those of the better denoiser (with or
without features: the smaller product of both) and over the mean's, without the noise of the
reference; the bias of the image, and the share of 90 % intervals that hold the truth, by thirds of
brightness, without that noise, too.
Built-in scenes trained the network, those of CHDSTAT_SCENES did not. Run with
``--benchmark-only -s``; CHDSTAT_REFERENCES names a folder that keeps the renders,
CHDSTAT_REFERENCE_SPP their samples, CHDSTAT_FILM the edge of the images, CHDSTAT_NAMES some of the
scenes, apart by semicolons, CHDSTAT_NUMBERS the samples of an estimate, apart by commas,
CHDSTAT_SEEDS how many seeds.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import Interval, Judge
from chdstat.comparison.judges import PARTS
from chdstat.estimators import Combination
from chdstat.estimators.default_estimate.candidates import Measured, candidates, through_denoiser
from chdstat.rendering import render_batches
from chdstat.studies.claims import SceneData

REAL = {
    "bathroom": "bathroom/scene.xml",
    "white room, day": "white-room/scene.xml",
    "white room, night": "white-room/scene_night.xml",
    "veach-bidir": "veach-bidir/scene.xml",
    "veach-mis": "veach-mis/scene.xml",
    "volumetric caustic": "volumetric-caustic/scene.xml",
}
BUILT_IN = ("bathroom", "fog", "many-lights", "night-room")
NUMBERS = tuple(int(n) for n in os.environ.get("CHDSTAT_NUMBERS", "16,64,256").split(","))
SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
REFERENCE_SPP = int(os.environ.get("CHDSTAT_REFERENCE_SPP", "4096"))
SIZE = int(os.environ.get("CHDSTAT_FILM", "128"))


def scenes() -> dict[str, str]:
    folder = os.environ.get("CHDSTAT_SCENES")
    real = {} if folder is None else {n: str(Path(folder) / p) for n, p in REAL.items()}
    found = {**real, **{f"{name} (built in)": name for name in BUILT_IN}}
    names = os.environ.get("CHDSTAT_NAMES")
    return {name: found[name] for name in (names.split(";") if names else found)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return Path(os.environ.get("CHDSTAT_REFERENCES") or tmp_path_factory.mktemp("references"))


def reference_of(folder: Path, name: str, scene: str) -> Judge:
    """Return a reference of a seed that no estimate has."""
    path = folder / f"{name}-{SIZE}-{REFERENCE_SPP}-parts.npz"
    if not path.exists():
        size = (SIZE, SIZE)
        batches = render_batches(
            scene, spp=REFERENCE_SPP, batch=64, size=size, seed=12, progress=False
        )
        means = np.stack([batch.mean(axis=-1, dtype=np.float64) for batch in batches])
        parts = np.stack([means[k::PARTS].mean(axis=0) for k in range(PARTS)])
        np.savez(path, parts=parts)
    parts = np.load(path)["parts"]
    error = parts.std(axis=0, ddof=1) / np.sqrt(PARTS)
    return Judge.of_image(parts, error, parts.mean(axis=(0, 1, 2)))


def better_of(errors: dict[str, np.ndarray], *names: str) -> np.ndarray:
    """Return squared errors (pixel, 2) of the image whose product of both errors is the least."""
    return min((errors[name] for name in names), key=lambda e: np.prod(e.mean(axis=0)))


def over(samples: chd.Samples, one: np.ndarray, other: np.ndarray) -> list[Interval[float]]:
    """Return MSE and relMSE over those of another image."""
    whole = SceneData(samples.name, samples).whole(across=4)
    return [whole.ratio(a, b) for a, b in zip(one.T, other.T, strict=True)]


def errors_of(image: np.ndarray, reference: Judge) -> np.ndarray:
    """Return the squared and the relative squared error of each pixel, shape (pixel, 2)."""
    errors = np.stack([reference.squared(image), reference.relative(image)[0]])
    return errors.mean(axis=-1).reshape(2, -1).T


def coverage(found: Combination, reference: Judge) -> np.ndarray:
    """Return the share of intervals that hold the reference and the truth, by thirds of brightness.

    Shape (2, third). As much noise again as the reference has tells what it takes from the truth's
    (simulation extrapolation: Cook and Stefanski 1994, doi:10.1080/01621459.1994.10476871).
    """
    image, light = reference.mean, reference.mean.mean(axis=-1)
    third = np.digitize(light, np.quantile(light, [1 / 3, 2 / 3]))
    rng = np.random.default_rng(0)
    noisier = image + reference.error * rng.standard_normal(image.shape)
    once, twice = (
        np.array([inside[third == k].mean() for k in range(3)])
        for inside in ((found.low <= r) & (r <= found.high) for r in (image, noisier))
    )
    return np.array([once, 2 * once - twice])


def judged(samples: chd.Samples, reference: Judge) -> dict[str, np.ndarray]:
    """Return squared errors (pixel, 2) of images by name, and what else is printed."""
    found = chd.estimate(samples)
    measured = Measured.of(samples)
    made = candidates(measured.starts[0], samples.features)
    images = {name: image * measured.unit for name, image in made.items()}
    images["estimate"] = found.radiance
    features = {name: samples.features[name] for name in ("albedo", "normal")}
    for name, guides in {"from it": {}, "from it with features": features}.items():
        images[name] = found.guarded(through_denoiser(found.radiance, guides))
    about = [found.radiance.mean() / reference.mean.mean() - 1, found.bias_error]
    about += coverage(found, reference).ravel().tolist()
    found = {name: errors_of(image, reference) for name, image in images.items()}
    return found | {"about": np.array(about)}


def test_errors_against_the_denoiser(as_benchmark, folder):
    table, shares, missed, biased = [], [], 0, 0
    print(
        f"\n{'scene':24s}{'spp':>4s}  MSE               relMSE            from it    "
        "over mean                           bias           in 90 %"
    )
    for name, scene in scenes().items():
        reference = reference_of(folder, name, scene)
        renders = [
            chd.render(scene, spp=max(NUMBERS), size=(SIZE, SIZE), seed=31 + i, progress=False)
            for i in range(SEEDS)
        ]
        for n in NUMBERS:
            seeds = [judged(store.first(n), reference) for store in renders]
            mean = {k: np.mean([found[k] for found in seeds], axis=0) for k in seeds[0]}
            denoised = better_of(mean, "denoised", "denoised with features")
            ratios = over(renders[0], mean["estimate"], denoised)
            of_mean = over(renders[0], mean["estimate"], mean["mean"])
            started = better_of(mean, "from it", "from it with features").mean(axis=0)
            started /= denoised.mean(axis=0)
            bias, doubt, *thirds = mean["about"]
            shares.append(np.reshape(thirds, (2, 3)))
            table.append([*(r.value for r in ratios), *started, *(r.value for r in of_mean)])
            missed += max(r.low for r in ratios) > 1.02
            biased += abs(bias) > max(0.01, 2 * doubt)
            print(
                f"{name:24s}{n:4d}  "
                + "".join(f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}] " for r in ratios)
                + f" {started[0]:.2f} {started[1]:.2f}  "
                + "".join(f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}] " for r in of_mean)
                + f" {bias:+6.1%} ± {doubt:4.1%}"
                + "    "
                + " ".join(f"{share:.2f}" for share in shares[-1][1]),
                flush=True,
            )
    whole = np.exp(np.log(np.maximum(table, 0.01)).mean(axis=0)).round(2)
    print(
        f"geometric means {whole[:2]}, of the denoiser started from it {whole[2:4]}, over the mean "
        f"{whole[4:]}; of "
        f"{len(table)} rows, {missed} surely above 1.02, {biased} biased by more than 1 % and two "
        "standard errors"
    )
    for name, of in zip(("reference", "truth"), np.array(shares).swapaxes(0, 1), strict=True):
        apart = (of < 0.87) | (of > 0.94)
        print(
            f"intervals of 90 % hold the {name} in {of.mean(axis=0).round(3)} by thirds of "
            f"brightness; {apart.sum()} of {apart.size} are not in 87 to 94 %"
        )


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
