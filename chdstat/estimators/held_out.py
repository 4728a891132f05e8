"""Held-out protocol: which samples train a learned estimator, and which judge it.

The samples of an image are cut into batches of n. The reference of a batch is the mean of all other
samples of its pixel, so the noise of the batch is not in the reference. Some pixels are drawn for
training; the others judge.

A batch with a bad sample has no reference (NaN). It is used neither for training nor for judging.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LeftOut, generator, spans
from chdstat.errors import InputError
from chdstat.estimators.registry import whole_samples
from chdstat.samples import Samples
from chdstat.samples.dependence import check_independent

PUBLISHED_PIXELS = 6400
"""Pixels that Elek, Thomas and Forbes 2019 train on."""

_REORDERED = 2**15
"""Samples sorted at once."""
_ROUNDING = 1e-13
"""Share of a sum below which a remainder counts as rounding."""


@dataclass(frozen=True)
class Totals:
    """Sums over the good samples of every pixel.

    Attributes
    ----------
    total
        Sum of the radiance, float64, shape (..., channel).
    count
        Good samples, shape (...).
    """

    total: npt.NDArray[np.float64]
    count: npt.NDArray[np.int64]

    @classmethod
    def of(cls, samples: Samples) -> Totals:
        """Sum over an image in one pass through its blocks."""
        height, width, channels, _ = samples.shape
        total = np.zeros((height, width, channels))
        count = np.zeros((height, width), np.int64)
        left_out = LeftOut()
        for ys, xs, ss, block in samples.blocks():
            left_out.see(block, channel_axis=-2, absent=samples.absent(ys, xs, ss))
            kept, good = whole_samples(block)
            total[ys, xs] += kept.sum(axis=-1, dtype=np.float64)
            count[ys, xs] += good.sum(axis=-1)
        left_out.warn()
        return cls(total, count)

    def __getitem__(self, pixels: Any) -> Totals:
        """Return the sums of some pixels."""
        return Totals(self.total[pixels], self.count[pixels])

    def mean(self) -> npt.NDArray[np.float64]:
        """Return the mean of the good samples, shape (..., channel); NaN where there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            known = np.where(self.count > 0, self.count, np.nan)
            return np.asarray(self.total / known[..., np.newaxis])

    def mean_without(self, batch: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
        """Return the leave-batch-out mean, (total - sum of batch) / (count - n).

        Parameters
        ----------
        batch
            n samples, which must be part of these totals, shape (..., channel, n).

        Returns
        -------
        ndarray
            Shape (..., channel); NaN where the batch holds a bad sample or no sample remains.
        """
        kept, good = whole_samples(batch)
        total = without(self.total, kept.sum(axis=-1, dtype=np.float64))
        reference = Totals(total, self.count - good.sum(axis=-1)).mean()
        return np.where(good.all(axis=-1, keepdims=True), reference, np.nan)


def without(
    total: npt.NDArray[np.float64], part: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return a sum minus a part of it: exactly 0 where only rounding is left.

    Examples
    --------
    >>> without(np.array([0.3]), np.array([0.1 + 0.2])).tolist()
    [0.0]
    """
    rest = total - part
    return np.where(np.abs(rest) <= _ROUNDING * np.abs(total), 0, rest)


def batches(samples: Samples, n: int) -> Iterator[npt.NDArray[np.float32]]:
    """Yield n consecutive samples of all pixels at a time, shape (y, x, channel, n).

    Samples that do not fill a batch in all pixels are dropped.
    """
    for first in range(0, samples.fewest // n * n, n):
        yield samples.read(ss=slice(first, first + n))


def check_spp(samples: Samples, n: int) -> None:
    """Check that there are enough samples for a batch of n and its reference.

    Raises
    ------
    InputError
        If some pixel has fewer than 2 n samples.
    """
    check_independent(samples.attrs)
    if samples.fewest < 2 * n:
        message = (
            f"a batch of {n} samples and an equally large reference need at least {2 * n} spp, "
            f"got {samples.fewest}; render more samples per pixel, or take a smaller batch"
        )
        raise InputError(message)


def draw_pixels(
    shape: tuple[int, int],
    count: int,
    *,
    seed: int | np.random.Generator | None,
    spare: bool = True,
) -> npt.NDArray[np.int64]:
    """Draw pixels for training without replacement: `count`, or all that do not judge.

    For one seed, a smaller draw is part of every larger one, so estimators with different `count`
    share their pixels.

    Parameters
    ----------
    shape
        Height and width of the image.
    count
        Number of pixels.
    seed
        The same seed draws the same pixels.
    spare
        Whether to leave pixels that judge.

    Returns
    -------
    ndarray
        Rows (y, x) in the order of the image.

    Examples
    --------
    >>> [len(draw_pixels(shape, 6400, seed=0)) for shape in [(2, 2), (90, 90), (100, 100)]]
    [2, 4050, 6400]
    """
    order = generator(seed).permutation(shape[0] * shape[1])
    # The published number trains if it leaves a quarter to judge, else half of the image.
    half, published = order.size // 2, PUBLISHED_PIXELS
    most = published if half < published <= 3 * order.size // 4 else half
    drawn = np.sort(order[: min(count, most) if spare else count])
    return np.stack(np.unravel_index(drawn, shape), axis=-1).astype(np.int64)


def judging_pixels(
    shape: tuple[int, int], *, seed: int | np.random.Generator | None
) -> npt.NDArray[np.bool_]:
    """Return which pixels judge, shape (y, x): those that `draw_pixels` never draws for this seed.

    They are half of the image. In images in which 6400 training pixels (Elek et al. 2019) are more
    than half but leave at least a quarter, they are all others.
    """
    judging = np.ones(shape, bool)
    judging[tuple(draw_pixels(shape, judging.size, seed=seed).T)] = False
    return judging


def checked_pixels(pixels: npt.ArrayLike, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return given pixels of an image, rows (y, x), each once.

    Raises
    ------
    InputError
        If they are not rows of two integers, or one lies outside the image.
    """
    chosen = np.asarray(pixels)
    if chosen.ndim != 2 or chosen.shape[1] != 2 or chosen.dtype.kind not in "iu":
        message = f"pixels must be integer rows (y, x), got {chosen.dtype} of shape {chosen.shape}"
        raise InputError(message)
    if ((chosen < 0) | (chosen >= shape)).any():
        message = f"pixels must lie in the image of {shape[1]} x {shape[0]} pixels (y, x)"
        raise InputError(message)
    return np.unique(chosen, axis=0).astype(np.int64)


def training_batches(
    samples: Samples, pixels: npt.NDArray[np.int64], n: int, *, leave_out: bool = True
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Cut the samples of some pixels into batches with their references.

    Parameters
    ----------
    samples
        The image.
    pixels
        Rows (y, x).
    n
        Samples per batch.
    leave_out
        Whether references leave the batch out; else they are means of all samples of a pixel.

    Returns
    -------
    batches : ndarray
        Shape (batch, channel, n); batches with a bad sample are left out.
    references : ndarray
        Shape (batch, channel).
    """
    where = pixels[:, 0], pixels[:, 1]
    totals = Totals.of(samples)[where]
    found, references = [], []
    for image in batches(samples, n):
        batch = image[where]
        reference = totals.mean_without(batch)
        usable = np.isfinite(reference).all(axis=-1)
        found.append(batch[usable])
        references.append((reference if leave_out else totals.mean())[usable])
    return np.concatenate(found), np.concatenate(references)


def reordered(x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    """Return samples (..., channel, sample) in a random order that does not depend on theirs.

    A function that splits samples by their position then gets the same parts for any order and
    unit. The samples are sorted, then shuffled in each pixel; without the shuffle, some parts would
    hold the bright samples and others the dark ones.

    Examples
    --------
    >>> one, two = (reordered(np.array([[3.0, 1.0, 2.0][::step]])) for step in (1, -1))
    >>> bool((one == two).all())
    True
    """
    rows, rng = x.reshape(-1, *x.shape[-2:]), generator(0)
    ordered = np.empty_like(rows)
    for part in spans(len(rows), max(1, _REORDERED // x.shape[-1])):
        rank = np.lexsort(np.moveaxis(rows[part], 1, 0), axis=-1)
        places = np.take_along_axis(rank, rng.random(rank.shape).argsort(axis=-1), axis=-1)
        ordered[part] = np.take_along_axis(rows[part], places[:, np.newaxis], axis=-1)
    return ordered.reshape(x.shape)
