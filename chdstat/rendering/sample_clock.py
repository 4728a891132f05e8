"""Sample clock: how long each sample of a scalar pass takes.

Mitsuba asks the sensor for a ray before each sample, so a sensor that reads a clock and passes the
question on tells when each sample began. The samples stay the same to the bit. Such a sensor is
written in Python and takes as long as a quick sample, so that only one pass of 16 is timed, and the
others tell what the clock costs: it is subtracted. The clock is the processor time of the calling
thread, of which programs that run beside take none. They still share caches: on a busy machine,
samples seem slower.
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
            self.inner, self.begun, self.places = inner, list[float](), list[Any]()

        def sample_ray_differential(self, *arguments: Any) -> Any:
            self.begun.append(now())
            if self.places is not None:
                self.places.append(arguments[2])
            return self.inner.sample_ray_differential(*arguments)

    return WatchingSensor


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
        self._watched = _watching(mi.Sensor)(mi, sensor)
        if medium is not None:
            self._watched.set_medium(medium)
        self._order: Any = None
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
            self._watched.begun.clear()
            yield self._watched
            self._timed.append(np.diff([*self._watched.begun, now()]))
            if self._order is None:
                height, width = self._shape
                columns, rows = np.array(self._watched.places).T * [[width], [height]]
                self._order = rows.astype(np.intp), columns.astype(np.intp)
                self._watched.places = None

    @property
    def costs(self) -> SampleCosts | None:
        """What the samples of the pixels take; None if no pass was timed, or all were."""
        if not self._timed or not self._plain:
            return None
        times = np.array(self._timed)
        of_clock = (np.median(times.sum(axis=1)) - np.median(self._plain)) / times.shape[1]
        # The last sample of a block includes what finishes the block: its neighbours stand for it.
        for last in np.flatnonzero(self._ends_block()):
            times[:, last] = times[:, max(last - 3, 0) : max(last, 1)].mean(axis=1)
        by_pixel = np.empty((*self._shape, len(times)))
        by_pixel[self._order] = uninterrupted(times).T - of_clock
        return SampleCosts.of(by_pixel)

    def _ends_block(self) -> Any:
        from chdstat.rendering.rays import BLOCK

        rows, columns = self._order
        block = rows // BLOCK * self._shape[1] + columns // BLOCK
        return np.append(block[1:] != block[:-1], True)
