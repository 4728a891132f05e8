"""Atoms: values that more samples share than a continuous distribution explains.

A lamp that is seen directly, or a clamp, gives many samples one value: a point mass, as nulls are.

Rounding also makes samples equal, but at every value: neighbouring values then have about as many
samples. A value is therefore an atom if it holds more samples than its neighbours let expect. The
expected count comes from the counts of the nearest values on both sides; where few values hold
enough samples, from the quadratic through the logarithms of their counts. The p-value is that of a
negative binomial distribution, a Poisson distribution with an estimated mean (Greenwood and Yule,
"An inquiry into the nature of frequency distributions", 1920, doi:10.2307/2341080). A value without
samples is not seen, so that counts follow a Poisson distribution without its zero (David and
Johnson, "The truncated Poisson", 1952, doi:10.2307/3001863).

`split` takes the samples of atoms out. It spreads samples that rounding made equal over the
interval that was rounded to their value, but never beyond the nearest values. The rest is
continuous.

Renderers clamp radiance against fireflies. A distribution that is cut off no longer belongs to its
family: it looks like several components. The clamped samples are an atom at the top of the row,
where the distribution goes on: `clamped` finds them, and those of a floor. A lamp stands apart.
`before_clamps` replaces them by the tail that the fitted distribution has above the clamp (the EM
algorithm for censored samples: Dempster, Laird and Rubin, "Maximum likelihood from incomplete data
via the EM algorithm", 1977, section 4.2, doi:10.1111/j.2517-6161.1977.tb01600.x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Array, Counts, Floats, Mask, Reals, chunks
from chdstat._core.positive import LogStatistics, Part, PositivePart
from chdstat.errors import Reason
from chdstat.fit.families import estimate_part, get_family
from chdstat.fit.family import take_part
from chdstat.fit.groups import cumulative

_MOST_ATOMS = 8
"""Most atoms of a row: a row with more has no continuous part worth the name."""
_LEVEL = 0.05
"""Share of the rows without atoms in which an atom may be found."""
_RINGS = (1, 2, 4, 8, 16)
_ENOUGH, _MANY = 40, 400
"""Samples that the compared values should hold: 40 while there are at most a quarter of the row's
values on each side, 400 while there are at most a twelfth. More than 16 are never compared."""
_CURVED = 4
"""Most values on each side whose log counts are described by a parabola."""
_FEWEST_VALUES = 5
"""Fewer distinct values than this are not a continuous distribution."""
_HEAVY, _UNEVEN, _IRREGULAR = 10, 2.5, 0.25
"""Rounded values with 10 samples or more lie in even steps: for all but a quarter of them, the step
to one neighbour is at most 2.5 times the step to the other."""
_LEAST_VARIANCE = 1e-12
_FEWEST = 3
"""Fewest samples of an atom."""


@dataclass(frozen=True)
class Atoms:
    """Atoms of rows, the heaviest first, and the samples that are left without them.

    Attributes
    ----------
    part
        The rows.
    values
        Radiance of each atom, shape (..., atom); NaN where a row has fewer atoms.
    counts
        Samples of each atom, same shape; 0 where a row has fewer atoms.
    discrete
        Whether the positive samples are only a few values, without a continuous rest, shape (...).
    tied
        Whether any samples of the row are equal, shape (...). If not, all of them are the rest.
    rest
        The continuous rest of the tied rows only, shape (row,).
    """

    part: Part
    values: Floats
    counts: Counts
    discrete: Mask
    tied: Mask
    rest: Part

    @classmethod
    def none(cls, part: Part) -> Atoms:
        """Return no atoms, for a histogram: its bins are wider than a value."""
        shape = part.n.shape
        values, counts = (
            np.full((*shape, _MOST_ATOMS), np.nan),
            np.zeros((*shape, _MOST_ATOMS), int),
        )
        nowhere = np.zeros(shape, dtype=bool)
        return cls(part, values, counts, nowhere, nowhere, take_part(part, np.zeros(0, np.intp)))

    @property
    def n(self) -> Counts:
        """Samples of the continuous rest of each row, shape (...)."""
        return _put(self.part.n, self.tied, self.rest.n)

    @property
    def log_mean(self) -> Floats:
        """Mean logarithm of the samples of the continuous rest, shape (...)."""
        of_rest = self.rest.log_statistics.log_mean
        return _put(self.part.log_statistics.log_mean, self.tied, of_rest)

    def reason(self, minimum: int) -> npt.NDArray[np.int8]:
        """Return `Reason` codes of rows without a continuous rest of at least `minimum` samples."""
        whole = self.part.reason(minimum)
        rest = _put(whole, self.tied, self.rest.reason(minimum))
        gone = self.discrete | (rest != Reason.OK) & (self.n < self.part.n)
        return np.where(whole == Reason.OK, np.where(gone, Reason.TIED, rest), whole)

    def log_likelihood(self) -> Floats:
        """Return the log-likelihood of which samples are at which atom, or at none, (...)."""
        n = self.part.n[..., np.newaxis]
        others = n - self.counts.sum(axis=-1, keepdims=True)
        parts = np.concatenate([self.counts, others], axis=-1)
        return np.asarray(special.xlogy(parts, parts / np.maximum(n, 1)).sum(axis=-1))


def split(part: Part) -> Atoms:
    """Split the positive samples into atoms and a continuous rest, row by row.

    Samples in bins have no values of their own and stay as they are.

    Examples
    --------
    >>> x = np.random.default_rng(1).lognormal(size=200)
    >>> x[:20] = 3.0  # a lamp
    >>> atoms = split(PositivePart.of(x))
    >>> atoms.values[:2], atoms.counts[:2], int(atoms.n)
    (array([ 3., nan]), array([20,  0]), 180)
    """
    none = Atoms.none(part)
    if not isinstance(part, PositivePart):
        return none
    ascending = part.sorted
    equal = (ascending[..., 1:] == ascending[..., :-1]) & np.isfinite(ascending[..., 1:])
    tied = equal.any(axis=-1)
    rest = take_part(part, np.flatnonzero(tied))
    x, positive = rest.x.astype(np.float64), rest.positive
    values, counts = none.values[tied], none.counts[tied]
    discrete = none.discrete[tied]
    for rows in chunks(len(x), x.shape[-1]):
        found = _split_rows(x[rows], positive[rows], rest.n[rows])
        values[rows], counts[rows], discrete[rows], x[rows], positive[rows] = found
    n = np.count_nonzero(positive, axis=-1).astype(np.int64)
    return Atoms(
        part,
        values=_put(none.values, tied, values),
        counts=_put(none.counts, tied, counts),
        discrete=_put(none.discrete, tied, discrete),
        tied=tied,
        rest=replace(rest, x=x, positive=positive, n=n),
    )


def _put(whole: Array, rows: Mask, new: Array) -> Array:
    """Return a copy in which some rows are new, with their type."""
    found = np.array(whole, dtype=new.dtype, order="C")
    found[rows] = new
    return found


def with_rows(part: PositivePart, rows: Mask, x: Reals, positive: Mask) -> PositivePart:
    """Replace the samples of some rows, a mask of shape (...), in double precision.

    The sums of the other rows are reused.
    """
    n = np.count_nonzero(positive, axis=-1).astype(np.int64)
    found = replace(
        part,
        x=_put(part.x, rows, x.astype(np.float64)),
        positive=_put(part.positive, rows, positive),
        n=_put(part.n, rows, n),
    )
    sums = vars(take_part(found, np.flatnonzero(rows)).log_statistics)
    kept = {name: _put(old, rows, sums[name]) for name, old in vars(part.log_statistics).items()}
    vars(found)["log_statistics"] = LogStatistics(**kept)
    return found


def _split_rows(x: Floats, positive: Mask, n: Counts) -> tuple[Any, ...]:
    """Return values and counts of atoms, which rows are discrete, and the rest in stored order."""
    order = np.argsort(np.where(positive, x, np.inf), axis=-1, kind="stable")
    ascending = np.take_along_axis(x, order, axis=-1)
    valid = np.arange(x.shape[-1]) < n[:, np.newaxis]
    value, count, run = distinct_values(ascending, n)
    log = np.log(value)
    kept, atoms, counts, many = _without_atoms(count, _widths(log))
    discrete = many | _is_discrete(log, kept)
    # If there are only a few values, each with several samples, all of them are atoms.
    few = discrete & (np.count_nonzero(count, axis=-1) <= _MOST_ATOMS)
    width = min(_MOST_ATOMS, count.shape[-1])
    atoms[few, :width] = np.argsort(-count[few], axis=-1, kind="stable")[:, :width]
    counts[few] = np.take_along_axis(count[few], atoms[few], axis=-1)
    counts[few, width:] = 0
    counts[few] *= counts[few] >= _FEWEST
    rows, slots = np.nonzero(counts)
    kept[rows, atoms[rows, slots]] = count[rows, atoms[rows, slots]] - counts[rows, slots]
    values = np.take_along_axis(value, atoms, axis=-1)
    below, above = _half_steps(np.where(kept > 0, log, np.nan), kept > 1)
    rank = np.arange(x.shape[-1]) - np.take_along_axis(cumulative(count), run, axis=-1)
    share = np.take_along_axis(kept, run, axis=-1)
    below, above = (np.take_along_axis(v, run, axis=-1) for v in (below, above))
    stays = valid & (rank < share)
    spread = ascending * np.exp((rank + 0.5) / np.maximum(share, 1) * (below + above) - below)
    moved, still = np.zeros_like(x), np.zeros_like(positive)
    np.put_along_axis(moved, order, np.where(stays & (share > 1), spread, ascending), axis=-1)
    np.put_along_axis(still, order, stays, axis=-1)
    return np.where(counts > 0, values, np.nan), counts, discrete, moved, still


def distinct_values(ascending: npt.NDArray[Any], n: Counts) -> tuple[Floats, Counts, Counts]:
    """Return the distinct values of the first `n` samples, their counts, and each sample's value.

    The last entry along the axis of values, shape (row, value), is always empty: NaN, without
    samples.
    """
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    begins = np.ones(ascending.shape, dtype=bool)
    begins[:, 1:] = ascending[:, 1:] != ascending[:, :-1]
    begins &= valid
    width = int(np.count_nonzero(begins, axis=-1).max(initial=0)) + 1
    run = np.where(valid, np.cumsum(begins, axis=-1) - 1, width - 1)
    value = np.full((len(run), width), np.nan)
    value[np.nonzero(begins)[0], run[begins]] = ascending[begins]
    place = run + width * np.arange(len(run))[:, np.newaxis]
    count = np.bincount(place[valid], minlength=value.size).reshape(value.shape)
    return value, count, run


def _widths(log: Floats) -> Floats:
    """Return the width of the interval that is nearer to each value than to any other."""
    gap = np.full((len(log), log.shape[-1] + 1), np.nan)
    gap[:, 1:-1] = np.diff(log, axis=-1)
    below, above = gap[:, :-1], gap[:, 1:]
    # The outermost values have the same width on both sides.
    below, above = np.where(np.isnan(below), above, below), np.where(np.isnan(above), below, above)
    return np.nan_to_num(0.5 * (below + above))


def _without_atoms(count: Counts, width: Floats) -> tuple[Counts, Counts, Counts, Mask]:
    """Take atoms away, the most surprising of each row first.

    Return the counts without atoms, which values are atoms, shape (row, atom), how many samples
    each atom has, and which rows have more than `_MOST_ATOMS`.
    """
    kept, distinct = count.copy(), np.count_nonzero(count, axis=-1)
    atoms, counts = np.zeros((2, len(count), _MOST_ATOMS), dtype=np.int64)
    rows, many = np.arange(len(count)), np.zeros(len(count), dtype=bool)
    for atom in range(_MOST_ATOMS + 1):
        log_p, expected = _surprise(kept[rows], width[rows])
        best = log_p.argmin(axis=-1)
        here = np.arange(len(rows))
        found = log_p[here, best] < np.log(_LEVEL / distinct[rows])
        rows, best, expected = rows[found], best[found], expected[here[found], best[found]]
        if atom == _MOST_ATOMS:
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


def _surprise(count: Counts, width: Floats) -> tuple[Floats, Floats]:
    """Return log p-values of counts among their neighbours, and the expected counts, same shapes.

    An atom has at least three samples, and more than the average of the values beside it.
    """
    log_p, expected = np.zeros(count.shape), np.zeros(count.shape)
    beside = np.zeros_like(count)
    beside[:, 1:] += count[:, :-1]
    beside[:, :-1] += count[:, 1:]
    row, at = np.nonzero((count >= _FEWEST) & (2 * count > beside))
    if not row.size:
        return log_p, expected
    sums = np.stack([cumulative(v) for v in (count, count > 0, width)])
    log_rate, variance = np.zeros(len(row)), np.zeros(len(row))
    undecided = np.ones(len(row), dtype=bool)
    distinct = np.count_nonzero(count, axis=-1)
    for ring in _RINGS:
        here = np.flatnonzero(undecided)
        level, error, samples = _expected(sums, row[here], at[here], ring)
        log_rate[here], variance[here] = level, error
        room = distinct[row[here]] / ring
        undecided[here] = (samples < _ENOUGH) & (room >= 8) | (samples < _MANY) & (room >= 24)
    mean, number = np.exp(log_rate), count[row, at]
    shape = 1 / np.maximum(variance, _LEAST_VARIANCE)
    tail, seen = (np.log(special.betainc(k, shape, mean / (mean + shape))) for k in (number, 1))
    log_p[row, at], expected[row, at] = tail - seen, mean
    return log_p, expected


def _expected(sums: Floats, row: Counts, at: Counts, ring: int) -> tuple[Floats, Floats, Floats]:
    """Return log expected counts, their variance, and the number of samples behind them.

    They come from the `ring` nearest values on each side, and as many beyond.
    """
    last = sums.shape[-1] - 1
    edges = np.clip(
        at + np.array([-2 * ring, -ring, 0, 1, 1 + ring, 1 + 2 * ring])[:, np.newaxis], 0, last
    )
    held = np.diff(sums[:, row, edges], axis=1)
    samples, values, width = np.delete(held, 2, axis=1)
    known = values > 0
    mean = (samples + 0.5) / np.maximum(values, 1)
    log_rate = np.interp(np.log(mean), *_TRUNCATED, right=np.nan)
    log_rate = np.where(np.isnan(log_rate), np.log(mean), log_rate)
    rate = np.exp(log_rate)
    if ring <= _CURVED:
        # For floats, the step between values doubles at powers of two.
        relative = held[2, 2] * values / np.where(width > 0, width, 1)
        log_rate += np.log(np.clip(relative, 0.5, 2))
    error = 1 / ((samples + 0.5) * (1 + rate - mean))
    near, far = (ring + 1) / 2, (3 * ring + 1) / 2
    curved = known.all(axis=0) & (ring <= _CURVED)
    beyond = np.where(curved, near**2 / (far**2 - near**2), 0.0)
    beside = known[1:3] * (1 + beyond) / np.maximum(known[1:3].sum(axis=0), 1)
    weight = np.stack([-beyond / 2, *beside, -beyond / 2])
    return (
        (weight * log_rate).sum(axis=0),
        (weight**2 * error).sum(axis=0),
        samples[1:3].sum(axis=0),
    )


def _truncated() -> tuple[Floats, Floats]:
    """Return a table of log mean and log rate of a Poisson distribution without its zero."""
    log_rate = np.linspace(np.log(1e-3), np.log(40), 512)
    rate = np.exp(log_rate)
    return np.log(rate / -np.expm1(-rate)), log_rate


_TRUNCATED = _truncated()


def _half_steps(log: Floats, wanted: Mask) -> tuple[Floats, Floats]:
    """Return how far numbers that were rounded to the wanted values may lie below and above them.

    That is half of the median gap among three values on each side, but at most half-way to the next
    value. The result has the shape of `log`, and is 0 where not wanted.
    """
    gap = np.full((len(log), log.shape[-1] + 5), np.inf)
    gap[:, 3:-3] = np.diff(log, axis=-1)
    gap[np.isnan(gap)] = np.inf
    row, at = np.nonzero(wanted)
    around = gap[row, at + np.arange(6)[:, np.newaxis]]
    middle = np.count_nonzero(np.isfinite(around), axis=0) // 2
    typical = np.take_along_axis(np.sort(around, axis=0), middle[np.newaxis], axis=0)[0]
    typical = np.where(np.isfinite(typical), typical, 0.0)
    half = np.zeros((2, *log.shape))
    half[:, row, at] = np.minimum(around[2:4], typical) / 2
    return half[0], half[1]


def _is_discrete(log: Floats, kept: Counts) -> Mask:
    """Return which rows are a few values, or values of many samples in uneven steps, (row,)."""
    used = kept > 0
    order = np.argsort(~used, axis=-1, kind="stable")
    step = np.diff(np.take_along_axis(np.where(used, log, np.nan), order, axis=-1), axis=-1)
    heavy = np.take_along_axis(kept, order, axis=-1)[:, 1:-1] >= _HEAVY
    uneven = np.abs(np.log(step[:, 1:] / step[:, :-1])) > np.log(_UNEVEN)
    few = np.count_nonzero(used, axis=-1) < _FEWEST_VALUES
    most = 2 * np.where(kept >= _HEAVY, kept, 0).sum(axis=-1) > kept.sum(axis=-1)
    several = _IRREGULAR * np.count_nonzero(heavy, axis=-1)
    return np.asarray(few | most & (np.count_nonzero(heavy & uneven, axis=-1) > several))


_IMPUTATIONS, _LAMP = 12, 0.1
"""How often clamped samples are drawn anew; and the least share of the atom at an end that the
fitted tail must explain: below it, the atom is a lamp, not a clamp."""


def clamped(atoms: Atoms, *families: str, floor: bool = False) -> Mask:
    """Return which samples of the tied rows were set to the largest value, shape (row, sample).

    These are the samples of an atom at the top that are more than the tail of one component, of any
    of the families, explains without a lamp. With `floor`, they were set to the smallest value.
    """
    part, rest = atoms.part, atoms.rest
    if not isinstance(part, PositivePart) or not isinstance(rest, PositivePart):
        return np.zeros((len(atoms.rest.n), 0), dtype=bool)
    found, tied = np.zeros(rest.x.shape, dtype=bool), np.flatnonzero(atoms.tied)
    end = (part.sorted[..., 0] if floor else part.largest)[atoms.tied].astype(np.float64)
    at_end = atoms.values[atoms.tied] == end[:, np.newaxis]
    held = np.where(at_end, atoms.counts[atoms.tied], 0).sum(axis=-1)
    rows = np.flatnonzero((held > 0) & ~atoms.discrete[atoms.tied])
    if not rows.size:
        return found
    some, whole, end = take_part(rest, rows), take_part(part, tied[rows]), end[rows]
    laws = [
        family.distribution(estimate_part(some, family)[0].parameters)
        for family in map(get_family, families)
    ]
    beyond = np.fmax.reduce([law.cdf(end) if floor else law.sf(end) for law in laws])
    explained = beyond * some.n > _LAMP * held[rows]
    at_end = whole.positive & ~some.positive & (whole.x == end[:, np.newaxis])
    found[rows] = at_end & explained[:, np.newaxis]
    return found


def before_clamps(atoms: Atoms, family: str) -> Atoms:
    """Replace clamped samples by likely values above the clamp, which become part of the rest.

    One component is fitted; clamped samples become the quantiles of its tail above the clamp; the
    component is fitted again, and so on. Rows without a clamp stay as they are.
    """
    part, rest, cut = atoms.part, atoms.rest, clamped(atoms, family)
    rows = np.flatnonzero(cut.any(axis=-1))
    if not rows.size or not isinstance(part, PositivePart) or not isinstance(rest, PositivePart):
        return atoms
    described, some, cut = get_family(family), take_part(rest, rows), cut[rows]
    top, held = part.largest[atoms.tied][rows], np.count_nonzero(cut, axis=-1)
    row, at = np.nonzero(cut)
    share = (np.cumsum(cut, axis=-1)[row, at] - 0.5) / held[row]
    filled = some
    for _ in range(_IMPUTATIONS):
        parameters = estimate_part(filled, described)[0].parameters
        law = described.distribution({name: value[row] for name, value in parameters.items()})
        x = filled.x.copy()
        x[row, at] = law.isf(share * law.sf(top[row]))
        filled = replace(some, x=x, positive=some.positive | cut, n=some.n + held)
    at_clamp = np.isin(np.arange(len(rest.n)), rows)
    return replace(atoms, rest=with_rows(rest, at_clamp, filled.x, filled.positive))
