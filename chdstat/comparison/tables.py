"""Results of a comparison as tables, dictionaries, datasets and JSON.

`Comparison` holds every measure with its interval, `Breakdown` the measures of each pattern, and
`ErrorCurve` those of many numbers of samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, generator, plain, whole
from chdstat._core.display import Card, Shown, png
from chdstat._core.image_scales import tonemap
from chdstat._core.resampling import Interval
from chdstat.comparison.accumulate import MEASURES, PixelEstimates
from chdstat.comparison.presentation import (
    columns_of,
    data_frame,
    dataset_of,
    described,
    latex,
    notes,
    rows_of,
    text_coordinate,
    titled,
    variables_of,
)
from chdstat.errors import InputError
from chdstat.estimators.registry import Model

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = ["Breakdown", "Comparison", "ErrorCurve"]


_ALL_CHANNELS = -1
"""Last place of the channel axis of a measure: the average over channels."""
_LOOKS = "whether it looks at the pixels around"
_ALL_BUT_FIRST = "mean of all but the first n"


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
            Whether those that look at the pixels around take part.

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

    def _card(self) -> Card:
        return Card("Breakdown by pattern", table=titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by label and estimator."""
        import pandas as pd

        index = pd.MultiIndex.from_product(
            [self.labels, self.estimators], names=["label", "estimator"]
        )
        return data_frame(self.measures, index, ...)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per label and estimator: names, pixels and every measure."""
        columns = columns_of(self.measures)
        return [
            {"label": label, "pixels": int(self.pixels[row]), **one}
            for row, label in enumerate(self.labels)
            for one in rows_of(columns, self.estimators, self.uses_neighbours, row)
        ]


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """What `compare` has found.

    Attributes
    ----------
    estimators
        Names, in the order asked for.
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
        """What a reader of the table has to know beside it, in words.

        What the default estimate is; which estimators use neighbours; which were left out of
        `chdstat.comparison.DEFAULT_ESTIMATORS`, and why.
        """
        left_out = self.provenance.get("left_out", {})
        return notes(self.estimators, uses_neighbours=self.uses_neighbours, left_out=left_out)

    @property
    def reusable_models(self) -> dict[str, Model]:
        """Those of `models` that take only n samples, and so serve wherever they serve at all.

        Those that take any number were trained for n, and are better trained anew for others.
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
        columns = columns_of(over_blocks) | columns_of(over_batches, over_batches=True)
        return rows_of(columns, self.estimators, self.uses_neighbours)

    def _card(self) -> Card:
        pixels = f"{self.test_pixels.sum()} test pixels"
        facts = {"estimates": f"{self.batches} from {self.n} samples each, of {pixels}"}
        images = {}
        if len(self.channels) in (1, 3):
            images["reference: the mean of all samples"] = png(tonemap(self.reference))
        facts |= {name: text for name, text in self.notes.items() if name != "use neighbours"}
        return Card("Comparison of estimators", facts, titled(self.table()), images)

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
        import pandas as pd

        index = pd.Index(self.estimators, name="estimator")
        return data_frame(self.measures, index, (slice(None), _ALL_CHANNELS))

    def to_latex(self) -> str:
        r"""Return the table as LaTeX with the rules of the package booktabs.

        Ratios to the errors of the sample mean have their 95 % interval in brackets.

        Examples
        --------
        >>> import chdstat as chd
        >>> rng = np.random.default_rng(0)
        >>> found = chd.compare(rng.exponential(size=(8, 8, 3, 128)), ["mean", "median"])
        >>> print(found.to_latex().splitlines()[4])
        sample mean & 1.00 [1.00, 1.00] & 1.00 [1.00, 1.00] &  & 0.0~\% & --- \\
        """
        return latex(titled(self.table()))

    def draw_pixels(self, count: int = 25, *, seed: int = 0) -> PixelEstimates:
        """Draw pixels at random from those that judge, with what was estimated for each.

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
        have dims (label, estimator) and the prefix ``label_``.
        """
        height, width = self.test_pixels.shape
        coordinates: dict[str, Any] = {
            "estimator": text_coordinate(self.estimators),
            "part": text_coordinate([*self.channels, "mean"]),
            "channel": text_coordinate(self.channels),
            "y": np.arange(height),
            "x": np.arange(width),
        }
        dims, radiance = ("estimator", "y", "x", "channel"), "W sr-1 m-2"
        images = {
            "estimate": (dims, self.estimates, "estimate", radiance),
            "squared_error": (dims, self.squared_error, "squared error", f"({radiance})^2"),
            "reference": (dims[1:], self.reference, "reference", radiance),
            "first_mean": (dims[1:], self.first_mean, "mean of the first n", radiance),
            "first_reference": (dims[1:], self.first_reference, _ALL_BUT_FIRST, radiance),
            "test_pixel": (dims[1:3], self.test_pixels, "pixel counts", "1"),
        }
        variables = {
            **variables_of(columns_of(self.measures), "estimator", "part"),
            **variables_of(columns_of(self.over_batches, over_batches=True), "estimator", "part"),
            **{k: (where, v, described(*about)) for k, (where, v, *about) in images.items()},
            "uses_neighbours": (dims[:1], self.uses_neighbours, described(_LOOKS)),
        }
        if self.breakdown is not None:
            found = self.breakdown
            coordinates["label"] = text_coordinate(found.labels)
            about = described("pixels with the label that judge")
            variables["label_pixels"] = (("label",), found.pixels, about)
            columns = columns_of(found.measures)
            variables |= variables_of(columns, "label", "estimator", prefix="label_")
        return dataset_of(variables, coordinates, {"n": self.n, **self.provenance})


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
        columns = columns_of(self.measures)
        return [
            {"n": size, **one}
            for row, size in enumerate(self.sizes)
            for one in rows_of(columns, self.estimators, self.uses_neighbours, row)
            if np.isfinite(one["mse"])
        ]

    def _card(self) -> Card:
        return Card("Error curve", table=titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by n and estimator."""
        import pandas as pd

        names = ["n", "estimator"]
        index = pd.MultiIndex.from_product([self.sizes, self.estimators], names=names)
        return data_frame(self.measures, index, ...)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        names = "sizes", "batches", "test_pixels", "reference_noise", "provenance"
        found: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return found | {"table": plain(self.table())}

    def to_dataset(self) -> xr.Dataset:
        """Return the measures with dims (n, estimator), each with ``_se``, ``_low``, ``_high``."""
        variables = variables_of(columns_of(self.measures), "n", "estimator")
        for measure, noise in self.reference_noise.items():
            long_name, units = MEASURES[measure]
            about = described(f"{long_name} of a perfect estimator", units)
            variables[f"{measure}_reference_noise"] = (("n",), noise, about)
        variables["uses_neighbours"] = (("estimator",), self.uses_neighbours, described(_LOOKS))
        variables["batches"] = (("n",), self.batches, described("estimates that count"))
        sizes = ("n", np.array(self.sizes), described("samples per estimate"))
        coordinates = {"n": sizes, "estimator": text_coordinate(self.estimators)}
        return dataset_of(variables, coordinates, self.provenance)
