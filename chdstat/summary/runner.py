"""Runner: apply a statistic to an array, a histogram or an image.

`run` takes any source that users give. A statistic that builds on another one of the same rows gets
it from `measured`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    ParamSpec,
    Protocol,
    TypeAlias,
    TypeVar,
    cast,
    overload,
)

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, as_pixels, as_samples, warn_left_out
from chdstat._core.positive import Part, PositivePart
from chdstat._core.statistic import Statistic
from chdstat.errors import InputError
from chdstat.samples import ImageLike, Mapped, Samples, opened
from chdstat.summary.histograms import Histogram

if TYPE_CHECKING:
    import xarray as xr

Source: TypeAlias = "ImageLike | Histogram | xr.Dataset | npt.ArrayLike"
"""An image, a log histogram, the log histograms of an image, or an array."""

Found = TypeVar("Found")
Options = ParamSpec("Options")
Own = TypeVar("Own", covariant=True)

_USERS = tuple(
    f"chdstat.{part}" for part in ("summary.runner", "fit", "inference", "patterns.classification")
)
"""Modules whose functions users call with samples; warnings point at the caller of these."""


class OfSource(Protocol[Options, Own]):
    """Type of a function that returns a dataset for an image, and another type otherwise."""

    @overload
    def __call__(
        self, x: ImageLike | xr.Dataset, *args: Options.args, **options: Options.kwargs
    ) -> xr.Dataset: ...
    @overload
    def __call__(
        self, x: Histogram | npt.ArrayLike, *args: Options.args, **options: Options.kwargs
    ) -> Own: ...


def of_source(
    function: Callable[Concatenate[Source, Options], Own | xr.Dataset],
) -> OfSource[Options, Own]:
    """Declare the return type of a function of any `Source`; the function stays as it is."""
    return cast("OfSource[Options, Own]", function)


def run(
    statistic: Statistic[Found],
    x: Source,
    *,
    null: npt.ArrayLike | None = None,
    progress: bool = True,
) -> Found | xr.Dataset:
    """Apply a statistic.

    Parameters
    ----------
    statistic
        What to measure.
    x
        Radiance, shape (..., sample), or (..., channel, sample) if the statistic is of luminance; a
        `Histogram` of log scale; an image, as `Samples` or the path of a store; or the dataset that
        `chdstat.histogram` returns for an image.
    null
        Mask of the null samples of an array, broadcastable to it.
    progress
        As for `Samples.map`.

    Returns
    -------
    Found or xarray.Dataset
        The result for an array or a `Histogram`; for an image, a dataset of its variables.

    Raises
    ------
    InputError
        If `null` is given without an array, or the statistic needs samples and gets a histogram.
    StoreError
        If there is no store at a path, or it is damaged.
    """
    description = statistic.description.format(statistic.subject)
    dataset: Any = x if hasattr(x, "data_vars") else None  # told without importing xarray
    given = opened(cast("ImageLike | npt.ArrayLike", x))
    binned = dataset is not None or isinstance(given, Histogram)
    if null is not None and (binned or isinstance(given, Samples)):
        message = f"null is for arrays: a {type(given).__name__} knows which samples are null"
        raise InputError(message)
    if binned and not statistic.binned:
        message = f"{description} needs the samples themselves, got a histogram"
        raise InputError(message)
    if statistic.film and (not isinstance(given, Samples) or given.film is None):
        message = "these samples do not say where they fell; render them with film=True (--film)"
        raise InputError(message)
    if isinstance(given, Samples):

        def of_block(block: Image, places: Image | None = None) -> Mapped:
            part = PositivePart.of_pixels(block, rows=statistic.rows, places=places)
            return statistic.variables(measured(part, statistic))

        kinds: Any = {"logarithms": statistic.logarithms, "description": description}
        kinds["film"] = statistic.film
        return statistic.finish(given.map(of_block, **kinds, progress=progress))
    if dataset is not None:
        import xarray as xr

        found = statistic.variables(measured(Histogram.of_dataset(dataset).positive, statistic))
        coords = {name: dataset[name] for name in ("y", "x", "channel") if name in dataset.coords}
        named = {name: (("y", "x", *dims), values) for name, (dims, values) in found.items()}
        return statistic.finish(xr.Dataset(named, coords=coords, attrs=dataset.attrs))
    if isinstance(given, Histogram):
        return measured(given.positive, statistic)
    if statistic.rows == "luminance":
        pixels = as_pixels(given)
        warn_left_out(pixels, channel_axis=-2, logarithms=True, within=_USERS)
        return measured(PositivePart.of_pixels(pixels, rows="luminance"), statistic)
    samples = as_samples(given)
    warn_left_out(samples, logarithms=statistic.logarithms, within=_USERS)
    return measured(PositivePart.of(samples, null=null), statistic)


def measured(part: Part, statistic: Statistic[Found]) -> Found:
    """Return a statistic of rows of samples, computed once for all callers.

    NumPy's warnings are silenced: missing numbers are NaN and have a reason.
    """
    if statistic not in part.found:
        with np.errstate(all="ignore"):
            part.found[statistic] = statistic.measure(part)
    known: Found = part.found[statistic]
    return known
