"""Path lengths: what longer paths do to the CHD, and what they cost (finding 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import mean_of
from chdstat.samples import Samples
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import SceneData

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["GROWTH", "LEAST", "measure"]

Floats = npt.NDArray[np.float64]

GROWTH = 0.01
"""Change that counts: a hundredth of a decade, which is 2 %, or a hundredth in skewness, which lies
between -1 and 1; below it, nothing grew."""
LEAST = 100
"""Positive samples that the quantiles at 1 % and 99 % need, in both images."""
_INTERPRETED = "scalar"
"""The backend that compiles nothing for a scene."""
_LEVELS = (0.01, 0.5, 0.99)
_PARTS = 4


def measure(data: SceneData) -> Outcome:
    """Compare pixel by pixel with an image of the same view with shorter paths."""
    short = data.shorter_summary
    if short is None or data.shorter is None:
        return Outcome(missing=("needs the same scene rendered with shorter paths",))
    long = data.summary
    if long["null_share"].shape != short["null_share"].shape:
        return Outcome(missing=("needs shorter paths in the same size",))
    blocks, level = data.whole().blocks, level_of(_PARTS)
    changes = _changes(long, short)

    def part(name: str, unit: str) -> ClaimTest:
        values = changes[name].reshape(len(blocks.of_pixel), -1)
        spread = mean_of(values, blocks, level=level)
        return ClaimTest.of(f"mean change of {name}", spread, least=GROWTH, unit=unit)

    return Outcome(
        (
            part("support", "decade"),
            part("tail", "decade"),
            part("skewness", "1"),
            part("log variance", "decade"),
        ),
        details={
            "time_ratio": _time_ratio(data.samples, data.shorter),
            "seconds_per_sample": [
                _time_of_sample(samples) for samples in (data.shorter, data.samples)
            ],
            "mean_ratio": float(long["mean"].mean() / short["mean"].mean()),
            "max_depth": [_depth(data.shorter), _depth(data.samples)],
            "spp": [data.shorter.spp, data.samples.spp],
        },
        plot_data=_plot_data(changes),
    )


def _changes(long: xr.Dataset, short: xr.Dataset) -> dict[str, Floats]:
    """Return what longer paths add, each of shape (y, x, channel).

    Support is the decades between the quantiles at 1 % and 99 % of positive radiance, tail those
    between the median and 99 %: unlike extremes and moments, they do not grow with the number of
    samples, of which shorter paths have fewer that are positive. Variance counts nulls, too.
    """
    quantiles = _quantiles(long), _quantiles(short)
    low, middle, high = np.moveaxis(quantiles[0] - quantiles[1], -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        variances = [np.log10(d["variance"].to_numpy()) for d in (long, short)]
        change = variances[0] - variances[1]
    return {
        "support": high - low,
        "tail": high - middle,
        "skewness": _skewness(quantiles[0]) - _skewness(quantiles[1]),
        "log variance": np.where(np.isfinite(change), change, np.nan),
    }


def _quantiles(dataset: xr.Dataset) -> Floats:
    """Return quantiles of log10 of positive radiance from histograms, shape (y, x, channel, 3)."""
    counts = dataset["log_counts"].to_numpy()
    total = np.cumsum(counts, axis=-1, dtype=np.float64)
    n = total[..., -1:]
    edges = np.linspace(-5, 5, counts.shape[-1] + 1)
    found = np.full((*counts.shape[:-1], len(_LEVELS)), np.nan)
    for i, level in enumerate(_LEVELS):
        place = (total < level * n).sum(axis=-1, keepdims=True).clip(max=counts.shape[-1] - 1)
        inside = np.maximum(np.take_along_axis(counts, place, -1), 1)
        start = np.take_along_axis(total, place, -1) - inside
        part = np.clip((level * n - start) / inside, 0, 1)
        found[..., i] = (edges[place] + part * (edges[1] - edges[0]))[..., 0]
    return np.asarray(np.where(n >= LEAST, found, np.nan))


def _skewness(log_quantiles: Floats) -> Floats:
    """Return (high + low - 2 median) / (high - low) of radiance, in [-1, 1].

    Hinkley, "On power transformations to symmetry", 1975, doi:10.1093/biomet/62.1.101.
    """
    low, middle, high = np.moveaxis(10**log_quantiles, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((high + low - 2 * middle) / (high - low))


def _time_ratio(long: Samples, short: Samples) -> float | None:
    """Return the time for each sample over that of shorter paths; None where it is not known."""
    times = [_time_of_sample(samples) for samples in (long, short)]
    return None if times[0] is None or not times[1] else times[0] / times[1]


def _time_of_sample(samples: Samples) -> float | None:
    """Return the time to render and store one sample, in s, all cores together.

    The time of a render has no loading of the scene in it. Backends that compile for each render do
    that within it, and seconds of compiling cannot be told from those of rendering: None for them.
    """
    seconds: Any = samples.attrs.get("render_seconds")
    if not seconds or samples.attrs.get("backend") != _INTERPRETED:
        return None
    height, width, _, spp = samples.shape
    return float(seconds) / (height * width * spp)


def _depth(samples: Samples) -> Any:
    integrator = samples.attrs.get("integrator")
    return integrator.get("max_depth") if isinstance(integrator, dict) else None


def _plot_data(changes: dict[str, Floats]) -> PlotData:
    means = {n: np.nanmean(v) for n, v in changes.items() if np.isfinite(v).any()}
    series = {name: (np.zeros(1), np.array([mean])) for name, mean in means.items()}
    return PlotData("bars", series, y_label="change with longer paths")
