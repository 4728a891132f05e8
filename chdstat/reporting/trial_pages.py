"""Trial pages: what was asked of our estimator, as tables and figures of the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat.reporting.figures import estimates
from chdstat.reporting.text import NAMES, number, percent
from chdstat.reporting.trials import BALANCES, LEVELS, Alone, Trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from chdstat.comparison import Comparison

__all__ = ["trial_content", "trial_figures"]

_FAR = 1.1
"""Ratio beyond which an estimator would squeeze the curve of the knob."""


def trial_content(trials: Trials) -> dict[str, Any]:
    """Return the numbers of the trials, ready for JSON."""
    return {
        "iterations": trials.iterations,
        "n": trials.coverage.n,
        "limit_mse": number(trials.limit("mse")),
        "limit_relmse": number(trials.limit("relmse")),
        "mse": number(float(trials.along("mse_ratio").value[0])),
        "relmse": number(float(trials.along("relmse_ratio").value[-1])),
        "at_90": percent(trials.coverage.at_90),
        "alone": None if trials.alone is None else _alone(trials.alone),
    }


def _alone(alone: Alone) -> dict[str, Any]:
    rows = [
        {
            "name": NAMES.get(row["estimator"], row["estimator"]),
            "mse_ratio": _with_interval(row, "mse_ratio"),
            "relmse_ratio": _with_interval(row, "relmse_ratio"),
            "improved": "" if row["estimator"] == "mean" else percent(row["improved"]),
            "bias": percent(row["bias"], sign=True),
            "fireflies": number(row["fireflies_left"]),
        }
        for row in alone.comparison.table()
    ]
    return {
        "rows": rows,
        "n": alone.comparison.n,
        "iterations": alone.iterations,
        "at_90": percent(alone.coverage.at_90),
        "denoised": "oidn" in alone.comparison.estimators,
    }


def _with_interval(row: Mapping[str, Any], name: str) -> str:
    low, high = number(row[f"{name}_low"]), number(row[f"{name}_high"])
    return "1" if row["estimator"] == "mean" else f"{number(row[name])} [{low}, {high}]"


def trial_figures(trials: Trials, comparison: Comparison) -> dict[str, Figure]:
    """Draw the trials, by name."""
    drawn = {"knob": _knob(trials, comparison), "confidence": _confidence(trials)}
    if trials.alone is not None:
        drawn["alone"] = estimates(trials.alone.comparison)
    return drawn


def _knob(trials: Trials, comparison: Comparison) -> Figure:
    """Draw the curve of the knob, with the others that do not lie far off."""
    measures = ("mse_ratio", "relmse_ratio", "bias", "improved")
    others = {
        NAMES.get(row["estimator"], row["estimator"]): (row["mse_ratio"], row["relmse_ratio"])
        for row in comparison.table()
        if row["estimator"] not in ("mean", "progressive")
        and max(row["mse_ratio"], row["relmse_ratio"]) <= _FAR
    }
    limits = trials.limit("mse"), trials.limit("relmse")
    return viz.tradeoff(
        BALANCES,
        {name: trials.along(name) for name in measures},
        others=others,
        limits=limits if np.isfinite(limits).all() else None,
    )


def _confidence(trials: Trials) -> Figure:
    """Draw certainty, width of the intervals, and how often they are right."""
    found = trials.coverage.estimates
    with np.errstate(divide="ignore", invalid="ignore"):
        width = np.abs(found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)
    measured = {f"{trials.coverage.n} spp, with a reference": trials.coverage.measured}
    if trials.alone is not None:
        name = f"{trials.alone.coverage.n} spp, without"
        measured[name] = trials.alone.coverage.measured
    width[~np.isfinite(width)] = np.nan
    maps = [
        viz.value_map(found.certainty, title="Certainty", limits=(0, 1)),
        viz.value_map(width, title="Width of the interval ÷ estimate", limits=(0, 3)),
        viz.coverage(LEVELS, measured, title="Intervals that hold the reference"),
    ]
    height, size = found.certainty.shape
    return viz.map_grid(maps, columns=3, aspect=height / size)
