"""Path lengths: what longer paths do to the CHD, and what they cost (finding 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import mean_of
from chdstat.samples import Samples
from chdstat.studies.outcomes import (
    ClaimTest,
    Outcome,
    PlotData,
    level_of,
    require,
    required,
)
from chdstat.studies.scene_data import SceneData, logs

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["measure"]

_GROWTH = 0.01
"""Change that counts: a hundredth of a decade, which is 2 %, or a hundredth in skewness, which lies
between -1 and 1; below it, nothing grew."""
_LEAST = 100
"""Positive samples that the quantiles at 1 % and 99 % need, in both images."""
_LEVELS = (0.01, 0.5, 0.99)


def measure(data: SceneData) -> Outcome:
    """Compare pixel by pixel with an image of the same view with shorter paths."""
    needed = "the same scene rendered with shorter paths"
    shorter, short = required(data.shorter, needed), required(data.shorter_summary, needed)
    long = data.summary
    require(long["null_share"].shape == short["null_share"].shape, "shorter paths in the same size")
    blocks, level = data.whole().blocks, level_of(4)
    changes = _changes(long, short)
    units = {"skewness": "1"}
    tests = tuple(
        ClaimTest(
            f"mean change of {name}",
            mean_of(change.reshape(len(blocks.of_pixel), -1), blocks, level=level),
            least=_GROWTH,
            unit=units.get(name, "decade"),
        )
        for name, change in changes.items()
    )
    renders = (shorter, data.samples)
    seconds = [_seconds_per_sample(samples) for samples in renders]
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
    quantiles = _quantiles(long), _quantiles(short)
    low, middle, high = np.moveaxis(quantiles[0] - quantiles[1], -1, 0)
    log_variances = [logs(dataset["variance"].to_numpy()) for dataset in (long, short)]
    return {
        "support": high - low,
        "tail": high - middle,
        "skewness": _skewness(quantiles[0]) - _skewness(quantiles[1]),
        "log variance": log_variances[0] - log_variances[1],
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


def _seconds_per_sample(samples: Samples) -> float | None:
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
