"""Log CHDs: distribution functions of log10 radiance, and unbiased distances between them.

Noise makes the distance of two measured distribution functions too large, even if the CHDs are
equal. Each function is therefore measured from two halves of the samples. The product of the
differences in the two halves has the true squared distance as its expectation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, generator, spans
from chdstat._core.resampling import Interval
from chdstat.inference.findings import ClaimTest, PlotData
from chdstat.patterns.atlases import WIDTH as ATLAS_WIDTH

if TYPE_CHECKING:
    from collections.abc import Mapping

    import xarray as xr

WIDTH = 0.05
"""Width of a bin in decades."""
EDGES = WIDTH * np.arange(-80, 81)
"""Edges between bins, decades; the outer bins are open."""
SAME_SHAPE = 0.1
"""Cramér distance below which two CHDs count as the same, in square roots of decades.

That is as far as distribution functions that differ by 10 points over one decade. Two log-normal
CHDs are that far apart if the spread of one is 1.5 times that of the other, at a third of a decade,
which is usual. The paper says "the same" by eye; where the border lies is a choice of ours.
"""
_REACH = 1e5
"""Factor from the pixel's mean beyond which samples are ignored: the paper's log histograms reach
from 1e-5 to 1e5. In the bathroom, one sample in a thousand has about 1e-17, and would dominate the
moments of logarithms."""
LEAST = 16
"""Fewest positive samples in each half for a distribution function."""
_CHUNK = 2048
"""Pixels whose histograms are worked on at once."""


@dataclass(frozen=True)
class LogChds:
    """Distribution functions of log10 radiance.

    Attributes
    ----------
    halves
        Share of the samples of each half that are at most each edge, shape (..., 2, edge); NaN if
        there are too few.
    width
        Distance of the edges, decades.
    """

    halves: npt.NDArray[np.floating[Any]]
    width: float = WIDTH

    @property
    def whole(self) -> Floats:
        """Return the distribution function of both halves together, shape (..., edge)."""
        return np.asarray(self.halves.mean(axis=-2), dtype=np.float64)

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """Return where the distribution function is known, shape (...)."""
        return np.asarray(np.isfinite(self.halves[..., 0]).all(axis=-1))

    @property
    def flat(self) -> LogChds:
        """Return the functions of an image (y, x) as (pixel,), in reading order."""
        return replace(self, halves=self.halves.reshape(-1, *self.halves.shape[2:]))

    def __getitem__(self, index: Any) -> LogChds:
        """Return some of the functions."""
        return replace(self, halves=self.halves[index])


def aligned(x: npt.NDArray[np.floating[Any]]) -> LogChds:
    """Return the shapes of positive radiance: log10 radiance minus its mean.

    Parameters
    ----------
    x
        Radiance, shape (..., sample); 0 and NaN are left out. Samples alternate between the halves,
        and each half is centred by its own mean.
    """
    rows = visible(x).reshape(-1, x.shape[-1])
    halves = np.stack([_cumulative(rows[:, i::2]) for i in (0, 1)], axis=1)
    return LogChds(halves.reshape(*x.shape[:-1], 2, len(EDGES)))


def of_histograms(dataset: xr.Dataset) -> LogChds:
    """Return the distribution functions of all pixels, including nulls, from their histograms.

    Since samples are exchangeable, a random half of the counts is a random half of the samples.

    Parameters
    ----------
    dataset
        Log histograms, from `chdstat.summarize`; the middle channel is used.

    Returns
    -------
    LogChds
        Shape (y, x, 2, edge), edges 0.1 decades apart; not centred.
    """
    channel = dataset.sizes["channel"] // 2
    below, inside, above = (
        dataset[f"log_{name}"].to_numpy()[:, :, channel]
        for name in ("underflow", "counts", "overflow")
    )
    good, rng = dataset["count"].to_numpy(), generator(0)
    halves = np.empty((*good.shape, 2, inside.shape[-1] + 1), dtype=np.float32)
    for ys in spans(len(good), max(1, _CHUNK // good.shape[1])):
        # Samples that are 0 in this channel only count like null samples.
        dark = np.maximum(good[ys] - inside[ys].sum(axis=-1) - above[ys], below[ys])
        counts = np.concatenate([dark[..., None], inside[ys], above[ys, :, None]], axis=-1)
        half = rng.binomial(counts, 0.5)
        both = np.stack([half, counts - half], axis=-2)
        n = both.sum(axis=-1, keepdims=True)
        shares = np.cumsum(both[..., :-1], axis=-1) / np.maximum(n, 1)
        halves[ys] = np.where(n >= LEAST, shares, np.nan)
    return LogChds(halves, ATLAS_WIDTH)


def visible(x: npt.NDArray[np.floating[Any]]) -> Floats:
    """Return radiance (..., sample) with 0 for ignored samples and for bad ones."""
    positive = x > 0
    count = np.maximum(positive.sum(axis=-1, keepdims=True), 1)
    mean = np.where(positive, x, 0).sum(axis=-1, keepdims=True, dtype=np.float64) / count
    seen = positive & (x >= mean / _REACH) & (x <= mean * _REACH)
    return np.where(seen, x, 0).astype(np.float64)


def squared_distance(one: LogChds, two: LogChds) -> Floats:
    """Return unbiased squared Cramér distances, in decades; noise may make them negative.

    ``sum((F1 - G1) (F2 - G2)) width``, with the functions F and G of both halves.

    References
    ----------
    Cramér, "On the composition of elementary errors", 1928, doi:10.1080/03461238.1928.10416862.
    Walther et al., "Reliability of dissimilarity measures for multi-voxel pattern analysis", 2016,
    doi:10.1016/j.neuroimage.2015.12.012: products of independent halves.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x, y = rng.lognormal(size=(2, 4000))
    >>> bool(abs(squared_distance(aligned(x), aligned(3 * y))) < 1e-3)
    True
    """
    difference = one.halves - two.halves
    product = difference[..., 0, :] * difference[..., 1, :]
    return np.asarray(product.sum(axis=-1, dtype=np.float64) * one.width)


def same_shape(name: str, distance: Interval[float]) -> ClaimTest:
    """Return the test whether a Cramér distance is small enough for the same shape."""
    return ClaimTest(name, distance, most=SAME_SHAPE, unit="decade^1/2")


def mean_shapes(chds: Mapping[str, LogChds]) -> PlotData:
    """Return curves of the means of shapes (pixel,), by name, where there are any."""
    known = {name: of_name[of_name.known].whole for name, of_name in chds.items()}
    return shape_plot({name: whole.mean(axis=0) for name, whole in known.items() if len(whole)})


def shape_plot(shapes: Mapping[str, Floats]) -> PlotData:
    """Return curves of shapes (edge,) around their means, by name."""
    series = {name: (EDGES, shape) for name, shape in shapes.items()}
    return PlotData("curves", series, "log10 radiance around its mean", "share below")


def _cumulative(rows: Floats) -> Floats:
    """Return shares of positive samples at most at each edge around their mean, (row, edge)."""
    log, positive = centred_logs(rows)
    n = positive.sum(axis=1)
    # Rounding could put equal values on both sides of an edge.
    place = np.ceil(np.round((log - EDGES[0]) / WIDTH, 6))
    bins = np.clip(place, 0, len(EDGES)).astype(np.intp)
    below = np.cumsum(counts_by_row(bins, positive, len(EDGES) + 1)[:, :-1], axis=1)
    return np.where((n >= LEAST)[:, np.newaxis], below / np.maximum(n, 1)[:, np.newaxis], np.nan)


def centred_logs(rows: Floats) -> tuple[Floats, Mask]:
    """Return log10 of positive radiance (row, sample) less its mean, and which is positive."""
    positive = rows > 0
    log = np.log10(np.where(positive, rows, 1))
    middle = log.sum(axis=1, keepdims=True) / np.maximum(positive.sum(axis=1, keepdims=True), 1)
    return log - middle, positive


def counts_by_row(bins: npt.NDArray[np.integer[Any]], counted: Mask, size: int) -> Counts:
    """Return the number of counted samples in each bin of each row, shape (row, size)."""
    place = bins + np.arange(len(bins))[:, np.newaxis] * size
    return np.bincount(place[counted], minlength=len(bins) * size).reshape(len(bins), size)
