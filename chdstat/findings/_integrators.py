"""Integrators: whether two of them give the pixels of a scene CHDs of the same shape.

`permuted` tests whether there is any difference at all; how large it is, is a statement of its own,
with an interval of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, spans
from chdstat.atlases._shapes import WIDTH, of_histograms
from chdstat.findings.log_chds import LogChds, squared_distance
from chdstat.samples import Samples
from chdstat.summary import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["permuted", "squares", "squares_of_pairs", "thinned"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_PERMUTATIONS = 999
_AT_ONCE = 64
_HISTOGRAM = (
    *("log_counts", "log_underflow", "log_overflow", "null_count", "bad_count"),
    *("log_low", "log_high"),
)


def squares(one: xr.Dataset, two: xr.Dataset, *, seed: int = 0) -> Floats:
    """Return squared distances between the shapes of two renders of a view, shape (pixel,).

    In each pixel, of the render with more positive samples only as many count as the other has,
    drawn at random. Where both have the same shape, their four halves are then exchangeable, and
    the distance is as likely to be above 0 as below.

    Parameters
    ----------
    one, two
        Log histograms of the same size, as of `chdstat.summarize`; the channel in the middle
        counts.
    seed
        Draws samples and halves.

    Returns
    -------
    ndarray
        In decades; NaN where either has too few samples for a shape. Twice that is the energy
        distance of the two distributions of log10 radiance.

    References
    ----------
    Székely and Rizzo, "Energy statistics: a class of statistics based on distances", 2013,
    doi:10.1016/j.jspi.2013.03.018.
    """
    rng = generator(seed)
    middle = slice(one.sizes["channel"] // 2, one.sizes["channel"] // 2 + 1)
    datasets = [d[list(_HISTOGRAM)].isel(channel=middle) for d in (one, two)]
    counts = [d["log_counts"].to_numpy().astype(np.int64) for d in datasets]
    fewer = np.minimum(*(c.sum(axis=-1) for c in counts))
    halves = [
        _halves(d, thinned(c, fewer, rng), rng) for d, c in zip(datasets, counts, strict=True)
    ]
    return squared_distance(*halves, width=WIDTH).ravel()


def squares_of_pairs(one: Samples, two: Samples, *, seed: int = 0) -> Floats:
    """Return squared distances of renders that share random numbers, shape (pixel,).

    As `squares`, but a half is every other sample of both: of halves drawn from each render apart,
    the first of one would be correlated with the second of the other, and distances be too small.
    """
    rng, spp, middle = generator(seed), min(one.spp, two.spp), one.shape[2] // 2
    halves = []
    for first in (0, 1):
        datasets = [_every_other(samples, first, spp, middle) for samples in (one, two)]
        counts = [d["log_counts"].to_numpy().astype(np.int64) for d in datasets]
        fewer = np.minimum(*(c.sum(axis=-1) for c in counts))
        halves.append(
            [
                of_histograms(_with_counts(d, thinned(c, fewer, rng)), rng).whole.cumulative
                for d, c in zip(datasets, counts, strict=True)
            ]
        )
    chds = [
        LogChds(np.stack(pair, axis=-2).astype(np.float64)) for pair in zip(*halves, strict=True)
    ]
    return squared_distance(*chds, width=WIDTH).ravel()


def _every_other(samples: Samples, first: int, spp: int, channel: int) -> xr.Dataset:
    """Return the log histograms of every other sample of a channel."""
    x = samples.read(ss=slice(0, spp))[:, :, channel : channel + 1, first::2]
    half = Samples.from_array(np.ascontiguousarray(x), axes="yxcs")
    return summarize(half, progress=False)[list(_HISTOGRAM)]


def thinned(counts: Ints, n: Ints, rng: np.random.Generator) -> Ints:
    """Draw `n` (...) of what was counted, (..., bin), without replacement.

    Examples
    --------
    >>> counts = np.array([[5, 0, 9, 2], [0, 1, 1, 0]])
    >>> thinned(counts, np.array([7, 2]), np.random.default_rng(0)).sum(axis=-1)
    array([7, 2])
    """
    found, rest, left = np.empty_like(counts), counts.sum(axis=-1), n.copy()
    # Multivariate hypergeometric: bin after bin, from what is left.
    for i in range(counts.shape[-1]):
        here = counts[..., i]
        rest -= here
        found[..., i] = rng.hypergeometric(here, rest, left)
        left -= found[..., i]
    return found


def permuted(squared: Sequence[Floats], *, seed: int = 0) -> float:
    """Return the p-value of no difference between two integrators in any pixel.

    The statistic is the mean over pixels, of all scenes given. Where there is no difference, one
    half of the samples of each pixel may change sides, which turns the sign of its distance; pixels
    are rendered independently. So random signs give the null distribution, exactly.

    Parameters
    ----------
    squared
        `squares` of each scene.
    seed
        Draws the signs.

    Returns
    -------
    float
        One-sided, at least 1/1000; NaN without a distance.

    References
    ----------
    Phipson and Smyth, "Permutation p-values should never be zero", 2010,
    doi:10.2202/1544-6115.1585.

    Examples
    --------
    >>> permuted([np.full(20, 0.1)]), permuted([np.tile([0.1, -0.1], 10)]) > 0.3
    (0.001, True)
    """
    values = np.concatenate([np.zeros(0), *squared])
    values = values[np.isfinite(values)]
    if not len(values):
        return float("nan")
    rng, seen, reached = generator(seed), values.sum(), 0
    for part in spans(_PERMUTATIONS, _AT_ONCE):
        signs = rng.integers(0, 2, (part.stop - part.start, len(values)), dtype=np.int8)
        sums = 2 * (signs @ values) - seen
        # Rounding must not tell equal sums apart.
        reached += int(np.count_nonzero(sums >= seen - 1e-12 * np.abs(values).sum()))
    return (1 + reached) / (1 + _PERMUTATIONS)


def _with_counts(dataset: xr.Dataset, counts: Ints) -> xr.Dataset:
    return dataset.assign(log_counts=(dataset["log_counts"].dims, counts))


def _halves(dataset: xr.Dataset, counts: Ints, rng: np.random.Generator) -> LogChds:
    one, two = of_histograms(_with_counts(dataset, counts), rng).halves
    halves = np.stack([one.cumulative, two.cumulative], axis=-2)
    return LogChds(halves.astype(np.float64))
