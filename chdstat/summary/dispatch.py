"""Dispatch: run one function over whatever a user has; `chdstat.summary.runner` follows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy.typing as npt

from chdstat._core.arrays import as_samples, warn_left_out
from chdstat._core.positive import Part, PositiveHistogram, PositivePart
from chdstat.errors import InputError
from chdstat.samples import Mapped, Samples
from chdstat.summary.histograms import Histogram
from chdstat.summary.runner import OfSource, Source, of_source

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "OfSource",
    "Part",
    "PositiveHistogram",
    "Source",
    "of_source",
    "run",
]

Result = TypeVar("Result")


def run(
    x: Source,
    of_part: Callable[[Part], Result],
    variables: Callable[[Result], Mapped],
    *,
    null: npt.ArrayLike | None = None,
    description: str,
    progress: bool | None = None,
) -> Result | xr.Dataset:
    """Apply a function of the positive part.

    Parameters
    ----------
    x
        Radiance, shape (..., sample); a `Histogram` of log scale; all samples of an image; or the
        dataset that `chdstat.histogram` returns for an image.
    of_part
        What to compute of the rows of a part.
    variables
        How its result becomes variables over (y, x).
    null
        Which samples of an array are null, broadcastable to it.
    description, progress
        As for `Samples.map`.

    Returns
    -------
    Result or xarray.Dataset
        What `of_part` returns for an array or a `Histogram`; for an image, its variables.

    Raises
    ------
    InputError
        If `null` is given for anything but an array.
    """
    # An xarray dataset, told without importing xarray.
    dataset: Any = x if hasattr(x, "data_vars") else None
    if null is not None and (dataset is not None or isinstance(x, (Samples, Histogram))):
        message = f"null is for arrays: a {type(x).__name__} knows which samples are null"
        raise InputError(message)
    if isinstance(x, Samples):
        return x.map(
            lambda block: variables(of_part(PositivePart.of_pixels(block))),
            logarithms=True,
            description=description,
            progress=progress,
        )
    if isinstance(x, Histogram):
        return of_part(x.positive)
    if dataset is not None:
        import xarray as xr

        found = variables(of_part(Histogram.of_dataset(dataset).positive))
        coords = {name: dataset[name] for name in ("y", "x", "channel") if name in dataset.coords}
        named = {name: (("y", "x", *dims), values) for name, (dims, values) in found.items()}
        return xr.Dataset(named, coords=coords, attrs=dataset.attrs)
    samples = as_samples(cast("npt.ArrayLike", x))
    warn_left_out(samples, logarithms=True, within=("chdstat.summary", "chdstat.fit"))
    return of_part(PositivePart.of(samples, null=null))
