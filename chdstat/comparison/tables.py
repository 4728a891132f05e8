"""Results of a comparison as tables, words, dictionaries, datasets, LaTeX and JSON.

`Comparison` holds every measure with its interval, `Breakdown` the measures of each pattern, and
`ErrorCurve` those of many numbers of samples. `PixelEstimates` are a few pixels one by one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, generator, plain, whole
from chdstat._core.display import Card, Shown, Width, number, percent, png, with_interval, written
from chdstat._core.image_scales import tonemap
from chdstat._core.resampling import Interval
from chdstat.comparison.entries import DEFAULT_ESTIMATE
from chdstat.comparison.metrics import MEASURES
from chdstat.errors import InputError
from chdstat.estimators.registry import LABELS, Estimator, Model, lookup

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure


__all__ = [
    "Breakdown",
    "Comparison",
    "ErrorCurve",
    "PixelEstimates",
    "in_words",
    "notes",
    "shown_ratio",
]

Measures = Mapping[str, Interval[Array]]
Columns = dict[str, tuple[Array, dict[str, str]]]

_ALL_CHANNELS = -1
"""Last place of the channel axis of a measure: the average over channels."""
_SUFFIXES = {
    "": ("value", ""),
    "_se": ("standard_error", ", standard error"),
    "_low": ("low", ", lower end of the 95 % interval"),
    "_high": ("high", ", upper end of the 95 % interval"),
}


# --- measures as columns --------------------------------------------------------------------------


def _columns(measures: Measures, *, over_batches: bool = False) -> Columns:
    """Return the arrays of all intervals with what they are; over batches, without the measures."""
    end, where = ("_over_batches", " over batches") if over_batches else ("", "")
    return {
        measure + suffix + end: (
            getattr(interval, part),
            _described(MEASURES[measure][0] + what + where, MEASURES[measure][1]),
        )
        for measure, interval in measures.items()
        for suffix, (part, what) in _SUFFIXES.items()
        if suffix or not over_batches
    }


def _described(long_name: str, units: str = "1") -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def _rows(
    columns: Columns, found: Breakdown | Comparison | ErrorCurve, *before: int
) -> list[dict[str, Any]]:
    """Return a flat row for each estimator: what all columns hold of it at a place."""
    return [
        {"estimator": name, "uses_neighbours": bool(found.uses_neighbours[k])}
        | {column: float(values[before][k]) for column, (values, _) in columns.items()}
        for k, name in enumerate(found.estimators)
    ]


def _data_frame(measures: Measures, where: Any = ..., **index: Sequence[Any]) -> pd.DataFrame:
    """Return measures with their intervals as a data frame, a row for each place of the index."""
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


# --- measures as words ----------------------------------------------------------------------------

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


def _titled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows of measures in words, under titles."""
    texts = ({**row, **in_words(row)} for row in rows)
    return [
        {title: written(row[key]) for key, title in _TITLES.items() if key in row} for row in texts
    ]


def notes(
    estimators: Sequence[str],
    *,
    uses_neighbours: npt.ArrayLike = (),
    left_out: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Return notes for a reader of a table of estimators.

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


# --- results --------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class PixelEstimates(Shown):
    """A few pixels that no estimator was trained on, one batch each.

    Attributes
    ----------
    pixels
        Rows (y, x), from dark to bright, shape (pixel, 2).
    estimators, channels
        Names.
    reference
        Mean of all other samples, radiance, shape (pixel, channel).
    mean
        Sample mean of the batch, radiance, shape (pixel, channel).
    estimates
        Radiance, shape (estimator, pixel, channel).
    n
        Samples per estimate.
    """

    pixels: npt.NDArray[np.int64]
    estimators: tuple[str, ...]
    channels: tuple[str, ...]
    reference: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float32]
    estimates: npt.NDArray[np.float32]
    n: int

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw them one by one, as `chdstat.viz.pixel_estimates`."""
        from chdstat import viz

        ax = None if fig is None else fig.subplots()
        return cast("Figure", viz.pixel_estimates(self, width=width, ax=ax).figure)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per pixel and channel: where, reference, mean, every estimate."""
        return [
            {
                "y": int(y),
                "x": int(x),
                "channel": channel,
                "reference": float(self.reference[k, c]),
                "sample_mean": float(self.mean[k, c]),
                **{name: float(self.estimates[e, k, c]) for e, name in enumerate(self.estimators)},
            }
            for k, (y, x) in enumerate(self.pixels)
            for c, channel in enumerate(self.channels)
        ]


@dataclass(frozen=True, repr=False)
class Breakdown(Shown):
    """Which estimator for which pattern: the measures by label, averaged over channels.

    Attributes
    ----------
    labels
        Names of the labels that occur among the pixels that judge.
    estimators, uses_neighbours
        As of a `Comparison`.
    pixels
        Pixels with each label that judge, shape (label,).
    measures
        By the names of `MEASURES`: intervals over blocks, shape (label, estimator).
    """

    _drawn: ClassVar[str] = "relMSE over that of the mean"
    labels: tuple[str, ...]
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    pixels: npt.NDArray[np.int64]
    measures: Mapping[str, Interval[Array]]

    def best(self, measure: str = "relmse", *, neighbours: bool = False) -> tuple[str, ...]:
        """Return the estimator with the smallest error for each label; '' where none has one.

        Parameters
        ----------
        measure
            "mse" or "relmse".
        neighbours
            Whether estimators that look at the pixels around take part.

        Raises
        ------
        InputError
            If the measure is another.
        """
        if measure not in {"mse", "relmse"}:
            message = f"measure must be 'mse' or 'relmse', got {measure!r}"
            raise InputError(message)
        value = self.measures[measure].value
        errors = np.where(np.isfinite(value) & (neighbours | ~self.uses_neighbours), value, np.inf)
        return tuple(
            self.estimators[row.argmin()] if np.isfinite(row).any() else "" for row in errors
        )

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw the errors of each pattern, as `chdstat.viz.pattern_breakdown`."""
        from chdstat import viz

        ax = None if fig is None else fig.subplots()
        return cast("Figure", viz.pattern_breakdown(self, width=width, ax=ax).figure)

    def _card(self) -> Card:
        return Card("Breakdown by pattern", table=_titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by label and estimator."""
        return _data_frame(self.measures, label=self.labels, estimator=self.estimators)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per label and estimator: names, pixels and every measure."""
        columns = _columns(self.measures)
        return [
            {"label": label, "pixels": int(self.pixels[row]), **one}
            for row, label in enumerate(self.labels)
            for one in _rows(columns, self, row)
        ]


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """What `compare` has found; `plot` draws it, `to_latex` is its table for a paper.

    Attributes
    ----------
    estimators
        Names, in the order given.
    uses_neighbours
        Which of them look at the pixels around, shape (estimator,): a class of their own, as they
        see more than n samples.
    channels
        Names of the channels.
    measures
        By the names of `MEASURES`: intervals over 8 x 8 blocks of pixels, shape (estimator,
        channel + 1), the last place being the average over channels. They say how the measure would
        vary with other parts of such an image.
    over_batches
        The same measures with intervals over batches: how they would vary with other random
        numbers, in the same pixels. The batches of a pixel share most of their reference.
        NaN for a single batch.
    estimates
        One estimate of the whole image from its first n samples, radiance, float32, shape
        (estimator, y, x, channel).
    squared_error
        Squared error of `estimates` against the mean of all other samples, same shape; NaN where
        the first n samples hold a bad one.
    first_mean, first_reference
        Mean of the first n samples and mean of all others, radiance, shape (y, x, channel).
    reference
        Mean of all good samples, radiance, shape (y, x, channel).
    test_pixels
        True where no estimator was trained: only these pixels count; shape (y, x).
    n
        Samples per estimate.
    batches
        Estimates that count, over all test pixels.
    excluded
        Estimates of test pixels left out for a bad sample.
    breakdown
        The measures by label; None where no labels were given.
    models
        Trained estimators by name.
    provenance
        Scene, samples, seed and settings, ready for JSON.
    """

    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    channels: tuple[str, ...]
    measures: Mapping[str, Interval[Array]]
    over_batches: Mapping[str, Interval[Array]]
    estimates: npt.NDArray[np.float32]
    squared_error: npt.NDArray[np.float32]
    first_mean: npt.NDArray[np.float32]
    first_reference: npt.NDArray[np.float64]
    reference: npt.NDArray[np.float64]
    test_pixels: npt.NDArray[np.bool_]
    n: int
    batches: int
    excluded: int
    breakdown: Breakdown | None
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    @property
    def notes(self) -> dict[str, str]:
        """Notes for a reader of the table.

        What the default estimate is; which estimators use neighbours; which were left out of
        `chdstat.comparison.DEFAULT_ESTIMATORS`, and why.
        """
        left_out = self.provenance.get("left_out", {})
        return notes(self.estimators, uses_neighbours=self.uses_neighbours, left_out=left_out)

    @property
    def reusable_models(self) -> dict[str, Model]:
        """Those of `models` that take exactly n samples, and so can be used again.

        Models that take any number of samples were trained for n; train them anew for others.
        """
        return {
            name: model
            for name, model in self.models.items()
            if isinstance(getattr(model, "inputs", None), int)
        }

    def table(self) -> list[dict[str, Any]]:
        """Return one row per estimator: its name and every measure, averaged over channels.

        Each measure also has ``_se``, ``_low`` and ``_high``, the standard error and the interval
        over blocks, and the same with ``_over_batches``.
        """
        over_blocks, over_batches = (
            {name: measure[:, _ALL_CHANNELS] for name, measure in measures.items()}
            for measures in (self.measures, self.over_batches)
        )
        return _rows(_columns(over_blocks) | _columns(over_batches, over_batches=True), self)

    def _card(self) -> Card:
        pixels = f"{self.test_pixels.sum()} test pixels"
        facts = {"estimates": f"{self.batches} from {self.n} samples each, of {pixels}"}
        images = {}
        if len(self.channels) in (1, 3):
            images["reference: the mean of all samples"] = png(tonemap(self.reference))
        facts |= {name: text for name, text in self.notes.items() if name != "use neighbours"}
        return Card("Comparison of estimators", facts, _titled(self.table()), images)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the measures as a `pandas.DataFrame`, averaged over channels.

        Rows are estimators; columns have two levels: the measure, and its ``value`` with the
        ``low`` and ``high`` end of the 95 % interval over blocks of pixels.

        Examples
        --------
        >>> import chdstat as chd
        >>> rng = np.random.default_rng(0)
        >>> found = chd.compare(rng.exponential(size=(8, 8, 3, 128)), ["mean", "median"])
        >>> float(found.to_dataframe().loc["mean", ("mse_ratio", "value")])
        1.0
        """
        return _data_frame(self.measures, (slice(None), _ALL_CHANNELS), estimator=self.estimators)

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw all measures of all estimators, as `chdstat.viz.estimator_measures`."""
        from chdstat import viz

        return viz.estimator_measures(self, width=width, fig=fig)

    def draw_pixels(self, count: int = 25, *, seed: int = 0) -> PixelEstimates:
        """Draw pixels at random from those that judge, with the estimates of each.

        Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte Carlo
        variance reduction", show 25 of them.

        Parameters
        ----------
        count
            How many; fewer where fewer have a reference.
        seed
            Where the draw starts.

        Raises
        ------
        InputError
            If `count` is no whole number from 1.
        """
        whole("count", count, least=1)
        usable = self.test_pixels & np.isfinite(self.first_reference).all(axis=-1)
        pixels = np.argwhere(usable)
        drawn = pixels[generator(seed).permutation(len(pixels))[:count]]
        brightness = self.first_reference[tuple(drawn.T)].sum(axis=-1)
        drawn = drawn[np.argsort(brightness, kind="stable")]
        ys, xs = drawn.T
        return PixelEstimates(
            pixels=drawn,
            estimators=self.estimators,
            channels=self.channels,
            reference=self.first_reference[ys, xs],
            mean=self.first_mean[ys, xs],
            estimates=self.estimates[:, ys, xs],
            n=self.n,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return measures, per channel and per label too, and provenance, ready for JSON.

        NaN becomes None.
        """
        per_channel = {
            name: {
                measure: dict(zip(self.channels, values.value[index], strict=False))
                for measure, values in self.measures.items()
            }
            for index, name in enumerate(self.estimators)
        }
        found: dict[str, Any] = plain(
            {
                "n": self.n,
                "batches": self.batches,
                "excluded": self.excluded,
                "test_pixels": self.test_pixels.sum(),
                "table": self.table(),
                "per_channel": per_channel,
                "per_label": [] if self.breakdown is None else self.breakdown.table(),
                "provenance": self.provenance,
            }
        )
        return found

    def to_dataset(self) -> xr.Dataset:
        """Return measures and images with named dims.

        Measures have dims (estimator, part), a part being a channel or "mean"; beside each stand
        ``<measure>_se``, ``_low``, ``_high``, and the same with ``_over_batches``. Those by label
        have dims (label, estimator) and the prefix ``label_``. Attributes that are neither text nor
        whole numbers are JSON, as files hold them.
        """
        import xarray as xr

        height, width = self.test_pixels.shape
        part, image, radiance = ("estimator", "part"), ("y", "x", "channel"), "W sr-1 m-2"
        others = "mean of all but the first n"
        columns: dict[tuple[str, ...], Columns] = {
            part: _columns(self.measures) | _columns(self.over_batches, over_batches=True),
            ("estimator", *image): {
                "estimate": (self.estimates, _described("estimate", radiance)),
                "squared_error": (
                    self.squared_error,
                    _described("squared error", f"({radiance})^2"),
                ),
            },
            image: {
                "reference": (self.reference, _described("reference", radiance)),
                "first_mean": (self.first_mean, _described("mean of the first n", radiance)),
                "first_reference": (self.first_reference, _described(others, radiance)),
            },
            image[:2]: {"test_pixel": (self.test_pixels, _described("pixel counts"))},
        }
        looks = _described("whether it looks at the pixels around")
        columns["estimator",] = {"uses_neighbours": (self.uses_neighbours, looks)}
        names = {"estimator": self.estimators, "part": [*self.channels, "mean"]}
        names["channel"] = self.channels
        if (found := self.breakdown) is not None:
            names["label"] = found.labels
            about = _described("pixels with the label that judge")
            columns["label",] = {"label_pixels": (found.pixels, about)}
            columns["label", "estimator"] = {
                f"label_{name}": column for name, column in _columns(found.measures).items()
            }
        variables = {
            name: (dims, *column)
            for dims, group in columns.items()
            for name, column in group.items()
        }
        # Objects: zarr v3 has no stable type for text of fixed length.
        coordinates = {name: np.array(values, object) for name, values in names.items()}
        coordinates |= {"y": np.arange(height), "x": np.arange(width)}
        attrs = {
            name: value if isinstance(value, str | int) else json.dumps(value, default=str)
            for name, value in {"n": self.n, **self.provenance}.items()
        }
        return xr.Dataset(variables, coordinates, attrs)


@dataclass(frozen=True, repr=False)
class ErrorCurve(Shown):
    """What `error_curve` has found.

    Attributes
    ----------
    estimators, uses_neighbours, models, provenance
        As of a `Comparison`.
    sizes
        Samples per estimate, ascending.
    measures
        By the names of `chdstat.comparison.MEASURES`: intervals over blocks, averaged over
        channels, shape (size, estimator); NaN where an estimator does not take so many samples.
    reference_noise
        For "mse" and "relmse": the error that even a perfect estimator would show, since the
        reference is noisy; the same unit, shape (size,).
    batches
        Estimates that count, over all test pixels, shape (size,).
    test_pixels
        How many pixels count.
    """

    _drawn: ClassVar[str] = "errors against the number of samples"
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    sizes: tuple[int, ...]
    measures: Mapping[str, Interval[Array]]
    reference_noise: Mapping[str, npt.NDArray[np.float64]]
    batches: npt.NDArray[np.int64]
    test_pixels: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per size and estimator that takes it, with every measure."""
        columns = _columns(self.measures)
        return [
            {"n": size, **one}
            for row, size in enumerate(self.sizes)
            for one in _rows(columns, self, row)
            if np.isfinite(one["mse"])
        ]

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw errors against the number of samples, as `chdstat.viz.error_curves`."""
        from chdstat import viz

        return viz.error_curves(self, width=width, fig=fig)

    def _card(self) -> Card:
        return Card("Error curve", table=_titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by n and estimator."""
        return _data_frame(self.measures, n=self.sizes, estimator=self.estimators)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        names = "sizes", "batches", "test_pixels", "reference_noise", "provenance"
        found: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return found | {"table": plain(self.table())}
