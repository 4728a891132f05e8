"""Routes: run one function over whatever a user has, be it samples, a histogram or an image.

Every public function on the positive part (fits, mixtures, selection) goes through `run`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

import numpy.typing as npt

from chdstat._core.positive import PositivePart
from chdstat.errors import InputError
from chdstat.samples import Mapped, Samples
from chdstat.summary.histograms import Histogram
from chdstat.summary.positive_histogram import BinnedPart

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Part", "Source", "run"]

Part: TypeAlias = PositivePart | BinnedPart
"""Positive samples, themselves or in bins."""
Source: TypeAlias = "Samples | Histogram | xr.Dataset | npt.ArrayLike"
"""What users give: an image, a log histogram, the log histograms of an image, or an array."""

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
        return of_part(BinnedPart.of(x))
    if dataset is not None:
        return _dataset(dataset, variables(of_part(BinnedPart.of_dataset(dataset))))
    return of_part(PositivePart.given(cast("npt.ArrayLike", x), null=null))


def _dataset(source: xr.Dataset, variables: Mapped) -> xr.Dataset:
    import xarray as xr

    coords = {name: source[name] for name in ("y", "x", "channel") if name in source.coords}
    named = {name: (("y", "x", *dims), values) for name, (dims, values) in variables.items()}
    return xr.Dataset(named, coords=coords, attrs=source.attrs)
