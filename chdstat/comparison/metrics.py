"""Measures of a comparison: how far estimates are from a reference, with intervals.

`MEASURES` are the measures that a comparison reports. Each is a ratio of sums over units, so one
bootstrap over the units serves all of them: `errors_of` returns the summands, `measures_of` the
measures from the sums. A unit is a block of pixels with all their batches, or a batch with all its
pixels. Errors of neighbouring pixels are correlated, so intervals are over blocks (Künsch 1989,
doi:10.1214/aos/1176347265). `columns_of`, `rows_of` and `data_frame_of` make tables; `in_words` and
`titled` write them for a reader.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from chdstat._core.arrays import Array, generator, spans
from chdstat._core.display import number, percent, with_interval, written
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import LEVEL, Interval
from chdstat.estimators.registry import LABELS

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "MEASURES",
    "SUMS",
    "Columns",
    "Measures",
    "columns_of",
    "counts",
    "data_frame_of",
    "described",
    "errors_of",
    "in_words",
    "measures_of",
    "relative_squared",
    "rows_of",
    "shown_ratio",
    "stacked",
    "titled",
]

Measures = Mapping[str, Interval[Array]]
"""Intervals by the names of `MEASURES`."""
Columns = dict[str, tuple[Array, dict[str, str]]]
"""Arrays by name, each with the attributes of a variable."""

MEASURES = {
    "mse": ("mean squared error", "(W sr-1 m-2)^2"),
    "relmse": ("relative mean squared error", "1"),
    "improved": ("share of estimates closer to the reference than the sample mean", "1"),
    "unchanged": ("share of estimates equal to the sample mean", "1"),
    "bias": ("mean error over mean reference", "1"),
    "fireflies": ("share of estimates far brighter than the reference", "1"),
    "mse_ratio": ("mean squared error over that of the sample mean", "1"),
    "relmse_ratio": ("relative mean squared error over that of the sample mean", "1"),
    "fireflies_left": ("fireflies over those of the sample mean", "1"),
}
"""Long name and unit of every measure."""

SUMS = ("squared", "relative", "improved", "unchanged", "firefly", "error", "reference", "count")
"""What is summed over estimates, for every estimator and channel; `count` is 1 per estimate."""

_SUFFIXES = {
    "": ("value", ""),
    "_se": ("standard_error", ", standard error"),
    "_low": ("low", ", lower end of the 95 % interval"),
    "_high": ("high", ", upper end of the 95 % interval"),
}
_TITLES = {
    "label": "pattern",
    "pixels": "pixels",
    "n": "N",
    "name": "estimator",
    "mse_ratio": "MSE / mean's",
    "relmse_ratio": "relMSE / mean's",
    "improved": "improved",
    "bias": "bias",
    "fireflies": "fireflies left",
}
_REPLICATES, _AT_ONCE = 1000, 64
_SAME = 1e-6
"""Relative difference below which an estimate equals the mean up to the order of summation."""
_EXACT = 1e-8
"""Relative squared error up to which a mean counts as exact: samples whose logarithms spread by
1e-4 are constant, see `chdstat.patterns.Thresholds`."""
_FIREFLY = 3.0
"""Excess over the reference, in units of it, from which an estimate is a firefly: two stops."""


def counts(sums: Array) -> npt.NDArray[np.int64]:
    """Return the number of summed estimates of each channel, shape (unit,)."""
    return np.asarray(sums[:, -1, 0, 0], np.int64)


def measures_of(sums: Array, *, seed: int) -> dict[str, Interval[Array]]:
    """Return every measure with its interval over units, shape (estimator, channel + 1).

    The average over channels is last on the channel axis. A single unit gives no interval. With k
    units, a percentile interval is too short by the factor sqrt((k - 1) / k), and by the ratio of
    normal quantiles to Student's (Hesterberg 2015, doi:10.1080/00031305.2015.1089789). It is
    widened by both, but not beyond the possible values of the measure.

    Parameters
    ----------
    sums
        By the names of `SUMS`, shape (unit, sum, 1 + estimator, channel); the sample mean is
        estimator 0.
    seed
        Seed of the bootstrap.
    """
    used, rng, draws = sums[counts(sums) > 0], generator(seed), []
    units = len(used)
    for part in spans(_REPLICATES, _AT_ONCE):
        drawn = rng.integers(units, size=(part.stop - part.start, units))
        weights = np.stack([np.bincount(row, minlength=units) for row in drawn]) / units
        draws.append(_measures((weights @ used.reshape(units, -1)).reshape(-1, *used.shape[1:])))
    value, replicates = _measures(used.mean(axis=0, keepdims=True))[0], np.concatenate(draws)
    spread = float(np.sqrt(units / (units - 1))) if units > 1 else np.nan
    tails = np.array([(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    reach = spread * float(stats.t.ppf(tails[1], units - 1) / stats.norm.ppf(tails[1]))
    with np.errstate(invalid="ignore"):
        error = spread * replicates.std(axis=0, ddof=1)
        ends = value + reach * (np.quantile(replicates, tails, axis=0) - value)
    bounds = [(-np.inf if name == "bias" else 0, 1 if "share" in about else np.inf)
              for name, (about, _) in MEASURES.items()]  # fmt: skip
    low, high = np.clip(ends, *np.transpose(bounds)[..., np.newaxis, np.newaxis])
    found = Interval(value, low, high, standard_error=error)
    return {name: found[index] for index, name in enumerate(MEASURES)}


def relative_squared(error: Array, reference: Array, scene_mean: Array) -> Array:
    """Return (p - y)^2 / (y^2 + 0.01 m^2) for errors p - y, references y, shape (..., channel).

    `scene_mean` is m, the mean reference of the whole scene, shape (channel,). The result is 0 for
    an error of 0, even in a scene without light.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = error**2 / relative_scale(reference, scene_mean)
    return np.where(error == 0, 0.0, relative)


def errors_of(estimate: Array, mean: Array, reference: Array, *, scene_mean: Array) -> Array:
    r"""Return the summands named in `SUMS` for every estimate, shape (pixel, sum, channel).

    An estimate p with :math:`|p - \bar x| \le 10^{-6} \bar x` counts as unchanged. It is a
    *firefly* if

    .. math:: p - y > 3 \sqrt{y^2 + 0.01\, m^2},

    where y is the reference and m the mean reference of the scene: it is at least two stops too
    bright, and bright enough to be visible in the scene. A firefly has a relMSE above 9. We know of
    no published threshold; this one is ours.

    Parameters
    ----------
    estimate, mean, reference
        Radiance, shape (pixel, channel); `mean` is the mean of the samples of the estimate.
    scene_mean
        Mean reference of the scene, shape (channel,).
    """
    # An infinite estimate would give NaN in resamples that draw its pixel 0 times.
    p = np.where(np.isfinite(estimate), estimate, np.nan).astype(np.float64)
    mean = mean.astype(np.float64)
    error = p - reference
    relative = relative_squared(error, reference, scene_mean)
    unchanged = np.abs(p - mean) <= _SAME * np.abs(mean)
    improved = (np.abs(error) < np.abs(mean - reference)) & ~unchanged
    firefly = (error > 0) & (relative > _FIREFLY**2)
    ones = np.ones_like(p)
    parts = [error**2, relative, improved, unchanged, firefly, error, reference, ones]
    return np.stack(parts, axis=1)


def stacked(parts: Sequence[Mapping[str, Interval[Array]]]) -> dict[str, Interval[Array]]:
    """Return the measures of several parts, averaged over channels, along a new first axis."""
    found = {}
    for name in MEASURES:
        value, low, high, error = (
            np.stack([getattr(part[name], field)[:, -1] for part in parts])
            for field in ("value", "low", "high", "standard_error")
        )
        found[name] = Interval(value, low, high, standard_error=error)
    return found


def shown_ratio(row: Mapping[str, Any], name: str) -> str:
    """Return a measure from a row of `Comparison.table`, with its 95 % interval."""
    return with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"])


def in_words(row: Mapping[str, Any]) -> dict[str, str]:
    r"""Return a row of a table of estimators as text, with 95 % intervals of ratios.

    Examples
    --------
    >>> ends = {"mse_ratio": 0.9131, "mse_ratio_low": 0.8691, "mse_ratio_high": 0.9502}
    >>> rest = dict.fromkeys(["relmse_ratio", "relmse_ratio_low", "relmse_ratio_high"], np.nan)
    >>> others = {"mse": 0.5, "improved": 0.6, "bias": -0.012, "fireflies_left": 0.0}
    >>> words = in_words({"estimator": "catoni", **ends, **rest, **others})
    >>> words["mse_ratio"], words["improved"].replace("\xa0", " ")
    ('0.913 [0.869, 0.950]', '60 %')
    """
    label = {"label": row["label"].replace("_", "-")} if "label" in row else {}
    return {
        **label,
        "name": LABELS.get(row["estimator"], row["estimator"]),
        "mse": number(row["mse"]),
        "mse_ratio": shown_ratio(row, "mse_ratio"),
        "relmse_ratio": shown_ratio(row, "relmse_ratio"),
        "improved": "" if row["estimator"] == "mean" else percent(row["improved"]),
        "bias": percent(row["bias"], sign=True),
        "fireflies": number(row["fireflies_left"]),
    }


def columns_of(measures: Measures, *, over_batches: bool = False) -> Columns:
    """Return the arrays of all intervals with attributes; over batches, without the values."""
    end, where = ("_over_batches", " over batches") if over_batches else ("", "")
    return {
        measure + suffix + end: (
            getattr(interval, part),
            described(MEASURES[measure][0] + what + where, MEASURES[measure][1]),
        )
        for measure, interval in measures.items()
        for suffix, (part, what) in _SUFFIXES.items()
        if suffix or not over_batches
    }


def described(long_name: str, units: str = "1") -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def rows_of(
    columns: Columns, estimators: Sequence[str], uses_neighbours: Array, *before: int
) -> list[dict[str, Any]]:
    """Return a flat row for each estimator, with the values of all columns at a place."""
    return [
        {"estimator": name, "uses_neighbours": bool(uses_neighbours[k])}
        | {column: float(values[before][k]) for column, (values, _) in columns.items()}
        for k, name in enumerate(estimators)
    ]


def data_frame_of(measures: Measures, where: Any = ..., **index: Sequence[Any]) -> pd.DataFrame:
    """Return measures with their intervals as a data frame, with a row per place of the index."""
    import pandas as pd

    columns = {
        (measure, part): getattr(interval, part)[where].reshape(-1)
        for measure, interval in measures.items()
        for part in ("value", "low", "high")
    }
    if len(index) == 1:
        ((name, values),) = index.items()
        return pd.DataFrame(columns, pd.Index(values, name=name))
    return pd.DataFrame(columns, pd.MultiIndex.from_product([*index.values()], names=[*index]))


def titled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows of measures in words, under titles."""
    texts = ({**row, **in_words(row)} for row in rows)
    return [
        {title: written(row[key]) for key, title in _TITLES.items() if key in row} for row in texts
    ]


def _measures(sums: Array) -> Array:
    """Return measures (replicate, measure, estimator, channel + 1) of sums over units."""
    *shares, error, reference, count = np.moveaxis(sums, 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.stack([*(part / count for part in shares), error / reference])
        found = np.concatenate([found, found.mean(axis=-1, keepdims=True)], axis=-1)
        squared, relative, improved, unchanged, firefly, bias = found
        # The error of a mean of constant samples is rounding, so it has no ratio.
        exact = relative[:, :1] <= _EXACT
        ratios = [np.where(exact, np.nan, part / part[:, :1]) for part in (squared, relative)]
        ratios.append(firefly / firefly[:, :1])
    measures = [squared, relative, improved, unchanged, bias, firefly, *ratios]
    return np.stack(measures, axis=1)[:, :, 1:]
