"""Results: what a progressive estimator says of pixels, and what training leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.marks import Marks
from chdstat.estimators.progressive.shapes import AIMS, GROUPS, MOST_TRUST
from chdstat.estimators.progressive.spread import Spread

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = ["Estimates", "Learned", "Trust"]


@dataclass(frozen=True)
class Estimates:
    """What a progressive estimator says of pixels.

    Attributes
    ----------
    radiance
        Shape (..., channel), in the unit of the samples; NaN where no sample is good.
    certainty
        How far the estimate rests on what was learned, 0 to 1, shape (...): where it is 0, nothing
        was known of such a pixel, and the estimate is the mean of its samples.
    low, high
        Ends of the interval that contains the radiance with probability `level`, shape (...,
        channel).
    level
        Probability of the interval, on pixels like those that trained the network; of another
        scene it is not calibrated.
    """

    radiance: npt.NDArray[np.float32]
    certainty: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    level: float


@dataclass(frozen=True)
class Trust:
    """How far to go from the mean to what a network estimates.

    Attributes
    ----------
    sizes
        Numbers of samples that shares are known for, ascending; between them they are
        interpolated along the logarithm, beyond them they go on.
    shares
        0 for the mean, 1 for the estimate; shape (size, aim, group), groups of pixels as of
        `trust.grouped`. Beyond 1 where others are held back.
    """

    sizes: npt.NDArray[np.float64]
    shares: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.shares.shape != (len(self.sizes), len(AIMS), GROUPS) or not len(self.sizes):
            message = (
                f"shares must have shape (size, {len(AIMS)}, {GROUPS}), size {len(self.sizes)}, "
                f"got {self.shares.shape}"
            )
            raise ValueError(message)
        if not ((self.shares >= 0) & (self.shares <= MOST_TRUST)).all():
            message = f"trust must lie between 0 and {MOST_TRUST}"
            raise ValueError(message)

    @classmethod
    def even(cls, share: float) -> Self:
        """Return the same share for all pixels."""
        return cls(np.ones(1), np.full((1, len(AIMS), GROUPS), share))

    def fixed(self, count: int) -> Self:
        """Return the shares for a number of samples, whatever the number."""
        return replace(self, sizes=np.ones(1), shares=self.at(np.array([count])))

    def at(self, count: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return the shares for numbers of samples, shape (row, aim, group)."""
        last = len(self.sizes) - 1
        place = np.interp(np.log2(np.maximum(count, 1)), np.log2(self.sizes), np.arange(last + 1))
        below = np.floor(place).astype(np.int64)
        part = (place - below)[:, np.newaxis, np.newaxis]
        above = np.minimum(below + 1, last)
        return np.asarray((1 - part) * self.shares[below] + part * self.shares[above])


@dataclass(frozen=True)
class Learned:
    """All that training leaves behind.

    Attributes
    ----------
    network, spread
        What estimates, and what says how large its errors are.
    unit
        Mean radiance of the picture that it was trained on.
    history
        Rows of `History`, losses in units of that of the sample mean.
    train_pixels, train_shape
        Pixels used, rows (y, x), and height and width of the picture that they lie in.
    provenance
        Where it comes from, ready for JSON.
    trust
        How far to go from the mean to what the network estimates.
    marks
        Samples that trained it.
    """

    network: Network
    spread: Spread
    unit: float
    history: npt.NDArray[np.float64]
    train_pixels: npt.NDArray[np.int64]
    train_shape: tuple[int, int]
    provenance: Mapping[str, Any]
    trust: Trust
    marks: Marks
