"""What adaptive sampling gains at equal numbers of samples, and how well it knows its error.

``--benchmark-only -s`` prints, for each scene: the relMSE of adaptive renders over that of renders
with as many samples in each pixel, the first samples counted; the same as it is expected from the
variances of the reference, which a single firefly does not decide; the error (root of relMSE) that
the first samples predict, and the one that all samples estimate, over that of the very image, the
median over seeds; how many of the intervals of the first hold it; the bias of the image with its
standard error; and the largest number of samples of a pixel over the mean.
References have CHDSTAT_REFERENCE_SPP samples (8192) in CHDSTAT_EDGE pixels along each side (64).
CHDSTAT_ADAPTIVE names other scenes, CHDSTAT_SEEDS the number of seeds, CHDSTAT_SPP the samples;
real scenes are found in CHDSTAT_SCENES. A failure: a bias of more than 4 standard errors, or an
expected relMSE above that of equal counts, of a scene by 5 % or of all in the geometric mean.
"""

import os
from pathlib import Path

import numpy as np

import chdstat as chd
from chdstat.rendering.adaptive import error_of, expected_error
from chdstat.rendering.backend import resolve

BUILTIN = "caustic cornell-box many-lights night-room bathroom fog day-room gallery"
REAL = "bathroom/scene.xml veach-bidir/scene.xml veach-mis/scene.xml white-room/scene_night.xml"
SEEDS, SPP = int(os.environ.get("CHDSTAT_SEEDS", "8")), int(os.environ.get("CHDSTAT_SPP", "64"))
EDGE = int(os.environ.get("CHDSTAT_EDGE", "64"))
VIEW = {"size": (EDGE, EDGE), "progress": False}
PARTS = int(os.environ.get("CHDSTAT_REFERENCE_SPP", "8192")) // 512


def relative(squared, truth):
    """Return the relMSE of squared errors."""
    return (squared / (truth**2 + 0.01 * truth.mean(axis=(0, 1)) ** 2)).mean()


def mean_of(samples):
    """Return the mean image."""
    return np.nanmean(samples.read(), axis=-1, dtype=np.float64)


def reference(scene, view):
    """Return mean and variance of many samples."""
    total, squares = 0, 0
    for i in range(PARTS):
        x = chd.render(scene, spp=512, seed=1000 + i, **view).read().astype(np.float64)
        total, squares = total + x.sum(axis=-1), squares + (x**2).sum(axis=-1)
    mean, number = total / (512 * PARTS), 512 * PARTS
    return mean, (squares / number - mean**2) * number / (number - 1)


def error_of_mean(variance):
    """Return the standard error of an image's mean; that of channels which vary together."""
    return np.sqrt(variance.sum(axis=(0, 1))).mean() / variance[..., 0].size


def compared(scene, view):
    """Return the row of a scene."""
    (truth, variance), seeds = reference(scene, view), range(SEEDS)
    plain = [mean_of(chd.render(scene, spp=SPP, seed=i, **view)) for i in seeds]
    found = [chd.render(scene, spp=SPP, adaptive=True, seed=i, **view) for i in seeds]
    images = [mean_of(samples) for samples in found]
    of_truth = relative(variance / (512 * PARTS), truth)
    errors = [relative((image - truth) ** 2, truth) - of_truth for image in images]
    equal = [relative((image - truth) ** 2, truth) - of_truth for image in plain]
    expected = [relative(variance / s.counts[..., np.newaxis], truth) for s in found]
    roots, predicted = np.sqrt(errors), [expected_error(samples.attrs) for samples in found]
    estimated = np.array([error_of(samples).value for samples in found])
    of_counts = np.mean([variance / s.counts[..., np.newaxis] for s in found], axis=0)
    of_bias = error_of_mean(of_counts / SEEDS + variance / (512 * PARTS)) / truth.mean()
    return {
        "relMSE": np.mean(errors) / np.mean(equal),
        "expected": np.mean(expected) / relative(variance / SPP, truth),
        "predicted": np.median([p.value for p in predicted] / roots),
        "held": np.mean([p.low <= x <= p.high for p, x in zip(predicted, roots, strict=True)]),
        "estimated": np.median(estimated / roots),
        "bias": np.mean(images) / truth.mean() - 1,
        "+-": of_bias,
        "most": np.mean([samples.spp for samples in found]) / SPP,
    }


def test_errors_of_adaptive_renders(as_benchmark):
    view = {**VIEW, "backend": resolve("auto").name}
    folder, rows = Path(os.environ.get("CHDSTAT_SCENES", "")), []
    print(f"\n{SPP} spp, {SEEDS} seeds, {view['backend']}")
    for name in os.environ.get("CHDSTAT_ADAPTIVE", f"{BUILTIN} {REAL}").split():
        scene = str(folder / name) if "." in name else name
        if "." in name and not Path(scene).is_file():
            continue
        rows.append(compared(scene, view))
        if len(rows) == 1:
            print(f"{'':28}" + "".join(f"{title:>10}" for title in rows[0]))
        print(f"{name:28}" + "".join(f"{x:10.3f}" for x in rows[-1].values()), flush=True)
        assert abs(rows[-1]["bias"]) < 4 * rows[-1]["+-"]
        assert rows[-1]["expected"] <= 1.05
    for title in ("relMSE", "expected"):
        mean = np.exp(np.mean([np.log(row[title]) for row in rows]))
        print(f"geometric mean of {title}: {mean:.3f}")
    assert mean <= 1
