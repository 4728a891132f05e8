"""Dispatch: run one function over whatever a user has, be it samples, a histogram or an image.

Every public function on the positive part (fits, mixtures, selection) goes through `run`, and sees
a `Part`: positive samples, or a `PositiveHistogram` of them, which answers what `PositivePart`
answers at a cost and in a memory that do not depend on spp: a streamed render can be fitted without
its samples. Three things are lost. Where a sample lies within its bin: a distribution narrower than
a bin (0.1 decades by default) is constant. What lies outside the support: samples above it count as
the last bin, samples below it cannot be told from zeros of one channel and count as those. And the
order of the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
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

from chdstat._core.arrays import Counts, Floats
from chdstat._core.positive import LogStatistics, PositivePart, SplitRows
from chdstat.errors import InputError
from chdstat.samples import ImageLike, Mapped, Samples
from chdstat.summary.histograms import Histogram

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "OfImage",
    "OfSource",
    "Part",
    "PositiveHistogram",
    "Source",
    "of_image",
    "of_source",
    "run",
]

_NEEDED = ("log_counts", "log_underflow", "log_overflow", "null_count", "bad_count")


@dataclass(frozen=True)
class PositiveHistogram(SplitRows):
    """Counts of positive samples in bins that divide log radiance evenly.

    Attributes
    ----------
    counts
        Samples per bin, shape (..., bin).
    log_centers
        Natural logarithm of radiance at the centre of each bin, shape (..., bin) or (1, ..., bin).
    width
        Width of a bin in natural logarithm, shape (...) or (1, ...).
    n, n_null, n_zero, n_negative, n_bad
        Samples in the bins; null ones; those too dark for the bins, or 0 in this channel alone;
        negative ones; bad ones. Shape (...).
    """

    counts: Floats
    log_centers: Floats
    width: Floats
    n: Counts
    n_null: Counts
    n_zero: Counts
    n_negative: Counts
    n_bad: Counts

    @classmethod
    def of(cls, histogram: Histogram) -> PositiveHistogram:
        """Take over a log histogram.

        Raises
        ------
        InputError
            If its bins divide radiance, not its logarithm.
        """
        if histogram.scale != "log":
            message = f"a fit needs a log histogram, got one of {histogram.scale} scale"
            raise InputError(message)
        bins = histogram.counts.shape[-1]
        with np.errstate(invalid="ignore"):
            start, stop = _shared(np.log(histogram.low)), _shared(np.log(histogram.high))
        width = (stop - start) / bins
        filled = histogram.counts.astype(np.float64)
        filled[..., -1] += histogram.overflow
        n = filled.sum(axis=-1).astype(np.int64)
        null, bad = (
            np.broadcast_to(count, n.shape).astype(np.int64)
            for count in (histogram.null_count, histogram.bad_count)
        )
        return cls(
            counts=filled,
            log_centers=start[..., np.newaxis] + width[..., np.newaxis] * (np.arange(bins) + 0.5),
            width=width,
            n=n,
            n_null=null,
            n_zero=(histogram.underflow - histogram.negative).astype(np.int64),
            n_negative=histogram.negative.astype(np.int64),
            n_bad=bad,
        )

    @classmethod
    def of_dataset(cls, dataset: xr.Dataset) -> PositiveHistogram:
        """Take over what `chdstat.histogram` says of an image, over (y, x, channel).

        Raises
        ------
        InputError
            If the dataset lacks a variable of a log histogram.
        """
        missing = [name for name in _NEEDED if name not in dataset]
        if missing:
            message = (
                "expected the dataset of chdstat.histogram(samples, scale='log'), "
                f"got one without {', '.join(missing)}"
            )
            raise InputError(message)
        # Older datasets counted negative samples as bad.
        negative = dataset.get("log_negative", 0 * dataset["log_underflow"])
        names = ("counts", "low", "high", "underflow", "overflow")
        return cls.of(
            Histogram(
                scale="log",
                **{name: dataset[f"log_{name}"].to_numpy() for name in names},
                negative=negative.to_numpy(),
                null_count=dataset["null_count"].to_numpy()[..., np.newaxis],
                bad_count=dataset["bad_count"].to_numpy()[..., np.newaxis],
                reason=np.zeros(negative.shape, dtype=np.int8),
                n=0,
            )
        )

    @cached_property
    def log_statistics(self) -> LogStatistics:
        """Mean, log-mean and log-variance of the positive samples, corrected for the bins.

        Moving the samples to the centres of bins of width h adds h^2 / 12 to the variance and
        multiplies the moment generating function at t by (2 / (h t)) sinh(h t / 2), for densities
        that are smooth at the scale of a bin: Sheppard, "On the calculation of the most probable
        values of frequency-constants", 1898, doi:10.1112/plms/s1-29.1.353. Both are undone.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            log_mean = np.vecdot(self.counts, self.log_centers) / self.n
            centered = self.log_centers - log_mean[..., np.newaxis]
            log_variance = np.vecdot(self.counts, centered**2) / self.n - self.width**2 / 12
            ratio = np.vecdot(self.counts, np.exp(centered)) / self.n
            ratio *= (self.width / 2) / np.sinh(self.width / 2)
            # A distribution within one bin: the correction is larger than what there is.
            variance = np.where(log_variance > 0, log_variance, np.where(self.n > 0, 0, np.nan))
            gap = np.where(variance > 0, np.log(ratio), np.where(self.n > 0, 0, np.nan))
            mean = np.exp(log_mean + gap)
        return LogStatistics(n=self.n, mean=mean, gap=gap, log_variance=variance)


def _shared(values: Floats) -> Floats:
    """Return one value for all rows where they agree, shape (1, ...): most histograms do."""
    first = values[(slice(0, 1),) * values.ndim]
    return first if (values == first).all() else values


Part: TypeAlias = PositivePart | PositiveHistogram
"""Positive samples, themselves or in bins."""
Source: TypeAlias = "Samples | Histogram | xr.Dataset | npt.ArrayLike"
"""What users give: an image, a log histogram, the log histograms of an image, or an array."""

Result = TypeVar("Result")
Options = ParamSpec("Options")
Own = TypeVar("Own", covariant=True)


class OfSource(Protocol[Options, Own]):
    """Type of a function that returns a dataset for an image, and a type of its own otherwise."""

    @overload
    def __call__(
        self, x: Samples | xr.Dataset, *args: Options.args, **options: Options.kwargs
    ) -> xr.Dataset: ...
    @overload
    def __call__(
        self, x: Histogram | npt.ArrayLike, *args: Options.args, **options: Options.kwargs
    ) -> Own: ...


def of_source(
    function: Callable[Concatenate[Source, Options], Own | xr.Dataset],
) -> OfSource[Options, Own]:
    """Tell type checkers what a function of any `Source` returns; the function stays as it is."""
    return cast("OfSource[Options, Own]", function)


class OfImage(Protocol[Options, Own]):
    """Type of a function that returns a dataset for an image, or the path of one, as `OfSource`."""

    @overload
    def __call__(
        self, x: ImageLike, *args: Options.args, **options: Options.kwargs
    ) -> xr.Dataset: ...
    @overload
    def __call__(self, x: npt.ArrayLike, *args: Options.args, **options: Options.kwargs) -> Own: ...


def of_image(
    function: Callable[Concatenate[ImageLike | npt.ArrayLike, Options], Own | xr.Dataset],
) -> OfImage[Options, Own]:
    """Tell type checkers what a function of an image or an array returns, as `of_source` does."""
    return cast("OfImage[Options, Own]", function)


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
        return of_part(PositiveHistogram.of(x))
    if dataset is not None:
        import xarray as xr

        found = variables(of_part(PositiveHistogram.of_dataset(dataset)))
        coords = {name: dataset[name] for name in ("y", "x", "channel") if name in dataset.coords}
        named = {name: (("y", "x", *dims), values) for name, (dims, values) in found.items()}
        return xr.Dataset(named, coords=coords, attrs=dataset.attrs)
    return of_part(PositivePart.given(cast("npt.ArrayLike", x), null=null))
