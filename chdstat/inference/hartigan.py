"""Ties: equal samples, where tests and densities are of continuous ones.

Samples that tie are moved apart, evenly and in the same way whatever is beside them. A few values
that many samples share are lights seen from everywhere, and move by less than float32 can tell.
Samples that lie on many steps have been rounded, to integers or to the few bits of a file: a step
is no mode, and its samples are spread over what was rounded to it.

Hartigan's dip: how far samples are from any unimodal distribution, and how likely that is.

The statistic is diptest's; p-values are interpolated in a table of its null distribution, for any
number of samples from 20, and for all rows at once.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import diptest
import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import spans
from chdstat._core.positive import Counts, Floats, Mask, PositivePart
from chdstat.fit.peaks import LEAST_WEIGHT
from chdstat.inference.null_tables import DIP_QUANTILES, LEVELS, interpolated_p

__all__ = ["dip_p", "dips_of_part", "on_steps", "spread", "tied_shares", "without_ties"]

_LIGHTS = 3
"""Values, at most, that samples share for another reason than rounding."""
_CHUNK = 2**16


def tied_shares(part: PositivePart) -> Floats:
    """Return the share of positive samples equal to another one, shape (...); NaN without any."""
    samples = part.x.shape[-1]
    ascending, n = part.sorted.reshape(-1, samples), part.n.reshape(-1)
    tied = np.empty(len(n))
    for piece in spans(len(n), max(1, _CHUNK // samples)):
        tied[piece] = np.count_nonzero(_tied(ascending[piece], n[piece]), axis=-1)
    with np.errstate(invalid="ignore"):
        return np.asarray((tied / n).reshape(part.n.shape))


def on_steps(part: PositivePart, tied_share: Floats) -> Mask:
    """Say which rows hold rounded samples, shape (...).

    They are those of which 8 % or more, the smallest mode that is counted, tie at other values than
    the three most frequent ones.
    """
    samples = part.x.shape[-1]
    steps = np.zeros(part.n.size, dtype=bool)
    rows = np.flatnonzero(tied_share.reshape(-1) > LEAST_WEIGHT)
    for piece in spans(len(rows), max(1, _CHUNK // samples)):
        at = rows[piece]
        ascending, n = part.sorted.reshape(-1, samples)[at], part.n.reshape(-1)[at]
        run = _runs(ascending) + samples * np.arange(len(at))[:, np.newaxis]
        counts = np.bincount(run[_tied(ascending, n)], minlength=run.size).reshape(-1, samples)
        rest = np.sort(counts, axis=-1)[:, :-_LIGHTS].sum(axis=-1)
        steps[at] = rest >= LEAST_WEIGHT * n
    return steps.reshape(part.n.shape)


def spread(part: PositivePart, steps: Mask) -> PositivePart:
    """Return the part with the samples of the rows on `steps` spread over them."""
    x, positive = part.x.astype(np.float64), part.positive.copy()
    moved = without_ties(part.sorted[steps], part.n[steps], np.ones(np.count_nonzero(steps), bool))
    x[steps], positive[steps] = np.where(part.valid[steps], moved, 0), part.valid[steps]
    return replace(part, x=x, positive=positive)


def without_ties(ascending: npt.NDArray[Any], n: Counts, steps: Mask) -> Floats:
    """Return samples, ascending and padded with infinity, without ties.

    Those of a tie are spread evenly, over half a float32 spacing to either side, or, in the rows on
    `steps`, half-way to the next values.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    exact = np.where(valid, ascending, np.inf).astype(np.float64)
    run = _runs(exact)
    column = np.arange(exact.shape[-1])
    begins = np.diff(run, axis=-1, prepend=-1) > 0
    ends = np.diff(run, axis=-1, append=exact.shape[-1]) > 0
    first = np.maximum.accumulate(np.where(begins, column, 0), axis=-1)
    last = np.minimum.accumulate(np.where(ends, column, column[-1])[:, ::-1], axis=-1)[:, ::-1]
    last = np.minimum(last, n[:, np.newaxis] - 1)
    spacing = np.spacing(np.where(valid, ascending, 1).astype(np.float32)).astype(np.float64)
    below = np.take_along_axis(exact, np.maximum(first - 1, 0), axis=-1)
    above = np.take_along_axis(exact, np.minimum(last + 1, n[:, np.newaxis] - 1), axis=-1)
    with np.errstate(invalid="ignore"):
        down, up = exact - below, above - exact
    # The outer steps are as wide on both sides, within positive numbers.
    down, up = np.where(down > 0, down, np.minimum(up, exact)), np.where(up > 0, up, down)
    wide = steps[:, np.newaxis]
    down, up = np.where(wide, down, spacing) / 2, np.where(wide, up, spacing) / 2
    count = np.maximum(last - first + 1, 1)
    with np.errstate(invalid="ignore"):
        moved = exact - down + (column - first + 0.5) / count * (down + up)
    return np.where(valid & (count > 1), moved, exact)


def _runs(ascending: npt.NDArray[Any]) -> Counts:
    """Return the number of the value of each sample in its row: 0 for all of the smallest."""
    run = np.zeros(ascending.shape, dtype=np.int64)
    np.cumsum(ascending[:, 1:] != ascending[:, :-1], axis=-1, out=run[:, 1:])
    return run


def _tied(ascending: npt.NDArray[Any], n: Counts) -> Mask:
    tied = np.zeros(ascending.shape, dtype=bool)
    tied[:, 1:] = ascending[:, 1:] == ascending[:, :-1]
    tied[:, :-1] |= tied[:, 1:]
    tied &= np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    return tied


_FLOOR = 1e-5
"""Smallest p-value told: the table ends at 1e-4, where up to a million dips were simulated."""


def dips_of_part(part: PositivePart, usable: Mask, tied: Mask) -> tuple[Floats, Floats]:
    """Return dips of log radiance and p-values; NaN where not usable.

    Samples of `tied` rows are moved apart: the test is one of continuous samples.
    """
    dip, p = np.full((2, part.n.size), np.nan)
    samples, n, tied = part.x.shape[-1], part.n.reshape(-1), tied.reshape(-1)
    ascending = part.sorted.reshape(-1, samples)
    log_sorted = part.log_sorted.reshape(-1, samples)
    rows = np.flatnonzero(usable)
    for piece in spans(len(rows), max(1, _CHUNK // samples)):
        at = rows[piece]
        log, move = log_sorted[at], tied[at]
        log[move] = np.log(
            without_ties(ascending[at[move]], n[at[move]], np.zeros(move.sum(), bool))
        )
        # The package has no batch form: the dip of a row is a sequential algorithm.
        dip[at] = [
            diptest.dipstat(row[:count], sort_x=False)
            for row, count in zip(log, n[at], strict=True)
        ]
    p[rows] = dip_p(dip[rows], n[rows])
    return dip.reshape(part.n.shape), p.reshape(part.n.shape)


def dip_p(dip: Floats, n: Counts) -> Floats:
    """Return p-values of dips of `n` samples, shape (row,), where uniform samples are the null.

    Of all unimodal distributions, the uniform one has the largest dips, asymptotically (Hartigan
    and Hartigan 1985, doi:10.1214/aos/1176346577). Values below 1e-5 are told as 1e-5.

    Examples
    --------
    >>> dip_p(np.array([0.02, 0.05]), np.array([200, 200])).round(2)
    array([0.89, 0.  ])
    """
    return interpolated_p(np.sqrt(n) * dip, n, LEVELS, DIP_QUANTILES, _FLOOR)
