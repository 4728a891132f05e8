"""Atoms: values that more samples share than a continuous law explains.

A lamp that is seen directly, or a clamp, gives many samples one value: a point mass, as nulls are.
Rounding makes equal samples, too, at every value; a rounded law has about as many at a value as at
those beside it. So a value is an atom where it holds more samples than its neighbours let expect:
the logarithm of the expected count comes from the counts of the nearest values on either side, by
the quadratic through them where they are many, and the count is compared with a negative binomial
distribution, which is a Poisson one of an estimated mean (Greenwood and Yule, "An inquiry into the
nature of frequency distributions", 1920, doi:10.2307/2341080). Values without samples are not seen:
counts are those of a Poisson distribution without its zero (David and Johnson, "The truncated
Poisson", 1952, doi:10.2307/3001863).

`split` takes the samples of atoms out, and spreads those that rounding made equal over what was
rounded to their value, never further than to the nearest values. What is left is continuous.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import spans
from chdstat._core.positive import Counts, Floats, Mask, PositivePart
from chdstat.fit.weighted_samples import cumulative

__all__ = ["MOST_ATOMS", "Atoms", "split"]

MOST_ATOMS = 8
"""Most atoms of a row: one with more has no continuous part to speak of."""
_LEVEL = 0.01
"""Of rows without atoms in which one may be found."""
_RINGS = (1, 2, 4, 8, 16)
_ENOUGH = 40
"""Values on each side whose counts are compared: the fewest that hold so many samples, at most 16
and a quarter of the values that there are."""
_CURVED = 4
"""Most values on each side over which the logarithms of counts are a parabola."""
_FEWEST_VALUES = 5
"""Fewer distinct values are no continuous law."""
_HEAVY, _UNEVEN, _IRREGULAR = 10, 2.5, 0.25
"""Of rounded samples, values with 10 samples lie in even steps, each at most 2.5 times as wide as
the next, but for a quarter of them."""
_FEWEST = 3
"""Least samples of an atom."""
_CHUNK = 2**18


@dataclass(frozen=True)
class Atoms:
    """Atoms of rows, the heaviest first, and what they leave.

    Attributes
    ----------
    values
        Radiance of each atom, shape (..., atom); NaN beyond those that there are.
    counts
        Samples of each atom, same shape; 0 beyond.
    rest
        The continuous rest, of the shape of the part.
    tied
        Whether any samples of the row were equal, so that the rest is not the part, shape (...).
    discrete
        Whether the positive samples are a few values, without a continuous rest, shape (...).
    """

    values: Floats
    counts: Counts
    rest: PositivePart
    tied: Mask
    discrete: Mask


def split(part: PositivePart) -> Atoms:
    """Split the positive samples into atoms and a continuous rest, row by row.

    Examples
    --------
    >>> x = np.random.default_rng(1).lognormal(size=200)
    >>> x[:20] = 3.0  # a lamp
    >>> atoms = split(PositivePart.of(x))
    >>> atoms.values[:2], atoms.counts[:2], int(atoms.rest.n)
    (array([ 3., nan]), array([20,  0]), 180)
    """
    shape, samples = part.n.shape, part.x.shape[-1]
    ascending, n = part.sorted.reshape(-1, samples), part.n.reshape(-1)
    equal = (ascending[:, 1:] == ascending[:, :-1]) & np.isfinite(ascending[:, 1:])
    tied = equal.any(axis=-1)
    values = np.full((n.size, MOST_ATOMS), np.nan)
    counts = np.zeros((n.size, MOST_ATOMS), dtype=np.int64)
    discrete, rest = np.zeros(n.size, dtype=bool), part
    rows = np.flatnonzero(tied)
    if rows.size:
        x, positive = (
            a.reshape(-1, samples).copy() for a in (part.x.astype(np.float64), part.positive)
        )
        for piece in spans(len(rows), max(1, _CHUNK // samples)):
            at = rows[piece]
            found = _split_rows(x[at], positive[at], n[at])
            values[at], counts[at], discrete[at], x[at], positive[at] = found
        rest = replace(
            part,
            x=x.reshape(part.x.shape),
            positive=positive.reshape(part.x.shape),
            n=(n - counts.sum(axis=-1)).reshape(shape),
        )
    return Atoms(
        values=values.reshape(*shape, MOST_ATOMS),
        counts=counts.reshape(*shape, MOST_ATOMS),
        rest=rest,
        tied=tied.reshape(shape),
        discrete=discrete.reshape(shape),
    )


def _split_rows(x: Floats, positive: Mask, n: Counts) -> tuple[Any, ...]:
    """Return values and counts of atoms, which rows are discrete, and the rest in stored order."""
    order = np.argsort(np.where(positive, x, np.inf), axis=-1, kind="stable")
    ascending = np.take_along_axis(x, order, axis=-1)
    valid = np.arange(x.shape[-1]) < n[:, np.newaxis]
    log, count, run = _table(np.log(np.where(valid, ascending, 1.0)), valid)
    kept, atoms, counts, many = _without_atoms(count)
    discrete = many | _is_discrete(log, kept)
    values = np.take_along_axis(np.exp(log), atoms, axis=-1)
    below, above = _half_steps(np.where(kept > 0, log, np.nan))
    rank = np.arange(x.shape[-1]) - np.take_along_axis(cumulative(count), run, axis=-1)
    share, below, above = (np.take_along_axis(v, run, axis=-1) for v in (kept, below, above))
    stays = valid & (rank < share)
    with np.errstate(invalid="ignore"):
        spread = ascending * np.exp((rank + 0.5) / np.maximum(share, 1) * (below + above) - below)
    moved, still = np.zeros_like(x), np.zeros_like(positive)
    np.put_along_axis(moved, order, np.where(stays & (share > 1), spread, ascending), axis=-1)
    np.put_along_axis(still, order, stays, axis=-1)
    return np.where(counts > 0, values, np.nan), counts, discrete, moved, still


def _table(log: Floats, valid: Mask) -> tuple[Floats, Counts, Counts]:
    """Return distinct values, how many samples each has, and which one each sample has.

    The last of the values, shape (row, value), is always none: NaN, without samples.
    """
    begins = np.ones(log.shape, dtype=bool)
    begins[:, 1:] = log[:, 1:] != log[:, :-1]
    begins &= valid
    width = int(np.count_nonzero(begins, axis=-1).max(initial=0)) + 1
    run = np.where(valid, np.cumsum(begins, axis=-1) - 1, width - 1)
    value = np.full((len(log), width), np.nan)
    value[np.nonzero(begins)[0], run[begins]] = log[begins]
    place = run + width * np.arange(len(log))[:, np.newaxis]
    count = np.bincount(place[valid], minlength=value.size).reshape(value.shape)
    return value, count, run


def _without_atoms(count: Counts) -> tuple[Counts, Counts, Counts, Mask]:
    """Take atoms away, the most surprising of each row first.

    Return the counts without them, which values are atoms, shape (row, atom), how many samples each
    has, and which rows have more than `MOST_ATOMS`.
    """
    kept, distinct = count.copy(), np.count_nonzero(count, axis=-1)
    atoms, counts = np.zeros((2, len(count), MOST_ATOMS), dtype=np.int64)
    rows, many = np.arange(len(count)), np.zeros(len(count), dtype=bool)
    for atom in range(MOST_ATOMS + 1):
        log_p, expected = _surprise(kept[rows])
        best = log_p.argmin(axis=-1)
        here = np.arange(len(rows))
        found = log_p[here, best] < np.log(_LEVEL / distinct[rows])
        rows, best, expected = rows[found], best[found], expected[here[found], best[found]]
        if atom == MOST_ATOMS:
            many[rows] = True
            break
        if not rows.size:
            break
        atoms[rows, atom], left = best, np.rint(expected).astype(np.int64)
        counts[rows, atom] = kept[rows, best] - left
        kept[rows, best] = left
    order = np.argsort(-counts, axis=-1, kind="stable")
    atoms, counts = (np.take_along_axis(v, order, axis=-1) for v in (atoms, counts))
    return kept, atoms, counts, many


def _surprise(count: Counts) -> tuple[Floats, Floats]:
    """Return log p-values of counts among their neighbours, and what was expected, of their shape.

    An atom has three samples or more, and more than the values beside it have on average.
    """
    log_p, expected = np.zeros(count.shape), np.zeros(count.shape)
    beside = np.zeros_like(count)
    beside[:, 1:] += count[:, :-1]
    beside[:, :-1] += count[:, 1:]
    row, at = np.nonzero((count >= _FEWEST) & (2 * count > beside))
    if not row.size:
        return log_p, expected
    sums = np.stack([cumulative(v) for v in (count, count > 0)])
    log_rate, variance = np.zeros(len(row)), np.zeros(len(row))
    undecided = np.ones(len(row), dtype=bool)
    distinct = np.count_nonzero(count, axis=-1)
    for ring in _RINGS:
        here = np.flatnonzero(undecided)
        level, error, samples = _expected(sums, row[here], at[here], ring)
        log_rate[here], variance[here] = level, error
        undecided[here] = (samples < _ENOUGH) & (8 * ring <= distinct[row[here]])
    mean, number = np.exp(log_rate), count[row, at]
    shape = 1 / variance
    with np.errstate(divide="ignore"):
        tail, seen = (
            np.log(special.betainc(k, shape, mean / (mean + shape))) for k in (number, 1)
        )
    log_p[row, at], expected[row, at] = tail - seen, mean
    return log_p, expected


def _expected(
    sums: Floats, row: Counts, at: Counts, ring: int
) -> tuple[Floats, Floats, Floats]:
    """Return log expected counts, their variance, and how many samples they are from.

    They are from the `ring` nearest values on each side, and as many beyond these.
    """
    last = sums.shape[-1] - 1
    edges = np.clip(at + np.array([-2 * ring, -ring, 0, 1, 1 + ring, 1 + 2 * ring])[:, np.newaxis], 0, last)
    held = sums[:, row, edges]
    samples, values = (np.delete(np.diff(v, axis=0), 2, axis=0) for v in held)
    known = values > 0
    mean = (samples + 0.5) / np.maximum(values, 1)
    log_rate = np.interp(np.log(mean), *_TRUNCATED, right=np.nan)
    log_rate = np.where(np.isnan(log_rate), np.log(mean), log_rate)
    error = 1 / ((samples + 0.5) * (1 + np.exp(log_rate) - mean))
    near, far = (ring + 1) / 2, (3 * ring + 1) / 2
    curved = known.all(axis=0) & (ring <= _CURVED)
    beyond = np.where(curved, near**2 / (far**2 - near**2), 0.0)
    beside = known[1:3] * (1 + beyond) / np.maximum(known[1:3].sum(axis=0), 1)
    weight = np.stack([-beyond / 2, *beside, -beyond / 2])
    return (weight * log_rate).sum(axis=0), (weight**2 * error).sum(axis=0), samples[1:3].sum(axis=0)


def _truncated() -> tuple[Floats, Floats]:
    """Return logarithms of the mean of a Poisson distribution without its zero, and of its rate."""
    log_rate = np.linspace(np.log(1e-3), np.log(40), 512)
    rate = np.exp(log_rate)
    return np.log(rate / -np.expm1(-rate)), log_rate


_TRUNCATED = _truncated()


def _half_steps(log: Floats) -> tuple[Floats, Floats]:
    """Return how far what was rounded to a value may lie below and above it, shape of `log`.

    Half-way to the next value, unless that is further than twice the least of the four gaps around.
    """
    gap = np.full((len(log), log.shape[-1] + 3), np.inf)
    gap[:, 2:-2] = np.diff(log, axis=-1)
    gap[np.isnan(gap)] = np.inf
    least = np.min([gap[:, i : i + log.shape[-1]] for i in range(4)], axis=0)
    least = np.where(np.isfinite(least), least, 0.0)
    sides = gap[:, 1:-2], gap[:, 2:-1]
    below, above = (np.where(side <= _UNEVEN * least, side, least) / 2 for side in sides)
    return below, above


def _is_discrete(log: Floats, kept: Counts) -> Mask:
    """Say which rows are a few values, or values with many samples in uneven steps, shape (row,)."""
    few = np.count_nonzero(kept, axis=-1) < _FEWEST_VALUES
    heavy = kept >= _HEAVY
    most = 2 * np.where(heavy, kept, 0).sum(axis=-1) > kept.sum(axis=-1)
    step = np.diff(np.sort(np.where(heavy, log, np.nan), axis=-1), axis=-1)
    with np.errstate(invalid="ignore"):
        ratio = np.abs(np.diff(np.log(step), axis=-1))
        uneven = np.count_nonzero(ratio > np.log(_UNEVEN), axis=-1)
    known = np.count_nonzero(np.isfinite(ratio), axis=-1)
    return np.asarray(few | most & (uneven > _IRREGULAR * known) & (known > 1))
