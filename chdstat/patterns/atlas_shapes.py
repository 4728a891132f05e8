"""Shapes: the distribution of log radiance of each pixel, moved so that its mean is 0.

Radiance of another scale has the same shape. `of_samples` walks an image twice, in constant memory:
for the means, then for counts around them; `of_histograms` moves log histograms that exist.
`chdstat.patterns` looks for the shapes that recur.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import is_bad, luminance, spans
from chdstat._core.moments import Moments
from chdstat._core.positive import CONSTANT_SPREAD, Counts, Floats, Mask
from chdstat._core.reasons import Reason, first_of
from chdstat.samples import Blocks, Mapped, Samples, reduce_tiles
from chdstat.summary.bins import Support
from chdstat.summary.histograms import StreamingHistogram
from chdstat.summary.positive_histogram import BinnedPart

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "BINS",
    "MINIMUM",
    "WIDTH",
    "Aligned",
    "Shapes",
    "densities",
    "of_histograms",
    "of_samples",
]

BINS = 81
"""Bins of a shape; the middle one has the mean in its centre."""
WIDTH = 0.1
"""Width of a bin in decades."""
_EDGES = WIDTH * (np.arange(1, BINS) - BINS / 2)
"""Edges between bins in decades from the mean; the two outer bins are open."""
MINIMUM = 32
"""Positive samples that a shape needs."""

_FINE = 4
"""Bins counted per bin of a shape, so that halves of the samples can be moved apart from it."""
_BATCH = 64
_PARTS = ("whole", "one", "two")

Singles = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Aligned:
    """Distributions of log10 radiance around their means.

    Attributes
    ----------
    cumulative
        Share of the positive samples below each edge, shape (y, x, edge); NaN where no shape is.
    null_share
        Share of nulls among all of them, shape (y, x).
    """

    cumulative: Singles
    null_share: Singles


@dataclass(frozen=True)
class Shapes:
    """Shapes of an image.

    Attributes
    ----------
    whole
        Of all samples.
    halves
        Of two random halves of the samples, each moved by its own mean.
    log_scale
        Mean of log10 radiance, shape (y, x).
    reason
        `Reason` codes: where there is no shape, and why.
    """

    whole: Aligned
    halves: tuple[Aligned, Aligned]
    log_scale: Floats
    reason: npt.NDArray[np.int8]


def densities(cumulative: npt.NDArray[np.floating[Any]]) -> Floats:
    """Return the density per decade in each bin, shape (..., bin), of shapes (..., edge)."""
    return np.diff(cumulative.astype(np.float64), axis=-1, prepend=0, append=1) / WIDTH


def of_samples(
    samples: Samples, rng: np.random.Generator, *, progress: bool | None = None
) -> Shapes:
    """Return the shapes of the luminance of an image."""

    def of_tile(ys: slice, xs: slice, blocks: Blocks) -> Mapped:
        log, n_good, n_null = _log_moments(blocks)
        center = np.where(log.count > 0, log.mean, np.nan)
        again = (samples.read(ys, xs, ss) for ss in spans(samples.spp, _BATCH))
        counts = _count(again, center)
        log_variance = log.m2 / np.maximum(log.count, 1) * np.log(10) ** 2
        reason = _reason(log.count, n_good, n_null, log_variance)
        grid = _Grid(*(np.full(center.shape, v) for v in (-WIDTH * BINS / 2, WIDTH / _FINE)))
        parts = _moved(counts, n_null, grid, np.zeros(center.shape), reason == Reason.OK, rng)
        return {**_variables(parts), "log_scale": ((), center), "reason": ((), reason)}

    found = reduce_tiles(samples, of_tile, description="aligning shapes", progress=progress)
    values = {str(name): array.to_numpy() for name, array in found.items()}
    whole, one, two = (
        Aligned(values[f"{name}_cumulative"], values[f"{name}_null_share"]) for name in _PARTS
    )
    return Shapes(whole, (one, two), values["log_scale"], values["reason"])


def of_histograms(dataset: xr.Dataset, rng: np.random.Generator) -> Shapes:
    """Return the shapes of the log histograms of an image, of the channel in the middle.

    That is green, the most of luminance, or the only channel. Bins move by fractions of a bin, as
    if samples were spread evenly within them.

    Raises
    ------
    InputError
        If the dataset lacks a variable of a log histogram.
    """
    middle = slice(dataset.sizes.get("channel", 0) // 2, None)
    part = BinnedPart.of_dataset(dataset.isel(channel=middle, missing_dims="ignore"))
    counts, n, n_null = part.counts[:, :, 0], part.n[:, :, 0], part.n_null[:, :, 0]
    width, first = part.width[:, :, 0] / np.log(10), part.log_centers[:, :, 0, 0] / np.log(10)
    grid = _Grid(*(np.broadcast_to(v, n.shape) for v in (first - width / 2, width)))
    n_dark = part.n_null[:, :, 0] + part.n_zero[:, :, 0]
    reason = _reason(n, part.n_good[:, :, 0], n_dark, part.log_statistics.log_variance[:, :, 0])
    center = grid.mean(counts)
    whole, one, two = _moved(counts, n_null, grid, center, reason == Reason.OK, rng)
    return Shapes(whole, (one, two), center, reason)


@dataclass(frozen=True)
class _Grid:
    """Where bins of log10 radiance are: the first edge and the width, each of shape (...)."""

    low: Floats
    width: Floats

    def mean(self, counts: npt.NDArray[Any]) -> Floats:
        """Return the mean of what was counted, shape (...); NaN of nothing."""
        places = np.vecdot(counts, np.arange(counts.shape[-1]) + 0.5)
        return np.asarray(self.low + self.width * _ratio(places, counts.sum(axis=-1)))

    def below(self, counts: npt.NDArray[Any], center: Floats) -> Singles:
        """Return the share below each edge of a shape around `center`, shape (..., edge)."""
        total = np.cumsum(counts, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros((*total.shape[:-1], 1)), total], axis=-1)
        total /= np.maximum(total[..., -1:], 1)
        offset = (center - self.low)[..., np.newaxis]
        # Rounded, so that an edge that is an edge of the bins stays one.
        place = np.round((_EDGES + offset) / self.width[..., np.newaxis], 9)
        place = np.clip(np.nan_to_num(place), 0, counts.shape[-1])
        left = np.minimum(place.astype(np.intp), counts.shape[-1] - 1)
        start, stop = (np.take_along_axis(total, i, axis=-1) for i in (left, left + 1))
        return np.asarray(start + (place - left) * (stop - start), dtype=np.float32)


def _log_moments(blocks: Blocks) -> tuple[Moments, Counts, Counts]:
    """Return the moments of log10 of positive luminance, and how many are good, and how many 0."""
    parts = (_of_block(block) for block in blocks)
    log, n_good, n_null = next(parts)
    for more, good, null in parts:
        log, n_good, n_null = log.merge(more), n_good + good, n_null + null
    return log, n_good, n_null


def _of_block(block: npt.NDArray[np.float32]) -> tuple[Moments, Counts, Counts]:
    light, good = _luminance(block)
    positive, null = good & (light > 0), good & (light == 0)
    log = np.log10(np.where(positive, light, 1))
    n_good, n_null = np.count_nonzero(good, axis=-1), np.count_nonzero(null, axis=-1)
    return Moments.of(log, positive), n_good, n_null


def _luminance(block: npt.NDArray[np.float32]) -> tuple[Floats, Mask]:
    """Return the luminance of samples, 0 for bad ones, and which are good."""
    good = np.asarray(~is_bad(block).any(axis=-2))
    return np.where(good, luminance(block), 0).astype(np.float64), good


def _count(blocks: Blocks, center: Floats) -> Counts:
    """Count luminance in fine bins around `center`, shape (y, x, bin); the end bins are open."""
    missing = np.isnan(center)
    reason = np.where(missing, Reason.ALL_NULL, Reason.OK).astype(np.int8)
    low, high = (10.0 ** (center + sign * WIDTH * BINS / 2) for sign in (-1, 1))
    stream = StreamingHistogram(bins=BINS * _FINE, support=Support(low, high, reason))
    for block in blocks:
        stream.update(_luminance(block)[0])
    read = stream.read()
    read.counts[..., 0] += read.underflow - read.negative
    read.counts[..., -1] += read.overflow
    return read.counts


def _moved(
    counts: npt.NDArray[Any],
    n_null: Counts,
    grid: _Grid,
    center: Floats,
    ok: Mask,
    rng: np.random.Generator,
) -> tuple[Aligned, ...]:
    """Return the shapes around `center`, and of two random halves around their own means."""
    # Samples are exchangeable: halving the counts at random is halving the samples at random.
    half, null = rng.binomial(counts.astype(np.int64), 0.5), rng.binomial(n_null, 0.5)
    rest = counts - half
    parts = (
        (counts, n_null, center),
        (half, null, grid.mean(half)),
        (rest, n_null - null, grid.mean(rest)),
    )
    return tuple(
        Aligned(
            cumulative=np.where(ok[..., np.newaxis], grid.below(some, place), np.float32(np.nan)),
            null_share=_ratio(nulls, nulls + some.sum(axis=-1)).astype(np.float32),
        )
        for some, nulls, place in parts
    )


def _variables(parts: tuple[Aligned, ...]) -> Mapped:
    cumulative = {
        f"{name}_cumulative": (("edge",), part.cumulative)
        for name, part in zip(_PARTS, parts, strict=True)
    }
    nulls = {
        f"{name}_null_share": ((), part.null_share)
        for name, part in zip(_PARTS, parts, strict=True)
    }
    return {**cumulative, **nulls}


def _reason(
    n: Counts | Floats, n_good: Counts, n_null: Counts, log_variance: Floats
) -> npt.NDArray[np.int8]:
    return first_of(
        {
            Reason.ALL_BAD: n_good == 0,
            Reason.NONE_POSITIVE: (n == 0) & (n_null < n_good),
            Reason.ALL_NULL: n == 0,
            Reason.TOO_FEW: n < MINIMUM,
            Reason.CONSTANT: log_variance <= CONSTANT_SPREAD**2,
        }
    )


def _ratio(part: npt.NDArray[Any], whole: npt.NDArray[Any]) -> Floats:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(part / whole, dtype=np.float64)
