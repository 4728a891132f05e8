"""Paths: null samples, indirect light, longer paths, integrators (findings 1, 5, 9, 28 and 29).

Of integrators: an average of n samples has the skewness of one sample over the root of n, so that
the n which makes it nearly Gaussian is proportional to the square of that skewness. Times n, the
time of a sample is the time until averages are Gaussian; of two integrators, only the ratio
matters.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Floats, luminance
from chdstat._core.resampling import Blocks, Interval, mean_of, median_of
from chdstat.fit import tail_index
from chdstat.patterns import Thresholds
from chdstat.samples import Samples
from chdstat.studies.claims.assumptions import growing, with_room
from chdstat.studies.claims.scene_shapes import DIFFERENT, squares
from chdstat.studies.claims.surfaces import log_skewness
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require, required
from chdstat.studies.scene_data import (
    QUANTILES_NEED,
    PixelSet,
    SceneData,
    largest_interval,
    logs,
    positive_quantiles,
    ratio_of,
)
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "BSDF_SAMPLING",
    "DIRECT",
    "TIMING",
    "measure_cost",
    "measure_indirect",
    "measure_integrators",
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
    enough = f", about {2 ** math.ceil(math.log2(QUANTILES_NEED / share))} spp" if share > 0 else ""
    require(np.isfinite(tail).any(), f"{QUANTILES_NEED} positive samples in a pixel{enough}")
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
    middle, high = positive_quantiles(x, (0.5, 0.99))
    return np.asarray(high / middle)


# --- longer paths ---------------------------------------------------------------------------------

_GROWTH = 0.01
"""Change that counts: a hundredth of a decade, which is 2 %, or a hundredth in skewness, which lies
between -1 and 1; below it, nothing grew."""
_LEVELS = (0.01, 0.5, 0.99)


def measure_lengths(data: SceneData) -> Outcome:
    """Compare pixel by pixel with an image of the same view with shorter paths."""
    (shorter, short), long = _shorter(data), data.summary
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


def _shorter(data: SceneData) -> tuple[Samples, xr.Dataset]:
    """Return the render with shorter paths, and its statistics."""
    needed = "the same scene rendered with shorter paths"
    shorter, short = required(data.shorter, needed), required(data.shorter_summary, needed)
    same = data.summary["null_share"].shape == short["null_share"].shape
    require(same, "shorter paths in the same size")
    return shorter, short


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
    return np.asarray(np.where(n >= QUANTILES_NEED, quantiles, np.nan))


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
    (shorter, short), long = _shorter(data), data.summary
    pixels, level = data.whole(), level_of(2)
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


# --- integrators --------------------------------------------------------------------------------

BSDF_SAMPLING = "BSDF sampling alone"
"""Integrator that finds lights by chance, where surfaces scatter light."""
DIRECT = "direct light, both"
"""Integrator that other ones of direct light are compared with."""
_SLOWEST, _FASTEST = "time until averages are Gaussian", "samples until averages are Gaussian"


def measure_integrators(data: SceneData) -> Outcome:
    """Compare the shapes of integrators, and the time until their averages are Gaussian."""
    require(
        data.integrators,
        "the same scene by other integrators, as a study does with integrators=True",
    )
    sizes = {samples.shape[:3] for samples in data.integrators.values()}
    require(sizes == {data.samples.shape[:3]}, "other integrators in the same size")
    least = min(s.spp for s in (data.samples, *data.integrators.values()))
    # Sample skewness grows with the number of samples: each integrator has as many.
    renders = {"": data.samples, **data.integrators}
    summaries = {name: _summary(samples, least) for name, samples in renders.items()}
    pairs = {
        name: DIRECT if name.startswith("direct light") and DIRECT in renders else ""
        for name in data.integrators
        if name != DIRECT
    }
    blocks, level = data.whole().blocks, level_of(2)
    distances, sooner, fewer = dict[str, Interval[float]](), dict[str, Interval[float]](), {}
    for name, base in pairs.items():
        squared = squares(summaries[name], summaries[base])
        distances[name] = mean_of(squared, blocks, level=1 - (1 - level) / len(pairs)).root()
        fewer[name] = _samples_ratio(summaries[name], summaries[base], blocks, level)
        seconds = [seconds_per_sample(renders[n]) for n in (name, base)]
        if seconds[0] and seconds[1]:
            sooner[name] = _timed(fewer[name], seconds[0] / seconds[1])
    known = [d for d in distances.values() if np.isfinite(d.value)]
    require(known, "positive samples enough for shapes")
    name, largest = (
        "largest distance between the shapes of two integrators",
        largest_interval(known),
    )
    tests = [ClaimTest(name, replace(largest, level=level), least=DIFFERENT, unit="decade^1/2")]
    missing = []
    if BSDF_SAMPLING not in pairs:
        missing.append("needs lights that sampling BSDFs can find")
    elif BSDF_SAMPLING not in sooner:
        missing.append("needs times of the renders, by the scalar backend")
    else:
        name = f"log {_SLOWEST}, {BSDF_SAMPLING} over lights, too"
        tests.append(ClaimTest(name, sooner[BSDF_SAMPLING], least=0.0, unit="decade"))
    shown = sooner or fewer
    return Outcome(
        tuple(tests),
        tuple(missing),
        details={
            "distances": {name: d.value for name, d in distances.items()},
            f"log {_SLOWEST}": {name: i.to_dict() for name, i in sooner.items()},
            f"log {_FASTEST}": {name: i.to_dict() for name, i in fewer.items()},
        },
        plot_data=PlotData.bars(
            {name: i.value for name, i in shown.items()},
            f"decades of {_SLOWEST if sooner else _FASTEST}",
        ),
        few="renders on a quiet machine",
    )


def _summary(samples: Samples, spp: int) -> xr.Dataset:
    used = samples if samples.spp == spp else samples.isel(sample=slice(0, spp))
    return summarize(used, progress=False)


def _samples_ratio(
    one: xr.Dataset, two: xr.Dataset, blocks: Blocks, level: float
) -> Interval[float]:
    """Return the median log ratio of the samples that averages need to be Gaussian."""
    log: list[Floats] = [
        logs(np.abs(summary["skewness"].to_numpy().astype(np.float64))) for summary in (one, two)
    ]
    ratio = 2 * (log[0] - log[1])
    return median_of(ratio.reshape(len(blocks.of_pixel), -1), blocks, level=level)


def _timed(log_samples: Interval[float], slower: float) -> Interval[float]:
    """Return log time from log numbers of samples, of which one takes `slower` times as long."""
    by, room = math.log10(slower), math.log10(TIMING)
    low, high = log_samples.low + by - room, log_samples.high + by + room
    return Interval(log_samples.value + by, low, high, log_samples.level)
