"""Costs: how long the samples of each pixel took to render.

Only some samples are timed. What is kept of them are counts, means and sums of squares, so that the
times of several runs add up. They say something of the render and the machine, and nothing of the
samples: no identity or digest depends on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image, Reals
from chdstat._core.display import Card, Shown, duration
from chdstat.errors import InputError

if TYPE_CHECKING:
    from chdstat.samples.tiles import Chunk

COSTS = "costs"
"""Feature of a store with what samples of each pixel took, as `SampleCosts.to_array` returns it."""
_LEAST = 1 / 20
"""Least time that is told of a pixel, over the mean of the image: clocks err by as much."""


@dataclass(frozen=True, repr=False)
class SampleCosts(Shown):
    """Time that a sample of each pixel takes, as far as it was measured.

    Attributes
    ----------
    count
        Samples of each pixel that were timed, shape (y, x).
    mean, squares
        Their mean time in seconds, and the sum of squared deviations from it.

    Examples
    --------
    >>> costs = SampleCosts.of(np.array([[[1.0, 3.0], [4.0, 4.0]]]))
    >>> costs.seconds.tolist(), costs.error.tolist(), round(costs.over_median(0, 1), 2)
    ([[2.0, 4.0]], [[1.0, 0.0]], 1.33)
    >>> costs
    Costs of samples
      pixels         2 × 1
      timed samples  4
      median         3 s
    """

    count: Floats
    mean: Floats
    squares: Floats

    def _card(self) -> Card:
        height, width = self.count.shape
        facts = {"pixels": f"{width} × {height}", "timed samples": int(self.count.sum())}
        return Card("Costs of samples", {**facts, "median": duration(self.median)})

    @classmethod
    def of(cls, times: Reals) -> Self:
        """Return the costs from times of samples in seconds, (y, x, sample); NaN is untimed."""
        known = np.isfinite(times)
        count = known.sum(axis=-1).astype(np.float64)
        mean = np.where(known, times, 0).sum(axis=-1, dtype=np.float64) / np.maximum(count, 1)
        away = np.where(known, times - mean[..., np.newaxis], 0)
        return cls(count, mean, (away**2).sum(axis=-1))

    @classmethod
    def of_array(cls, stacked: Reals) -> Self:
        """Return the costs that `to_array` returned as an array."""
        return cls(*np.moveaxis(np.asarray(stacked, np.float64), -1, 0))

    def to_array(self) -> Image:
        """Return count, mean and sum of squares, shape (y, x, 3), float32."""
        return np.stack([self.count, self.mean, self.squares], axis=-1, dtype=np.float32)

    def merge(self, other: SampleCosts) -> SampleCosts:
        """Return the costs by all timed samples of both."""
        count = self.count + other.count
        share = other.count / np.maximum(count, 1)
        away = other.mean - self.mean
        squares = self.squares + other.squares + self.count * share * away**2
        return SampleCosts(count, self.mean + share * away, squares)

    @property
    def seconds(self) -> Floats:
        """Mean time of a sample of each pixel, shape (y, x); NaN where it is unknown."""
        total, taken = self.count.sum(), (self.count * self.mean).sum()
        if not taken > 0:  # a clock that reads 0 everywhere tells nothing
            return np.full(self.mean.shape, np.nan)
        least = _LEAST * taken / total
        return np.where(self.count > 0, np.maximum(self.mean, least), np.nan)

    @property
    def error(self) -> Floats:
        """Standard error of `seconds`, shape (y, x); NaN below two timed samples."""
        n = np.where(self.count > 1, self.count, np.nan)
        return np.asarray(np.sqrt(self.squares / (n * (n - 1))))

    @property
    def median(self) -> float:
        """Median of `seconds` over the pixels; NaN if nothing was timed."""
        seconds = self.seconds
        known = seconds[np.isfinite(seconds)]
        return float(np.median(known)) if known.size else np.nan

    def variables(self) -> dict[str, tuple[tuple[str, ...], Floats, dict[str, str]]]:
        """Return the maps of a dataset: ``sample_seconds`` and ``sample_seconds_error``."""
        named = {
            "sample_seconds": (self.seconds, "time to render a sample"),
            "sample_seconds_error": (self.error, "standard error of the time to render a sample"),
        }
        return {
            name: (("y", "x"), values, {"long_name": label, "units": "s"})
            for name, (values, label) in named.items()
        }

    def over_median(self, y: int, x: int) -> float:
        """Return the cost of a pixel over that of the median pixel."""
        return float(self.seconds[y, x] / self.median)


def with_times(
    held: SampleCosts | None, shape: tuple[int, ...], chunk: Chunk, costs: SampleCosts
) -> SampleCosts:
    """Return the costs of an image, with those of a chunk of it added."""
    added = np.zeros((*shape[:2], 3))
    added[chunk.ys, chunk.xs] = costs.to_array()
    found = SampleCosts.of_array(added)
    return found if held is None else held.merge(found)


def check_seconds(seconds: npt.ArrayLike, shape: tuple[int, ...]) -> SampleCosts:
    """Return the costs that a caller gives: of each pixel (y, x), or each sample (y, x, sample).

    Raises
    ------
    InputError
        If they are of another image, or below 0.
    """
    found = np.asarray(seconds)
    if found.dtype.kind not in "iuf" or found.shape not in (shape[:2], (*shape[:2], shape[3])):
        message = (
            f"seconds must be the time of a sample of each pixel, of shape {shape[:2]}, or of each "
            f"sample, {(*shape[:2], shape[3])}; got {found.dtype} of shape {found.shape}"
        )
        raise InputError(message)
    if (found < 0).any():
        message = f"seconds must not be below 0, got {found.min():g}"
        raise InputError(message)
    return SampleCosts.of(found.reshape(*shape[:2], -1).astype(np.float64))
