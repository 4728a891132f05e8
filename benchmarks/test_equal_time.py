"""What adaptive counts, guiding and the default estimate gain over denoised path tracing.

``--benchmark-only -s`` prints, for each scene: the samples of each pixel that path tracing draws in
the processor time of the other, estimate and denoiser included; relMSE of the default estimate of
an adaptive render whose integrator is "auto", over that of Open Image Denoise of path tracing at
equal time, and at equal samples; and by how much both are too dark or bright. Errors are those of
all seeds together, less that of the reference, which has CHDSTAT_REFERENCE_SPP samples (8192).
A failure: a geometric mean at equal time above .8 (.62 is documented), or an image whose sum is off
by more than 6 % (4 %). CHDSTAT_SEEDS, CHDSTAT_SPP and CHDSTAT_SIZE are as for `test_guiding`; real
scenes are found in CHDSTAT_SCENES.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import chdstat as chd
from benchmarks.test_adaptive import PARTS, mean_of, reference, relative
from benchmarks.test_guiding import EDGE, SCENES, SEEDS, SPP, VIEW, named
from chdstat.estimators.default_estimate.candidates import through_denoiser


def rendered(scene: str, **settings: Any) -> chd.Samples:
    """Return samples of a view of a scene."""
    return chd.render(scene, size=(EDGE, EDGE), **VIEW, **settings)


def denoised(samples: chd.Samples) -> np.ndarray:
    """Return the mean that Open Image Denoise has denoised by albedo and normal."""
    return through_denoiser(mean_of(samples).astype(np.float32), samples.features)


def estimated(samples: chd.Samples) -> np.ndarray:
    """Return the default estimate."""
    return np.asarray(chd.estimate(samples, progress=False).radiance)


def timed(how: Any, scene: str, **settings: Any) -> tuple[np.ndarray, float]:
    """Return an image of a new render, and the processor time of both."""
    start = time.process_time()
    image = how(rendered(scene, **settings))
    return image, time.process_time() - start


def test_estimates_at_equal_time(as_benchmark):
    print(f"\n{EDGE} x {EDGE} x {SPP} spp, {SEEDS} seeds")
    print(f"{'scene':28}   spp  equal time  equal spp  sum of ours  of OIDN")
    ratios = []
    for name, scene in named(SCENES):
        truth, variance = reference(scene, {"size": (EDGE, EDGE), **VIEW})
        variance = variance / (512 * PARTS)
        ours, plain = (
            [timed(how, scene, spp=SPP, seed=i, **settings) for i in range(SEEDS)]
            for how, settings in (
                (estimated, {"adaptive": True, "integrator": "auto"}),
                (denoised, {}),
            )
        )
        cost = np.median([s for _, s in ours]) / np.median([s for _, s in plain])
        spp = round(SPP * cost)
        longer = [timed(denoised, scene, spp=spp, seed=i) for i in range(SEEDS)]
        error, equal_spp, equal_time = (
            np.mean([relative((image - truth) ** 2 - variance, truth) for image, _ in images])
            for images in (ours, plain, longer)
        )
        sums = [np.mean([i for i, _ in of]) / truth.mean() - 1 for of in (ours, longer)]
        ratios.append(error / equal_time)
        print(
            f"{name:28}{spp:6}{ratios[-1]:12.2f}{error / equal_spp:11.2f}"
            f"{sums[0]:13.1%}{sums[1]:9.1%}",
            flush=True,
        )
        assert abs(sums[0]) <= 0.06
    whole = np.exp(np.log(ratios).mean())
    print(f"geometric mean at equal time {whole:.2f}")
    assert whole <= 0.8
