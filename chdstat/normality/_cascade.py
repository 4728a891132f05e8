"""Cascade: averages of N samples for many N, each from the averages of a divisor of N.

`cascade` walks rows of samples up the sizes, `shapes` measures what comes out. Samples are relative
to the largest of their row, so that no power of them overflows or vanishes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._positive import Counts, Floats, Mask

__all__ = ["Averages", "cascade", "shapes"]


@dataclass(frozen=True)
class Averages:
    """Averages of complete batches of `size` samples, shape (row, batch), bad samples left out.

    ``formed`` marks batches with a good sample, None where all are; others average to 0.
    """

    size: int
    values: Floats
    formed: Mask | None


def cascade(x: npt.NDArray[Any], bad: Mask, sizes: Counts) -> Iterator[Averages]:
    """Yield the averages of samples, shape (row, sample), for ascending sizes."""
    spoilt = bool(bad.any())
    samples = x.astype(np.float64)
    if spoilt:
        np.copyto(samples, 0, where=bad)
    largest = samples.max(axis=-1, keepdims=True, initial=0)
    samples /= np.where(largest > 0, largest, 1)
    sums = {1: samples}
    counts = {1: np.subtract(1.0, bad)} if spoilt else {}
    for size in map(int, sizes):
        divisor = max(known for known in sums if size % known == 0)
        sums[size] = _grouped(sums[divisor], size // divisor)
        if not spoilt:
            yield Averages(size, sums[size] / size, None)
            continue
        counts[size] = _grouped(counts[divisor], size // divisor)
        formed = counts[size] > 0
        yield Averages(size, sums[size] / np.maximum(counts[size], 1), formed)


def _grouped(values: Floats, count: int) -> Floats:
    """Add up every `count` neighbours; what is left over is dropped."""
    if count == 1:
        return values
    groups = values.shape[-1] // count
    if count == 2:
        return np.asarray(values[:, : 2 * groups : 2] + values[:, 1 : 2 * groups : 2])
    batches = values[:, : count * groups].reshape(len(values), groups, count)
    # A product with ones adds short batches up faster than a sum over a short axis does.
    return np.asarray(batches @ np.ones(count))


def shapes(averages: Averages) -> tuple[Floats, Floats]:
    """Return skewness and excess kurtosis, divisor n, not finite for equal averages."""
    formed, values = averages.formed, averages.values
    n = values.shape[-1] if formed is None else np.count_nonzero(formed, axis=-1)
    deviation = values - (values.sum(axis=-1) / n)[:, np.newaxis]
    if formed is not None:
        deviation *= formed
    square = deviation * deviation
    variance = np.vecdot(deviation, deviation) / n
    skewness = np.vecdot(deviation, square) / n / variance**1.5
    return skewness, np.vecdot(square, square) / n / variance**2 - 3
