"""Hartigan's dip: how far samples are from any unimodal distribution, and how likely that is.

The statistic is diptest's; p-values are interpolated in a table of its null distribution, for any
number of samples from 20, and for all rows at once.
"""

from __future__ import annotations

from typing import Any

import diptest
import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, spans
from chdstat._null_quantiles import interpolated_p
from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat.modes._dip_table import LEVELS, QUANTILES

__all__ = ["dip_p", "dips_of_part"]

_FLOOR = 1e-5
"""Smallest p-value told: the table ends at 1e-4, where up to a million dips were simulated."""
_CHUNK = 2**16


def dips_of_part(
    part: PositivePart, usable: Mask, seed: int | np.random.Generator | None
) -> tuple[Floats, Floats, Floats]:
    """Return dips of log radiance, p-values and shares of tied samples; NaN where not usable.

    Samples that tie are moved apart by up to half a float32 spacing, at random: the test is one of
    continuous samples.
    """
    rng = generator(seed)
    dip, p, tied_share = np.full((3, part.n.size), np.nan)
    samples, n = part.x.shape[-1], part.n.reshape(-1)
    ascending = part.sorted.reshape(-1, samples)
    log_sorted = part.log_sorted.reshape(-1, samples)
    rows = np.flatnonzero(usable)
    for piece in spans(len(rows), max(1, _CHUNK // samples)):
        at = rows[piece]
        tied_share[at] = _tied_share(ascending[at], n[at])
        tied = tied_share[at] > 0
        log = log_sorted[at]
        log[tied] = _untied(ascending[at[tied]], n[at[tied]], rng)
        # The package has no batch form: the dip of a row is a sequential algorithm.
        dip[at] = [
            diptest.dipstat(row[:count], sort_x=False)
            for row, count in zip(log, n[at], strict=True)
        ]
    p[rows] = dip_p(dip[rows], n[rows])
    shape = part.n.shape
    return dip.reshape(shape), p.reshape(shape), tied_share.reshape(shape)


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


def _tied_share(ascending: npt.NDArray[Any], n: Counts) -> Floats:
    tied = np.zeros(ascending.shape, dtype=bool)
    tied[:, 1:] = ascending[:, 1:] == ascending[:, :-1]
    tied[:, :-1] |= tied[:, 1:]
    tied &= np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    return np.asarray(np.count_nonzero(tied, axis=-1) / n)


def _untied(ascending: npt.NDArray[Any], n: Counts, rng: np.random.Generator) -> Floats:
    """Return logs of samples, ascending, each moved by up to half a float32 spacing."""
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    exact = np.where(valid, ascending, np.inf).astype(np.float64)
    spacing = np.spacing(np.where(valid, ascending, 1).astype(np.float32)).astype(np.float64)
    exact += spacing * (rng.random(exact.shape) - 0.5)
    exact.sort(axis=-1)
    return np.asarray(np.log(exact, out=exact))
