"""Claims on better sampling: what path guiding and adaptive counts do to distributions.

Elek, Thomas and Forbes 2019 leave path guiding to later work. A guide draws directions from which
light comes (Müller, Gross and Novák, "Practical path guiding for efficient light-transport
simulation", 2017, doi:10.1111/cgf.13227). So fewer paths should find no light, and fewer should
find much more than the others. Renders are compared at equally many samples, since tails look
heavier with more samples. Rare bright samples that have not been seen make tails look lighter,
mostly those of the integrator that finds them less often.

Adaptive counts change no distribution, only the error of the mean: that of one sample divided by
the root of their number. The claim is about this error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from chdstat._core.arrays import Floats
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import Blocks
from chdstat.fit import tail_index
from chdstat.inference.findings import ClaimTest, Finding, PlotData, require, required
from chdstat.studies.claim import claim
from chdstat.studies.claims.between_renders import samples_ratio
from chdstat.studies.scene_data import SceneData, known_mean, logs

_WHO = "own", "guided"
_TAIL_PIXELS = 1024
_LONG = 0.25
"""Tail index from which the sample variance has an infinite variance of its own."""
_LITTLE = 0.01
"""Smallest change of a share, an index or in decades that counts as a decrease."""


# --- path guiding ---------------------------------------------------------------------------------


@claim(
    30,
    "guided tails",
    "With path guiding, fewer samples are null, and tails are lighter.",
    paired=True,
    once=True,
)
def tails(data: SceneData) -> Finding:
    """Compare shares of nulls and tail indices with those of path guiding, pixel by pixel."""
    pair, whole = data.with_guided, data.whole(tests=2)
    null = np.stack([scene.summary["null_share"].to_numpy().ravel() for scene in pair])
    some = data.scattered(_TAIL_PIXELS, tests=2)
    xi = np.stack([tail_index(scene.light(some)).xi for scene in pair])
    tests, missing = list[ClaimTest](), list[str]()
    if (null > 0).any():
        fewer = whole.mean(null[1] - null[0])
        tests.append(ClaimTest("share of nulls, guided less own", fewer, most=-_LITTLE))
    else:
        missing.append("needs nulls, which guiding could make rarer")
    if np.isfinite(xi).all(axis=0).any():
        lighter = some.mean(xi[1] - xi[0])
        tests.append(ClaimTest("tail index, guided less own", lighter, most=-_LITTLE))
    else:
        missing.append("needs positive samples enough for tail indices")
    measured = {"share of nulls": null, "tail index": xi}
    measured["long tails"] = np.where(np.isfinite(xi), xi >= _LONG, np.nan)
    means = {f"{name}, {who}": m for name, v in measured.items() for who, m in _means(v).items()}
    return Finding(
        tuple(tests),
        tuple(missing),
        plot_data=PlotData.bars(means, "mean over pixels"),
    )


def _means(values: Floats) -> dict[str, float]:
    """Return the means of values, shape (2, pixel), over the pixels where both are known."""
    known = values[:, np.isfinite(values).all(axis=0)]
    return {who: known_mean(v) for who, v in zip(_WHO, known, strict=True)}


@claim(
    31,
    "guided averages",
    "With path guiding, averages are Gaussian at fewer samples.",
    paired=True,
    once=True,
)
def averages(data: SceneData) -> Finding:
    """Compare the samples that averages need to be Gaussian, from squares of skewness."""
    own, guided = data.with_guided
    ratio = samples_ratio(guided.summary, own.summary, data.whole())
    name = "log samples until averages are Gaussian, guided over own"
    skewness = [scene.summary["skewness"].to_numpy().astype(np.float64) for scene in (own, guided)]
    until = _means(np.stack([s.ravel() ** 2 for s in skewness]))
    return Finding(
        (ClaimTest(name, ratio, most=-_LITTLE, unit="decade"),),
        plot_data=PlotData.bars(until, "mean samples until averages have a skewness of 1"),
    )


# --- adaptive counts ------------------------------------------------------------------------------


@claim(
    33,
    "adaptive counts",
    "Where samples are drawn adaptively, the relative errors of pixels differ less than where all "
    "pixels have as many.",
    paired=True,
    once=True,
)
def counts(data: SceneData) -> Finding:
    """Compare the spread of relative standard errors over pixels, as logarithms.

    It does not depend on the total number of samples. Both spreads use the deviations of the image:
    their noise moves the ratio towards 1, but not beyond. The counts are independent of this noise,
    as another seed decided them.
    """
    adaptive = required(data.adaptive, "the same scene rendered with adaptive=True")
    require(adaptive.unequal, "pixels with different numbers of samples")
    numbers = adaptive.counts
    require(adaptive.shape[:2] == data.samples.shape[:2], "adaptive samples in the same size")
    whole = data.whole()
    mean, variance = (data.summary[n].to_numpy().astype(np.float64) for n in ("mean", "variance"))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        squared = variance / relative_scale(mean)
    even = logs(squared).reshape(len(whole), -1) / 2
    adapted = even - np.log10(numbers).reshape(len(whole), 1) / 2
    spreads = [_spread(log, whole.blocks) for log in (adapted, even)]
    ratio = whole.interval(lambda w: spreads[0](w) / spreads[1](w), (0.0, math.inf))
    every = np.ones((1, len(whole.blocks)))
    decades = {n: float(f(every)[0]) for n, f in zip(("adaptive", "even"), spreads, strict=True)}
    name = "spread of relative errors over pixels, adaptive over even counts"
    return Finding(
        (ClaimTest(name, ratio, most=1.0),),
        plot_data=PlotData.bars(decades, "decades that relative errors spread"),
        few="pixels",
    )


def _spread(values: Floats, blocks: Blocks) -> Callable[[Floats], Floats]:
    """Return what maps weights of blocks to the standard deviation of values (pixel, channel)."""
    known = np.isfinite(values)
    values = np.where(known, values - np.mean(values[known]), 0) if known.any() else values * 0
    columns = np.stack([known, values, values**2], axis=-1).sum(axis=1)
    sums = blocks.sums(columns)

    def deviation(weights: Floats) -> Floats:
        with np.errstate(invalid="ignore", divide="ignore"):
            n, total, squares = (weights @ sums).T
            return np.asarray(np.sqrt(np.maximum(squares / n - (total / n) ** 2, 0)))

    return deviation
