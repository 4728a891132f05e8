"""Results of a comparison as tables, dictionaries, datasets and JSON.

`Comparison` holds every measure with its interval, `Breakdown` the measures of each pattern, and
`ErrorCurve` those of many numbers of samples.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, plain, whole
from chdstat._core.resampling import Interval
from chdstat.comparison.accumulate import MEASURES, PixelEstimates
from chdstat.errors import InputError
from chdstat.estimators.registry import Model

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Breakdown", "Comparison", "ErrorCurve"]

Array = npt.NDArray[Any]

_ALL_CHANNELS = -1
"""Last place of the channel axis of a measure: the average over channels."""
_OVER_BATCHES = "_over_batches"
"""What follows the suffix of an interval over batches, in place of pixels."""
_LOOKS = "whether it looks at the pixels around"
_ALL_BUT_FIRST = "mean of all but the first n"
_SUFFIXES = {
    "": "",
    "_se": ", standard error",
    "_low": ", lower end of the 95 % interval",
    "_high": ", upper end of the 95 % interval",
}


def _values(
    measures: Mapping[str, Interval[Array]], over_batches: bool
) -> Iterator[tuple[str, str, Array]]:
    """Yield measure, suffix and values of all intervals; over batches, without the measures."""
    for measure, found in measures.items():
        arrays = found.value, found.standard_error, found.low, found.high
        for suffix, values in zip(_SUFFIXES, arrays, strict=True):
            if suffix or not over_batches:
                yield measure, suffix, values


def _row(
    measures: Mapping[str, Interval[Array]], index: tuple[int, int], *, over_batches: bool = False
) -> dict[str, float]:
    """Return one place of all measures as a flat row."""
    end = _OVER_BATCHES if over_batches else ""
    return {m + s + end: float(values[index]) for m, s, values in _values(measures, over_batches)}


def _variables(
    measures: Mapping[str, Interval[Array]],
    dims: tuple[str, ...],
    *,
    prefix: str = "",
    over_batches: bool = False,
) -> dict[str, Any]:
    """Return measures as variables of a dataset."""
    end = _OVER_BATCHES if over_batches else ""
    variables = {}
    for measure, suffix, values in _values(measures, over_batches):
        long_name, units = MEASURES[measure]
        about = _about(long_name + _SUFFIXES[suffix] + end.replace("_", " "), units)
        variables[prefix + measure + suffix + end] = (dims, values, about)
    return variables


def _about(long_name: str, units: str = "1") -> dict[str, str]:
    return {"long_name": long_name, "units": units}


def _dataset(
    variables: Mapping[str, Any], coordinates: Mapping[str, Any], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """Return a dataset whose attributes a file can hold: what is neither text nor whole is JSON."""
    import xarray as xr

    plain = {
        k: v if isinstance(v, str | int) else json.dumps(v, default=str) for k, v in attrs.items()
    }
    return xr.Dataset(dict(variables), dict(coordinates), plain)


def _names(names: Iterable[str]) -> npt.NDArray[np.object_]:
    """Return names as a coordinate: zarr v3 has no stable type for text of fixed length."""
    return np.array(list(names), dtype=object)


@dataclass(frozen=True)
class Breakdown:
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

    def table(self) -> list[dict[str, Any]]:
        """Return one row per label and estimator: names, pixels and every measure."""
        return [
            {
                "label": label,
                "pixels": int(self.pixels[row]),
                "estimator": name,
                "uses_neighbours": bool(self.uses_neighbours[k]),
                **_row(self.measures, (row, k)),
            }
            for row, label in enumerate(self.labels)
            for k, name in enumerate(self.estimators)
        ]


@dataclass(frozen=True)
class Comparison:
    """What `compare` has found.

    Attributes
    ----------
    estimators
        Names, in the order asked for, those that use neighbours last.
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
    def reusable_models(self) -> dict[str, Model]:
        """Those of `models` that take only n samples, and so serve wherever they serve at all.

        Those that take any number were trained for n, and are better trained anew for others.
        """
        return {name: model for name, model in self.models.items() if hasattr(model, "inputs")}

    def table(self) -> list[dict[str, Any]]:
        """Return one row per estimator: its name and every measure, averaged over channels.

        Each measure also has ``_se``, ``_low`` and ``_high``, the standard error and the interval
        over blocks, and the same with ``_over_batches``.
        """
        return [
            {
                "estimator": name,
                "uses_neighbours": bool(self.uses_neighbours[index]),
                **_row(self.measures, (index, _ALL_CHANNELS)),
                **_row(self.over_batches, (index, _ALL_CHANNELS), over_batches=True),
            }
            for index, name in enumerate(self.estimators)
        ]

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
        content = {
            "n": self.n,
            "batches": self.batches,
            "excluded": self.excluded,
            "test_pixels": int(self.test_pixels.sum()),
            "table": self.table(),
            "per_channel": per_channel,
            "per_label": [] if self.breakdown is None else self.breakdown.table(),
            "provenance": dict(self.provenance),
        }
        return {key: plain(value) for key, value in content.items()}

    def to_dataset(self) -> xr.Dataset:
        """Return measures and images with named dims.

        Measures have dims (estimator, part), a part being a channel or "mean"; beside each stand
        ``<measure>_se``, ``_low``, ``_high``, and the same with ``_over_batches``. Those by label
        have dims (label, estimator) and the prefix ``label_``.
        """
        measured = ("estimator", "part")
        height, width = self.test_pixels.shape
        coordinates: dict[str, Any] = {
            "estimator": _names(self.estimators),
            "part": _names([*self.channels, "mean"]),
            "channel": _names(self.channels),
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
            **_variables(self.measures, measured),
            **_variables(self.over_batches, measured, over_batches=True),
            **{k: (where, v, _about(*about)) for k, (where, v, *about) in images.items()},
            "uses_neighbours": (dims[:1], self.uses_neighbours, _about(_LOOKS)),
        }
        if self.breakdown is not None:
            found = self.breakdown
            coordinates["label"] = _names(found.labels)
            about = _about("pixels with the label that judge")
            variables["label_pixels"] = (("label",), found.pixels, about)
            variables |= _variables(found.measures, ("label", "estimator"), prefix="label_")
        return _dataset(variables, coordinates, {"n": self.n, **self.provenance})


@dataclass(frozen=True)
class ErrorCurve:
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
        return [
            {
                "n": size,
                "estimator": name,
                "uses_neighbours": bool(self.uses_neighbours[k]),
                **_row(self.measures, (row, k)),
            }
            for row, size in enumerate(self.sizes)
            for k, name in enumerate(self.estimators)
            if np.isfinite(self.measures["mse"].value[row, k])
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        content = {
            "sizes": self.sizes,
            "batches": self.batches,
            "test_pixels": self.test_pixels,
            "reference_noise": dict(self.reference_noise),
            "table": self.table(),
            "provenance": dict(self.provenance),
        }
        return {key: plain(value) for key, value in content.items()}

    def to_dataset(self) -> xr.Dataset:
        """Return the measures with dims (n, estimator), each with ``_se``, ``_low``, ``_high``."""
        variables = _variables(self.measures, ("n", "estimator"))
        for measure, noise in self.reference_noise.items():
            long_name, units = MEASURES[measure]
            about = _about(f"{long_name} of a perfect estimator", units)
            variables[f"{measure}_reference_noise"] = (("n",), noise, about)
        variables["uses_neighbours"] = (("estimator",), self.uses_neighbours, _about(_LOOKS))
        variables["batches"] = (("n",), self.batches, _about("estimates that count"))
        sizes = ("n", np.array(self.sizes), _about("samples per estimate"))
        coordinates = {"n": sizes, "estimator": _names(self.estimators)}
        return _dataset(variables, coordinates, self.provenance)
