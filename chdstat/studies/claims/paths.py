"""Paths: null samples, indirect light, and longer paths (findings 1, 5, 9 and 28)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import luminance
from chdstat._core.positive import Floats
from chdstat._core.resampling import Interval, mean_of, median_of
from chdstat.fit import tail_index
from chdstat.patterns import Thresholds
from chdstat.samples import Samples
from chdstat.studies.claims.assumptions import growing, with_room
from chdstat.studies.claims.surfaces import log_skewness
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require, required
from chdstat.studies.scene_data import PixelSet, SceneData, logs, ratio_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "TIMING",
    "measure_cost",
    "measure_indirect",
    "measure_lengths",
    "measure_nulls",
    "seconds_per_sample",
]


# --- nulls and indirect light ---------------------------------------------------------------------

_TAIL = float(np.log(100) / np.log(2))
"""Quantile at 99 % over the median, of the exponential distribution: 6.6. Beyond it, a tail is
long."""
_KURTOSIS = 6.0
"""Excess kurtosis of the exponential distribution; beyond it, that of positive samples is high.
Nulls would add to it, but are a part of the claim of their own."""
_LEAST = 100
"""Positive samples that a quantile at 1 % or 99 % needs."""
_NEAR = (0.45, 0.75)
"""Indirect light: "around 60 %" (Elek et al. 2019, section 5.1), give or take 15 points."""
_EXPECTED = {
    "night-room": (0.5, 1.0),
    "day-room": (0.0, 0.2),
    "white-room": (0.0, 0.2),
    "gallery": (0.0, 0.2),
}
"""Share over the image by scene: "often exceeding 50 %" by night, "typically under 20 %" in the
gallery, "low numbers" in the white room by day, for which the paper gives no figure."""


def measure_nulls(data: SceneData) -> Outcome:
    """Compare the share of nulls with what the paper reports of such a scene."""
    expected, where = _EXPECTED.get(data.name.removeprefix("real-")), "the image"
    if expected is None:
        expected, where = _NEAR, "the indirect regions"
        patch = data.patch("indirect", "of indirect light")
    else:
        patch = data.whole()
    image = data.summary["null_share"].to_numpy()
    share = mean_of(patch.take(image), patch.blocks)
    by_region: dict[str, float] = {}
    if data.regions:
        every = PixelSet.of(data.regions, *data.samples.shape[:2])
        by_region = every.by_region(every.take(image))
    known = image[np.isfinite(image)]
    return Outcome(
        (ClaimTest(f"share of nulls in {where}", share, *expected),),
        details={"by_region": by_region, "image": float(known.mean()) if known.size else None},
        plot_data=PlotData.bars(by_region, "share of nulls"),
    )


def measure_indirect(data: SceneData) -> Outcome:
    """Measure tail, kurtosis, skewness of logarithms and nulls in indirect light."""
    patch = data.patch("indirect", "of indirect light")
    summary, blocks, level = data.summary, patch.blocks, level_of(4)
    x = data.light(patch)
    tail, skewness = _tail(x), log_skewness(x)
    share = np.count_nonzero(x > 0) / x.size
    enough = f", about {2 ** math.ceil(math.log2(_LEAST / share))} spp" if share > 0 else ""
    require(np.isfinite(tail).any(), f"{_LEAST} positive samples in a pixel{enough}")
    grown = growing(x, x > 0, lambda moments: moments.kurtosis)
    kurtosis = with_room(median_of(grown[-1], blocks, level=level), grown)
    nulls = mean_of(patch.take(summary["null_share"].to_numpy()), blocks, level=level)
    tests = (
        ClaimTest(
            "quantile at 99 % over median", median_of(tail, blocks, level=level), least=_TAIL
        ),
        ClaimTest("excess kurtosis of positive samples", kurtosis, least=_KURTOSIS),
        ClaimTest("skewness of log radiance", mean_of(skewness, blocks, level=level), most=0.0),
        ClaimTest("share of nulls", nulls, least=Thresholds().null_share),
    )
    measured = {
        "tail": tail,
        "tail_index": tail_index(x).xi,
        "excess_kurtosis": grown[-1],
        "excess_kurtosis_with_nulls": patch.take(summary["kurtosis"].to_numpy()),
        "log_skewness": skewness,
    }
    ordered = np.sort(skewness[np.isfinite(skewness)])
    rank = (np.arange(len(ordered)) + 0.5) / max(len(ordered), 1)
    return Outcome(
        tests,
        details={name: patch.by_region(values) for name, values in measured.items()},
        plot_data=PlotData(
            "curves", {"pixels": (ordered, rank)}, "skewness of log radiance", "share below"
        ),
    )


def _tail(x: Floats) -> Floats:
    """Return the quantile at 99 % over the median of positive samples, shape (pixel,)."""
    ordered = np.sort(np.where(x > 0, x, np.inf), axis=1)
    n = (x > 0).sum(axis=1)
    middle, high = (
        np.take_along_axis(ordered, np.clip(np.ceil(q * n) - 1, 0, None).astype(int)[:, None], 1)
        for q in (0.5, 0.99)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(n >= _LEAST, (high / middle)[:, 0], np.nan))


# --- longer paths ---------------------------------------------------------------------------------

_GROWTH = 0.01
"""Change that counts: a hundredth of a decade, which is 2 %, or a hundredth in skewness, which lies
between -1 and 1; below it, nothing grew."""
_LEVELS = (0.01, 0.5, 0.99)


def measure_lengths(data: SceneData) -> Outcome:
    """Compare pixel by pixel with an image of the same view with shorter paths."""
    needed = "the same scene rendered with shorter paths"
    shorter, short = required(data.shorter, needed), required(data.shorter_summary, needed)
    long = data.summary
    require(long["null_share"].shape == short["null_share"].shape, "shorter paths in the same size")
    blocks, level = data.whole().blocks, level_of(4)
    changes = _changes(long, short)
    tests = tuple(
        ClaimTest(
            f"mean change of {name}",
            mean_of(change.reshape(len(blocks.of_pixel), -1), blocks, level=level),
            least=_GROWTH,
            unit="1" if name == "skewness" else "decade",
        )
        for name, change in changes.items()
    )
    renders = (shorter, data.samples)
    seconds = [seconds_per_sample(samples) for samples in renders]
    integrators = [samples.attrs.get("integrator") for samples in renders]
    return Outcome(
        tests,
        details={
            "time_ratio": seconds[1] / seconds[0] if seconds[0] and seconds[1] else None,
            "seconds_per_sample": seconds,
            "mean_ratio": float(long["mean"].mean() / short["mean"].mean()),
            "max_depth": [i.get("max_depth") if isinstance(i, dict) else None for i in integrators],
            "spp": [samples.spp for samples in renders],
        },
        plot_data=PlotData.bars(
            {n: float(np.nanmean(v)) for n, v in changes.items() if np.isfinite(v).any()},
            "change with longer paths",
        ),
    )


def _changes(long: xr.Dataset, short: xr.Dataset) -> dict[str, Floats]:
    """Return what longer paths add, each of shape (y, x, channel).

    Support is the decades between the quantiles at 1 % and 99 % of positive radiance, tail those
    between the median and 99 %: unlike extremes and moments, they do not grow with the number of
    samples, of which shorter paths have fewer that are positive. Variance counts nulls, too.
    """
    after, before = _quantiles(long), _quantiles(short)
    low, middle, high = np.moveaxis(after - before, -1, 0)
    return {
        "support": high - low,
        "tail": high - middle,
        "skewness": _skewness(after) - _skewness(before),
        "log variance": logs(long["variance"].to_numpy()) - logs(short["variance"].to_numpy()),
    }


def _quantiles(dataset: xr.Dataset) -> Floats:
    """Return quantiles of log10 of positive radiance from histograms, shape (y, x, channel, 3)."""
    counts = dataset["log_counts"].to_numpy()
    total = np.cumsum(counts, axis=-1, dtype=np.float64)
    n = total[..., -1:]
    edges = np.linspace(-5, 5, counts.shape[-1] + 1)
    quantiles = np.full((*counts.shape[:-1], len(_LEVELS)), np.nan)
    for i, level in enumerate(_LEVELS):
        place = (total < level * n).sum(axis=-1, keepdims=True).clip(max=counts.shape[-1] - 1)
        inside = np.maximum(np.take_along_axis(counts, place, -1), 1)
        start = np.take_along_axis(total, place, -1) - inside
        part = np.clip((level * n - start) / inside, 0, 1)
        quantiles[..., i] = (edges[place] + part * (edges[1] - edges[0]))[..., 0]
    return np.asarray(np.where(n >= _LEAST, quantiles, np.nan))


def _skewness(log_quantiles: Floats) -> Floats:
    """Return (high + low - 2 median) / (high - low) of radiance, in [-1, 1].

    Hinkley, "On power transformations to symmetry", 1975, doi:10.1093/biomet/62.1.101.
    """
    low, middle, high = np.moveaxis(10**log_quantiles, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((high + low - 2 * middle) / (high - low))


def seconds_per_sample(samples: Samples) -> float | None:
    """Return the time to render and store one sample, in s, all cores together.

    The time of a render has no loading of the scene in it. Backends that compile for each render do
    that within it, and seconds of compiling cannot be told from those of rendering: None for them,
    that is, for all but the scalar one.
    """
    seconds: Any = samples.attrs.get("render_seconds")
    if not seconds or samples.attrs.get("backend") != "scalar":
        return None
    height, width, _, spp = samples.shape
    return float(seconds) / (height * width * spp)


# --- cost of longer paths -------------------------------------------------------------------------

_VISIBLE = 1.02
"""Ratio of radiance that is visible, after Weber's law."""
TIMING = 1.7
"""Factor that a ratio of times may be wrong by: one time has no interval of its own. Three renders
of each of five scenes, on a machine that did other things, too, differed by up to 1.6."""


def measure_cost(data: SceneData) -> Outcome:
    """Compare mean radiance and time with those of the same view with shorter paths."""
    needed = "the same scene rendered with shorter paths"
    shorter, short = required(data.shorter, needed), required(data.shorter_summary, needed)
    long, pixels, level = data.summary, data.whole(), level_of(2)
    require(long["null_share"].shape == short["null_share"].shape, "shorter paths in the same size")
    after, before = (
        np.asarray(
            luminance(summary["mean"].to_numpy().astype(np.float64)[..., np.newaxis])
        ).ravel()
        for summary in (long, short)
    )
    ratio = ratio_of(after, before, pixels.blocks, level=level)
    tests = [ClaimTest("mean radiance over that of shorter paths", ratio, least=_VISIBLE)]
    seconds = [seconds_per_sample(samples) for samples in (data.samples, shorter)]
    missing = list[str]()
    if seconds[0] and seconds[1]:
        slower = seconds[0] / seconds[1]
        time = Interval(slower, slower / TIMING, slower * TIMING, level)
        tests.append(ClaimTest("time per sample over that of shorter paths", time, least=1.0))
    else:
        missing.append("needs times of the renders, by the scalar backend")
    values = {test.name.split(" over")[0]: test.interval.value for test in tests}
    return Outcome(
        tuple(tests),
        tuple(missing),
        details={"seconds_per_sample": seconds},
        plot_data=PlotData.bars(values, "over that of shorter paths"),
        few="renders on a quiet machine",
    )
