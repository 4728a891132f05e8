"""Results: what a progressive estimator says of pixels, and what training leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.spread import Spread

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = ["Estimates", "Learned"]


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
        Probability of the interval.
    """

    radiance: npt.NDArray[np.float32]
    certainty: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    level: float


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
        How far to go from the mean to what the network estimates, 0 to 1.
    """

    network: Network
    spread: Spread
    unit: float
    history: npt.NDArray[np.float64]
    train_pixels: npt.NDArray[np.int64]
    train_shape: tuple[int, int]
    provenance: Mapping[str, Any]
    trust: float = 1.0
