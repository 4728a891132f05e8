"""Summary: what each pixel's samples look like, in memory that does not grow with spp.

Use `summarize` on an image. Use `Summary` on samples that come in blocks, from several renderers or
from workers that see a part each: update, merge, read. Merging gives the same result as summarising
everything at once, up to rounding.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Counts, Floats, as_pixels, is_bad, label_variables
from chdstat._core.moments import Batches, PixelMoments
from chdstat._core.statistic import RADIANCE, Result, result, variable
from chdstat.errors import InputError
from chdstat.samples import ImageLike, Mapped, SampleBlocks, Samples, reduce_tiles, samples_of
from chdstat.samples.dependence import check_sequences, sequence_of
from chdstat.samples.tiles import Work
from chdstat.summary.histograms import (
    SCALES,
    GivenSupport,
    Histogram,
    StreamingHistogram,
    label_histogram,
    sample_masks,
    tile_support,
)

if TYPE_CHECKING:
    import xarray as xr

_SEQUENCES = 256
"""Means of sequences of dependent samples that are kept; if there are more, neighbours merge."""


@result
class Statistics(Result):
    """Statistics of samples, as `Summary.read` returns them.

    A sample with a bad channel is bad as a whole: it is counted and left out of everything else.

    Attributes
    ----------
    draws
        Samples per pixel, good or bad.
    count, null_count, bad_count, nan_count, inf_count, negative_count
        Numbers of samples, shape (...): good ones, including null ones; null ones; bad ones; bad
        ones with NaN and with infinite channels, where one sample may have both; and good ones with
        a negative channel, which are not left out.
    null_share
        ``null_count / count``, shape (...).
    mean, variance, skewness, kurtosis, minimum, maximum, standard_error
        Moments of the good samples, shape (..., channel). The variance is unbiased, and the
        kurtosis is excess kurtosis. NaN where there are too few samples; skewness and kurtosis also
        where samples are equal.
    batch_means
        Means of consecutive batches, shape (..., channel, batch). An incomplete last batch is left
        out, unless it is the only one.
    batch_spp
        Draws of each batch, shape (batch,).
    linear, log
        Histograms of the good, non-null samples, shape (..., channel, bin).
    """

    draws: int
    count: Counts = variable("good samples, null ones included")
    null_count: Counts = variable("null samples: all channels are 0")
    bad_count: Counts = variable("samples left out: a channel is NaN or infinite")
    nan_count: Counts = variable("samples with a NaN channel")
    inf_count: Counts = variable("samples with an infinite channel")
    negative_count: Counts = variable("good samples with a negative channel")
    null_share: Floats = variable("share of null samples among the good ones")
    mean: Floats = variable("sample mean", "channel", unit=RADIANCE)
    variance: Floats = variable("unbiased sample variance", "channel", unit=f"({RADIANCE})2")
    skewness: Floats = variable("skewness", "channel")
    kurtosis: Floats = variable("excess kurtosis", "channel")
    minimum: Floats = variable("smallest sample", "channel", unit=RADIANCE)
    maximum: Floats = variable("largest sample", "channel", unit=RADIANCE)
    standard_error: Floats = variable("standard error of the sample mean", "channel", unit=RADIANCE)
    batch_means: Floats = variable(
        "means of consecutive batches of samples", "channel", "batch", unit=RADIANCE
    )
    batch_spp: Counts
    linear: Histogram
    log: Histogram


_MOMENTS = [n for n, (_, about) in Statistics.declared().items() if about.dims == ("channel",)]


class Summary:
    """Statistics of samples that come in blocks; `merge` adds those of other blocks.

    The first block fixes the support of the linear histogram, so it should hold 50 draws or more;
    otherwise, give a `support`. Only summaries with the same support merge.

    Parameters
    ----------
    batch_size
        Draws per batch mean at the beginning.
    max_batches
        Most batches to keep, an even number. If there would be more, neighbours merge and the batch
        size doubles.
    bins
        Bins of each histogram.
    support
        Support of the linear histogram, see `chdstat.summary.histograms.linear_support`.

    Raises
    ------
    InputError
        If an option is out of range.

    References
    ----------
    Pebay, "Formulas for robust, one-pass parallel computation of covariances and arbitrary-order
    statistical moments", Sandia report SAND2008-6212, 2008.

    Examples
    --------
    >>> import numpy as np
    >>> red, black = np.array([[2.0], [0.0], [0.0]]), np.zeros((3, 1))
    >>> one = Summary(support=(0, 4)).update(np.hstack([red, black]))
    >>> two = Summary(support=(0, 4)).update(np.hstack([red, red]))
    >>> both = one.merge(two).read()
    >>> both.mean
    array([1.5, 0. , 0. ])
    >>> int(both.count), float(both.null_share)
    (4, 0.25)
    """

    def __init__(
        self,
        *,
        batch_size: int = 32,
        max_batches: int = 64,
        bins: int = 100,
        support: GivenSupport | None = None,
    ) -> None:
        self._batches = Batches((), size=batch_size, limit=max_batches)
        self._linear = StreamingHistogram(scale="linear", bins=bins, support=support)
        self._log = StreamingHistogram(scale="log", bins=bins)
        self._pixels = PixelMoments()

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Shape of the batch, (..., channel); None before the first update."""
        moments = self._pixels.moments
        return None if moments is None else moments.count.shape

    def update(self, block: npt.ArrayLike) -> Summary:
        """Add the next samples, shape (..., channel, sample).

        Raises
        ------
        InputError
            If the block has no channel axis, or its shape before the samples differs from the
            first.
        """
        x = as_pixels(block, name="block")
        if self.shape not in (None, x.shape[:-1]):
            message = (
                f"every block must have the shape of the first before its samples, {self.shape}, "
                f"got {x.shape[:-1]}"
            )
            raise InputError(message)
        null, bad = sample_masks(x)
        # The histograms come first, since they may refuse the block.
        for histogram in (self._linear, self._log):
            histogram.update(x, null=null, bad=bad)
        if self.shape is None:
            self._batches = self._batches.empty(x.shape[:-1])
        self._pixels.update(x, null, bad)
        self._batches.update(x, None if bad is None else ~bad)
        return self

    def merge(self, other: Summary) -> Summary:
        """Add the samples of `other`; its batches come after those of this summary.

        Raises
        ------
        InputError
            If the two differ in shape, options or the support of the linear histogram.
        """
        if other.shape is None:
            return self
        if self.shape not in (None, other.shape):
            message = (
                f"summaries merge only with the same shape, got {self.shape} and {other.shape}"
            )
            raise InputError(message)
        self._batches.check(other._batches)
        self._linear.merge(other._linear)
        self._log.merge(other._log)
        if self.shape is None:
            self._batches = self._batches.empty(other.shape)
        self._pixels.merge(other._pixels)
        self._batches.merge(other._batches)
        return self

    def read(self) -> Statistics:
        """Return the statistics of all samples so far.

        Raises
        ------
        InputError
            If there are none.
        """
        moments = self._pixels.moments
        if moments is None:
            message = "the summary has seen no samples; call update first"
            raise InputError(message)
        of_channels = {name: moments.seen(getattr(moments, name)) for name in _MOMENTS}
        known: dict[str, Any] = {**self._pixels.counts, **of_channels}
        means, spp = self._batches.read()
        count = moments.count[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            null_share = np.asarray(self._pixels.counts["null_count"] / count)
        return Statistics(
            draws=self._batches.total,
            count=count.astype(np.int64),
            **known,
            null_share=null_share,
            batch_means=means,
            batch_spp=spp,
            linear=self._linear.read(),
            log=self._log.read(),
        )


def summarize(
    samples: ImageLike | npt.ArrayLike,
    *,
    batch_size: int = 32,
    max_batches: int = 64,
    bins: int = 100,
    **work: Unpack[Work],
) -> xr.Dataset:
    """Return the statistics of every pixel, in constant memory.

    If samples depend on each other within sequences (see `chdstat.render`), batches are of whole
    sequences, and the standard error is that of independent averages of whole sequences. It needs
    at least two sequences.

    Parameters
    ----------
    samples
        Samples of an image: `Samples`, an array (y, x, channel, sample), or the path of a store.
    batch_size, max_batches, bins
        As for `Summary`.
    **work
        As for `Samples.map`: ``progress`` and ``client``.

    Returns
    -------
    xarray.Dataset
        The fields of `Statistics`: counts of samples and ``null_share`` with dims (y, x), moments
        with (y, x, channel), and ``batch_means`` with (y, x, channel, batch). Also the histograms
        of `chdstat.histogram`, such as ``linear_counts``. The attribute ``batch_size`` is the final
        size of the batches.

    Raises
    ------
    InputError
        If an option is out of range, an array is not an image, or dependent samples begin within a
        sequence.
    StoreError
        If there is no store at the path, or it is damaged.

    Examples
    --------
    >>> import numpy as np
    >>> dataset = summarize(np.random.default_rng(1).gamma(2.0, size=(2, 3, 3, 64)))
    >>> dataset["mean"].dims, dataset["batch_means"].shape
    (('y', 'x', 'channel'), (2, 3, 3, 2))
    """
    image = samples_of(samples, averages=True, dependent=True)
    check_sequences(image.attrs, image.part[2])
    length = sequence_of(image.attrs)
    batch_size = -(-batch_size // length) * length

    def of_tile(tile: Samples, blocks: SampleBlocks) -> Mapped:
        support = tile_support(tile)
        summary = Summary(
            batch_size=batch_size, max_batches=max_batches, bins=bins, support=support
        )
        sequences = Batches((), size=length, limit=_SEQUENCES)
        for block in blocks:
            summary.update(block)
            if length > 1:
                sequences = sequences if sequences.total else sequences.empty(block.shape[:-1])
                sequences.update(block, np.asarray(~is_bad(block).any(axis=-2, keepdims=True)))
        found = summary.read()
        if length > 1:
            found = replace(found, standard_error=_error_of_sequences(sequences, found))
        return _variables(found)

    # Running the batches alone tells how they will end, and refuses wrong options at once.
    batches = Batches((), size=batch_size, limit=max_batches)
    batches.update(np.zeros(image.spp))
    dataset = reduce_tiles(image, of_tile, description="summarising", **work)
    if image.unequal:  # an incomplete last batch is left out, of every pixel
        ends = np.cumsum(batches.read()[1])
        complete = (ends <= image.counts[..., np.newaxis]) | (ends == ends[0])
        dataset["batch_means"] = dataset["batch_means"].where(complete[:, :, np.newaxis])
    return _label(dataset, batches)


def _error_of_sequences(sequences: Batches, found: Statistics) -> Floats:
    """Return the standard error of the mean from means of whole sequences, which are independent.

    It is NaN if there is only one sequence.
    """
    means, draws = sequences.read()
    count = int((draws >= sequences.size).sum())
    if count < 2:
        return np.full(found.mean.shape, np.nan)
    variance = means.var(axis=-1, ddof=1)
    return np.asarray(np.sqrt(variance * sequences.size / found.draws))


def _variables(statistics: Statistics) -> Mapped:
    variables: dict[str, tuple[tuple[str, ...], Array]] = {}
    for name, (_, about) in Statistics.declared().items():
        value = np.asarray(getattr(statistics, name))
        # Counts of one image fit into 32 bits.
        variables[name] = about.dims, value.astype(np.int32) if value.dtype.kind == "i" else value
    dims, means = variables["batch_means"]
    variables["batch_means"] = dims, means.astype(np.float32)
    return {**variables, **statistics.linear.variables(), **statistics.log.variables()}


def _label(dataset: xr.Dataset, batches: Batches) -> xr.Dataset:
    declared = Statistics.declared().items()
    label_variables(dataset, {name: (about.label, about.unit) for name, (_, about) in declared})
    spp = ("batch", batches.read()[1], {"long_name": "draws of the batch", "units": "1"})
    for scale in SCALES:
        dataset = label_histogram(dataset, scale)
    return dataset.assign_coords(batch_spp=spp).assign_attrs(batch_size=batches.size)
