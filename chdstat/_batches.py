"""Batch means: how the mean wanders over consecutive samples, in constant memory.

Batches double in size whenever there would be too many of them.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError

__all__ = ["Batches"]


class Batches:
    """Sums of samples over consecutive batches of `size` draws, at most `limit` of them.

    The slot behind the last complete batch is open: it takes the next samples. When the draws
    outgrow the slots, neighbours merge pairwise and `size` doubles.
    """

    def __init__(self, shape: tuple[int, ...], *, size: int, limit: int) -> None:
        if size < 1 or limit < 2 or limit % 2:
            message = (
                "batch means need batch_size >= 1 and an even max_batches >= 2, "
                f"got batch_size={size} and max_batches={limit}"
            )
            raise InputError(message)
        self._options = (size, limit)
        self.size = size
        self.draws: npt.NDArray[np.int64] = np.zeros(limit, dtype=np.int64)
        """Draws per slot, good or not: `size` in a complete one, or more after a merge."""
        self._sums = np.zeros((*shape, limit))
        self._counts = np.zeros((*shape, limit), dtype=np.int64)

    def update(
        self, x: npt.NDArray[np.floating[Any]], good: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Take the next samples, shape (..., sample); `good` marks those that count."""
        n = x.shape[-1]
        self._make_room(n)
        complete = self._complete
        first = self.size - self.draws[complete]
        starts = np.concatenate([[0], np.arange(first, n, self.size)]).astype(np.intp)
        lengths = np.diff(starts, append=n)
        slots = slice(complete, complete + len(starts))
        if good is not None:
            x = np.where(good, x, 0)
            good = np.broadcast_to(good, x.shape)
            lengths_good = np.add.reduceat(good, starts, axis=-1, dtype=np.int64)
        self.draws[slots] += lengths
        self._counts[..., slots] += lengths if good is None else lengths_good
        self._sums[..., slots] += np.add.reduceat(x, starts, axis=-1, dtype=np.float64)

    def check(self, other: Batches) -> None:
        """Raise InputError unless `other` began with the same size and limit."""
        if self._options != other._options:
            message = (
                "summaries merge only with the same batch_size and max_batches, "
                f"got {self._options} and {other._options}"
            )
            raise InputError(message)

    def merge(self, other: Batches) -> None:
        """Append the batches of `other`; the two open batches become one."""
        self.check(other)
        other = copy.deepcopy(other)
        while self.size != other.size:
            (self if self.size < other.size else other)._double()
        while self.total + other.total > self.size * len(self.draws):
            self._double()
            other._double()
        self._append(other)

    def read(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return the batch means, shape (..., batch), and the draws of each batch, shape (batch,).

        An incomplete batch is left out, unless it is the only one.
        """
        used = slice(max(self._complete, 1))
        sums, counts = self._sums[..., used], self._counts[..., used]
        means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        return means, self.draws[used].copy()

    def empty(self, shape: tuple[int, ...]) -> Batches:
        """Return batches with the same options that have seen nothing, for another shape."""
        size, limit = self._options
        return Batches(shape, size=size, limit=limit)

    @property
    def total(self) -> int:
        """Draws so far, good or not."""
        return int(self.draws.sum())

    @property
    def _complete(self) -> int:
        return int(np.count_nonzero(self.draws >= self.size))

    def _make_room(self, n: int) -> None:
        while self.total + n > self.size * len(self.draws):
            self._double()

    def _double(self) -> None:
        self.size *= 2
        for array in self._arrays:
            half = array.shape[-1] // 2
            array[..., :half] = array[..., ::2] + array[..., 1::2]
            array[..., half:] = 0

    def _append(self, other: Batches) -> None:
        # All fit: a complete batch holds at least `size` draws, and the draws fit the slots.
        mine, theirs = self._complete, other._complete
        both = mine + theirs
        for ours, others in zip(self._arrays, other._arrays, strict=True):
            tail = ours[..., mine:].sum(axis=-1) + others[..., theirs:].sum(axis=-1)
            ours[..., mine:both] = others[..., :theirs]
            ours[..., both:] = 0
            if both < ours.shape[-1]:
                ours[..., both] = tail

    @property
    def _arrays(self) -> tuple[npt.NDArray[Any], ...]:
        return self.draws, self._counts, self._sums
