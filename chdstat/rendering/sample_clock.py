"""Sample clock: how long each sample of a scalar pass takes.

Mitsuba asks the sensor for a ray before each sample, so a sensor that reads a clock and passes the
question on tells when each sample began. The samples stay the same to the bit. Such a sensor is
written in Python and takes as long as a quick sample, so that only one pass of 16 is timed. The
others tell what a sample takes on average: what timed ones take more is the clock's, and
subtracted. The clock is the processor time of the thread, of which programs that run beside take
none. They still share caches: on a busy machine, samples seem slower.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from chdstat._core.arrays import Floats
from chdstat.samples.costs import SampleCosts

_EVERY = 16
"""One pass of so many is timed; never the first, for which caches are cold."""
_LONGEST = 4
"""A sample that took this many times as long as 99 % of them did was interrupted."""
_COLD = 2
"""Samples at the beginning of a block that find cold caches: the first takes 4 times as long."""
_FINE = 1e-6
"""Resolution that a clock needs, in seconds."""
_ONE_AT_A_TIME = threading.Lock()
"""Threads that are timed would wait for each other's turn in Python."""
now = (
    time.thread_time
    if time.get_clock_info("thread_time").resolution <= _FINE
    else time.perf_counter
)
"""The clock, in seconds."""


def uninterrupted(times: Floats) -> Floats:
    """Return times of samples, NaN where the system interrupted them.

    Examples
    --------
    >>> uninterrupted(np.array([1.0] * 999 + [50.0]))[-3:]
    array([ 1.,  1., nan])
    """
    longest = _LONGEST * np.nanquantile(times, 0.99) if np.isfinite(times).any() else np.nan
    return np.where(times > longest, np.nan, times)


def _without_ends(spent: Floats) -> Floats:
    """Return times of the samples of a block, with those of neighbours at both its ends.

    The first samples find cold caches, and the last one goes on into what ends the block.

    Examples
    --------
    >>> _without_ends(np.array([9.0, 3.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, np.nan]))
    array([1., 1., 1., 1., 1., 2., 2., 2., 2.])
    """
    inner = spent[_COLD:-1] if len(spent) > _COLD + 1 else spent[:-1]
    if not inner.size:
        return np.full_like(spent, np.nan)
    return np.concatenate(
        [np.full(len(spent) - 1 - len(inner), inner[:3].mean()), inner, [inner[-3:].mean()]]
    )


@functools.cache
def _watching(base: type) -> type:
    """Return a sensor that notes when each sample begins; the base is that of the variant."""

    class WatchingSensor(base):  # type: ignore[misc]
        def __init__(self, mi: Any, inner: Any) -> None:
            described = mi.Properties("watching")
            described["film"], described["sampler"] = inner.film(), inner.sampler()
            described["shutter_open"] = inner.shutter_open()
            described["shutter_close"] = inner.shutter_open() + inner.shutter_open_time()
            super().__init__(described)
            self.m_needs_sample_3 = inner.needs_aperture_sample()
            self.inner, self.notes = inner, dict[int, tuple[list[float], list[Any]]]()

        def sample_ray_differential(self, *arguments: Any) -> Any:
            thread = threading.get_ident()
            if (notes := self.notes.get(thread)) is None:
                notes = self.notes[thread] = [], []
            begun, places = notes
            places.append(arguments[2])
            begun.append(now())
            return self.inner.sample_ray_differential(*arguments)

    return WatchingSensor


@functools.cache
def _order(height: int, width: int) -> tuple[Any, Any]:
    """Return rows and columns of a block of pixels in the order of its samples, Morton's."""
    from chdstat.rendering.rays import BLOCK

    number, places = np.arange(BLOCK**2), np.zeros((2, BLOCK**2), np.intp)
    for bit in range(BLOCK.bit_length()):
        for i in (0, 1):
            places[1 - i] |= (number >> (2 * bit + i) & 1) << bit
    rows, columns = places[:, (places[0] < height) & (places[1] < width)]
    return rows, columns


class SampleClock:
    """Times passes over a tile.

    Parameters
    ----------
    sensor
        The sensor of the tile.
    medium
        The medium that it is in, or None.
    shape
        (height, width) of the tile.
    """

    def __init__(self, mi: Any, sensor: Any, medium: Any, shape: tuple[int, int]) -> None:
        self._sensor, self._shape = sensor, shape
        self.watched = _watching(mi.Sensor)(mi, sensor)
        if medium is not None:
            self.watched.set_medium(medium)
        self._plain, self._timed = list[float](), list[Floats]()

    @contextlib.contextmanager
    def of_pass(self, sample: int) -> Iterator[Any]:
        """Yield the sensor that draws a sample of each pixel."""
        if sample % _EVERY != 1:
            begun = now()
            yield self._sensor
            self._plain.append(now() - begun)
            return
        with _ONE_AT_A_TIME:
            self.watched.notes.clear()
            yield self.watched
            self._timed.append(self._by_pixel())

    @property
    def costs(self) -> SampleCosts | None:
        """What the samples of the pixels take; None if no pass was timed, or all were."""
        if not self._timed or not self._plain:
            return None
        times = uninterrupted(np.stack(self._timed, axis=-1))
        known = times[np.isfinite(times)]
        if not known.size:
            return None
        of_clock = known.mean() - np.mean(self._plain) / self._shape[0] / self._shape[1]
        return SampleCosts.of(times - of_clock)

    def _by_pixel(self) -> Floats:
        """Return seconds from the beginning of each sample to that of the next, shape (y, x).

        Threads that wait for their own pass help with that of others, block by block, and each has
        its own processor time.
        """
        from chdstat.rendering.rays import BLOCK

        found = np.full(self._shape, np.nan)
        for begun, places in self.watched.notes.values():
            at = 0
            while at < len(begun):
                across, down = places[at]
                y = int(down * self._shape[0]) // BLOCK * BLOCK
                x = int(across * self._shape[1]) // BLOCK * BLOCK
                extent = min(BLOCK, self._shape[0] - y), min(BLOCK, self._shape[1] - x)
                rows, columns = _order(*extent)
                spent = np.diff(begun[at : at + len(rows)], append=np.nan)
                at += len(rows)
                found[y + rows, x + columns] = _without_ends(spent)
        return found
