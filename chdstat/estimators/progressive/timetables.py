"""Timetable: when a stream learns while its samples arrive, and for how long."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy.typing as npt

from chdstat.errors import InputError
from chdstat.estimators.progressive.streams import Stream

__all__ = ["follow", "timetable"]

_ITERATIONS = 2000
_FEWEST = 4
_FIRST = 16
"""Samples from which learning pays: fewer tell the network little that lasts."""


def follow(
    stream: Stream, batches: Iterable[npt.NDArray[Any]], *, spp: int, iterations: int | None = None
) -> None:
    """Take in batches as they are rendered, and learn whenever the samples have doubled.

    Parameters
    ----------
    stream
        One that learns, without samples.
    batches
        Samples, shape (y, x, channel, sample) each.
    spp
        Samples per pixel in all.
    iterations
        Minibatches in all; None for 2000.

    Raises
    ------
    InputError
        If there are fewer than 4 samples, or less than one minibatch.

    Examples
    --------
    >>> import numpy as np
    >>> from chdstat.estimators import Progressive
    >>> x = np.random.default_rng(0).exponential(size=(4, 16, 16, 1, 16))
    >>> stream = Stream(Progressive(), learns=True)
    >>> follow(stream, x, spp=64, iterations=14)
    >>> stream.iterations
    14
    """
    plan = timetable(spp, iterations)
    there = 0
    for batch in batches:
        stream.update(batch)
        there += batch.shape[-1]
        due = sum(plan.pop(mark) for mark in sorted(plan) if mark <= there)
        if due:
            stream.learn(iterations=due)


def timetable(spp: int, iterations: int | None = None) -> dict[int, int]:
    """Return after how many samples to learn, and with how many minibatches.

    Samples double from one time to the next, and so do the minibatches, as the periods of
    Loshchilov and Hutter 2017 (arXiv:1608.03983) do: more than half of them see all samples.

    Examples
    --------
    >>> timetable(64, 700)
    {16: 100, 32: 200, 64: 400}
    """
    total = _ITERATIONS if iterations is None else iterations
    if spp < _FEWEST:
        message = f"learning while rendering needs at least {_FEWEST} spp, got {spp}"
        raise InputError(message)
    if total < 1:
        message = f"iterations must be at least 1, got {total}"
        raise InputError(message)
    marks = [spp]
    while marks[0] // 2 >= _FIRST:
        marks.insert(0, marks[0] // 2)
    # What is shared out comes to the total exactly, however few there are.
    ends = [round(total * (2**k - 1) / (2 ** len(marks) - 1)) for k in range(len(marks) + 1)]
    shares = {mark: ends[k + 1] - ends[k] for k, mark in enumerate(marks)}
    return {mark: share for mark, share in shares.items() if share}
