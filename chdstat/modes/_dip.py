"""Hartigan's dip: how far samples are from any unimodal distribution, and how likely that is.

The statistic is diptest's; p-values are interpolated in a table of its null distribution, for any
number of samples from 20, and for all rows at once.
"""

from __future__ import annotations

import diptest
import numpy as np

from chdstat._arrays import spans
from chdstat._null_quantiles import interpolated_p
from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat.modes._dip_table import LEVELS, QUANTILES
from chdstat.modes._ties import moved_apart

__all__ = ["dip_p", "dips_of_part"]

_FLOOR = 1e-5
"""Smallest p-value told: the table ends at 1e-4, where up to a million dips were simulated."""
_CHUNK = 2**16


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
            moved_apart(ascending[at[move]], n[at[move]], np.zeros(move.sum(), bool))
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
    return interpolated_p(np.sqrt(n) * dip, n, LEVELS, QUANTILES, _FLOOR)
