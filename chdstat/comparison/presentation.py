"""Presentation: measures of estimators as columns, datasets, data frames, words and LaTeX."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array
from chdstat._core.display import number, percent, with_interval, written
from chdstat._core.resampling import Interval
from chdstat.comparison.accumulate import MEASURES
from chdstat.comparison.candidates import DEFAULT_ESTIMATE
from chdstat.estimators.registry import LABELS, Estimator, lookup

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = [
    "columns_of",
    "data_frame",
    "dataset_of",
    "described",
    "in_words",
    "latex",
    "notes",
    "rows_of",
    "shown_ratio",
    "text_coordinate",
    "titled",
    "variables_of",
]


_SUFFIXES = {
    "": "",
    "_se": ", standard error",
    "_low": ", lower end of the 95 % interval",
    "_high": ", upper end of the 95 % interval",
}


Columns = dict[str, tuple[Array, dict[str, str]]]


def columns_of(measures: Mapping[str, Interval[Array]], *, over_batches: bool = False) -> Columns:
    """Return the arrays of all intervals with what they are; over batches, without the measures."""
    end, where = ("_over_batches", " over batches") if over_batches else ("", "")
    found = {}
    for measure, interval in measures.items():
        long_name, units = MEASURES[measure]
        arrays = interval.value, interval.standard_error, interval.low, interval.high
        for (suffix, what), values in zip(_SUFFIXES.items(), arrays, strict=True):
            if suffix or not over_batches:
                found[measure + suffix + end] = values, described(long_name + what + where, units)
    return found


def rows_of(
    columns: Columns, estimators: Sequence[str], uses_neighbours: Array, *before: int
) -> list[dict[str, Any]]:
    """Return a flat row for each estimator: what all columns hold of it at a place."""
    return [
        {"estimator": name, "uses_neighbours": bool(uses_neighbours[k])}
        | {column: float(values[before][k]) for column, (values, _) in columns.items()}
        for k, name in enumerate(estimators)
    ]


def variables_of(columns: Columns, *dims: str, prefix: str = "") -> dict[str, Any]:
    """Return columns as variables of a dataset."""
    return {prefix + name: (dims, *column) for name, column in columns.items()}


def described(long_name: str, units: str = "1") -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def dataset_of(
    variables: Mapping[str, Any], coordinates: Mapping[str, Any], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """Return a dataset whose attributes a file can hold: what is neither text nor whole is JSON."""
    import xarray as xr

    plain = {
        k: v if isinstance(v, str | int) else json.dumps(v, default=str) for k, v in attrs.items()
    }
    return xr.Dataset(dict(variables), dict(coordinates), plain)


def text_coordinate(names: Iterable[str]) -> npt.NDArray[np.object_]:
    """Return names as a coordinate: zarr v3 has no stable type for text of fixed length."""
    return np.array(list(names), dtype=object)


def shown_ratio(row: Mapping[str, Any], name: str) -> str:
    """Return a measure of a row of `Comparison.table`, with its 95 % interval."""
    return with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"])


def in_words(row: Mapping[str, Any]) -> dict[str, str]:
    r"""Return a row of a table of estimators as a reader wants it, with 95 % intervals of ratios.

    Examples
    --------
    >>> ends = {"mse_ratio": 0.9131, "mse_ratio_low": 0.8691, "mse_ratio_high": 0.9502}
    >>> rest = dict.fromkeys(["relmse_ratio", "relmse_ratio_low", "relmse_ratio_high"], np.nan)
    >>> others = {"mse": 0.5, "improved": 0.6, "bias": -0.012, "fireflies_left": 0.0}
    >>> words = in_words({"estimator": "catoni", **ends, **rest, **others})
    >>> words["mse_ratio"], words["improved"].replace("\xa0", " ")
    ('0.913 [0.869, 0.950]', '60 %')
    """
    label = {"label": row["label"].replace("_", " ")} if "label" in row else {}
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


def titled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows of measures in words, under titles."""
    texts = ({**row, **in_words(row)} for row in rows)
    return [
        {title: written(row[key]) for key, title in _TITLES.items() if key in row} for row in texts
    ]


def data_frame(
    measures: Mapping[str, Interval[Array]], index: pd.Index, where: Any
) -> pd.DataFrame:
    """Return measures with their intervals as a data frame."""
    import pandas as pd

    columns = {
        (measure, part): getattr(interval, part)[where].reshape(-1)
        for measure, interval in measures.items()
        for part in ("value", "low", "high")
    }
    return pd.DataFrame(columns, index)


def notes(
    estimators: Sequence[str],
    *,
    uses_neighbours: npt.ArrayLike = (),
    left_out: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Return what a reader of a table of estimators has to know beside it.

    Parameters
    ----------
    estimators
        Names, those of the rows.
    uses_neighbours
        Which of them look at the pixels around, shape (estimator,), where that is known.
    left_out
        Those of the default estimators that do not apply, with the reason.

    Examples
    --------
    >>> notes(["mean", "zirr2018"], uses_neighbours=[False, True])
    {'use neighbours': 'Zirr et al. 2018'}
    """
    found = {}
    default = lookup(DEFAULT_ESTIMATE)
    if DEFAULT_ESTIMATE in estimators and isinstance(default, Estimator):
        about = f"{default.about[:1].lower()}{default.about[1:]}"
        found["default estimate"] = f"{LABELS[DEFAULT_ESTIMATE]}: {about}"
    around = [estimators[k] for k in np.flatnonzero(uses_neighbours).tolist()]
    if around:
        found["use neighbours"] = ", ".join(LABELS.get(name, name) for name in around)
    if left_out:
        reasons = (f"{LABELS.get(name, name)} {why}" for name, why in left_out.items())
        found["left out"] = "; ".join(reasons)
    return found


_LATEX = str.maketrans(
    {"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "—": "---", "\xa0": "~"}
)


def latex(rows: Sequence[Mapping[str, str]]) -> str:
    r"""Return rows of text as a LaTeX table with the rules of the package booktabs.

    Examples
    --------
    >>> print(latex([{"estimator": "mean", "bias": "-1 %"}]))
    \begin{tabular}{lr}
    \toprule
    estimator & bias \\
    \midrule
    mean & -1 \% \\
    \bottomrule
    \end{tabular}
    """
    texts = ([*rows[0]], *([*row.values()] for row in rows))
    head, *body = (" & ".join(t.translate(_LATEX) for t in row) + r" \\" for row in texts)
    begin = rf"\begin{{tabular}}{{l{'r' * (len(rows[0]) - 1)}}}"
    lines = begin, r"\toprule", head, r"\midrule", *body, r"\bottomrule", r"\end{tabular}"
    return "\n".join(lines)
