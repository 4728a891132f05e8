"""Log-concave densities of maximum likelihood, of many rows at once.

The logarithm of a log-concave density is concave. The density has one mode, any skewness, and a
jump at either end if the samples want one. Normal, exponential, uniform and triangular
distributions are log-concave, and so are their truncations. The maximum of the likelihood exists
and is piecewise linear (Cule, Samworth and Stewart, "Maximum likelihood estimation of a
multi-dimensional log-concave density", 2010, doi:10.1111/j.1467-9868.2010.00753.x). Here, the knots
are quantiles of the samples, close at both ends, and a primal-dual interior-point method finds the
maximum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chdstat._core.arrays import Counts, Floats, spans
from chdstat.fit.groups import RowsLast, cumulative, take_last

_KNOTS = 33
_QUANTILES = np.sin(np.linspace(0, np.pi / 2, _KNOTS)) ** 2
_CLOSEST = 1e-3 / _KNOTS
"""Least distance of two knots, in units of the range, since ties would have none. With a tenth of
it, rounding errors of Newton steps decide where the search ends on spikes of equal samples."""
_CYCLES = 20
_TOLERANCE = 0.02
"""Least gap of the barrier, or gain, in log-likelihood of a row that is worth another step."""
_CENTERING, _BOUNDARY, _LONGEST = 2, 0.95, 2.0
"""Limits of a step: the barrier falls to this power of the gap that the step could leave; the step
goes this share of the way to a wall; the density rises at most by this much."""
_REGULAR = 1e-10
_SMALL = 0.02
"""Slope below which moments of the exponential function come from their series."""
_CHUNK = 4096


@dataclass(frozen=True)
class _Problem(RowsLast):
    """Knots of some rows. Rows come last, since there are many more rows than knots.

    The constraints are ``slack = below p[:-2] + center p[1:-1] + above p[2:] >= 0``: concavity at
    the inner knots, scaled so that `center` is 1.
    """

    step: Floats
    weight: Floats
    below: Floats
    above: Floats

    def slack(self, p: Floats) -> Floats:
        return np.asarray(self.below * p[:-2] + p[1:-1] + self.above * p[2:])

    def spread(self, force: Floats) -> Floats:
        """Return the transpose of `slack`, applied to a force on each constraint."""
        total = np.zeros((len(force) + 2, force.shape[-1]))
        total[:-2] += self.below * force
        total[1:-1] += force
        total[2:] += self.above * force
        return total


def log_concave_likelihood(ascending: Floats, n: Counts) -> Floats:
    """Return the largest log-likelihood of log-concave densities, shape (row,).

    The densities have knots at 33 quantiles, which costs less than 0.05. The result is smaller
    where 20 steps do not reach the maximum, as may happen with spikes of equal samples.

    Parameters
    ----------
    ascending
        Samples in ascending order, shape (row, sample), not all equal.
    n
        How many of the samples count, shape (row,).

    Examples
    --------
    >>> x = np.sort(np.random.default_rng(0).random((1, 200)))
    >>> bool(0 <= log_concave_likelihood(x, np.array([200]))[0] < 5)  # of a uniform density: 0
    True
    """
    found = np.empty(len(n))
    for part in spans(len(n), _CHUNK):
        found[part] = _maximum(ascending[part], n[part])
    return found


def _maximum(ascending: Floats, n: Counts) -> Floats:
    last = np.take_along_axis(ascending, n[:, np.newaxis] - 1, axis=-1)
    low, scale = ascending[:, :1], last - ascending[:, :1]
    valid = np.arange(ascending.shape[-1]) < n[:, np.newaxis]
    place = np.where(valid, (ascending - low) / scale, 0.0)
    problem = _problem(place, n)
    value = np.full(len(n), -np.inf)
    rows, p = np.arange(len(n)), _normal(problem)
    slack = problem.slack(p)
    force = 0.1 / (len(slack) * slack)
    for cycle in range(_CYCLES):
        gap = _sum(force * slack)
        further, force, slack, decrement = _newton(problem, p, force, slack, gap)
        lost = ~np.isfinite(further).all(axis=0)
        done = lost | (np.maximum(gap, decrement) * n[rows] < _TOLERANCE) | (cycle == _CYCLES - 1)
        if done.any():
            best = np.where(lost, p, further)[:, done]
            density = _normalized(problem.take(done), best)
            value[rows[done]] = _sum(problem.weight[:, done] * density)
            problem, rows = problem.take(~done), rows[~done]
            further, force, slack = (take_last(v, ~done) for v in (further, force, slack))
        if not rows.size:
            break
        p = further
    return np.asarray(n * (np.nan_to_num(value, nan=-np.inf) - np.log(scale[:, 0])))


def _problem(place: Floats, n: Counts) -> _Problem:
    """Share each sample between the knots beside it: a piecewise linear density sees only that."""
    index = np.rint(_QUANTILES * (n[:, np.newaxis] - 1)).astype(np.int64)
    # Two knots at one sample would coincide.
    rank = np.arange(_KNOTS)
    index = np.maximum(index, rank)
    index = np.clip(np.minimum(index, n[:, np.newaxis] - _KNOTS + rank), 0, n[:, np.newaxis] - 1)
    knots = np.take_along_axis(place, index, axis=-1)
    below = cumulative(place)
    count = np.diff(index, axis=-1)
    beyond = np.diff(np.take_along_axis(below, index, axis=-1), axis=-1) - count * knots[:, :-1]
    step = np.diff(knots, axis=-1)
    share = np.clip(beyond / np.where(step > 0, step, 1), 0, count)
    weight = np.zeros((_KNOTS, len(n)))
    weight[:-1] += (count - share).T
    weight[1:] += share.T
    weight[-1] += 1
    weight /= n
    step = np.maximum(step, _CLOSEST)
    step /= step.sum(axis=-1, keepdims=True)
    step = np.ascontiguousarray(step.T)
    both = 1 / step[:-1] + 1 / step[1:]
    return _Problem(step, weight, -1 / (step[:-1] * both), -1 / (step[1:] * both))


def _normal(problem: _Problem) -> Floats:
    """Return the log density of a normal distribution of twice the variance, at the knots."""
    knots = np.zeros_like(problem.weight)
    np.cumsum(problem.step, axis=0, out=knots[1:])
    mean = _sum(problem.weight * knots)
    variance = np.maximum(_sum(problem.weight * (knots - mean) ** 2), 0.02)
    return _normalized(problem, -((knots - mean) ** 2) / (4 * variance))


def _normalized(problem: _Problem, p: Floats) -> Floats:
    top = p.max(axis=0)
    # From the upper end of each step: from the lower end, the steepest would overflow.
    zeroth, _, _ = _moments(-np.abs(np.diff(p, axis=0)))
    mass = _sum(problem.step * np.exp(np.maximum(p[:-1], p[1:]) - top) * zeroth)
    return np.asarray(p - top - np.log(mass))


def _newton(
    problem: _Problem, p: Floats, force: Floats, slack: Floats, gap: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Take a primal-dual step of ``integral exp(p) - sum w p``, whose minimum is normalised.

    A first step without a barrier shows how far the barrier may fall, and what the step leaves of
    each force times slack (Mehrotra, "On the implementation of a primal-dual interior point
    method", 1992, doi:10.1137/0802028).

    Return the density p, the forces on the constraints, their slack, and the decrement: the gain
    that the step was expected to bring beside the gap. The slack is updated by the step rather than
    computed from p: at knots that are close together, it is smaller than the rounding error of p.
    """
    zeroth, first, second = _moments(np.diff(p, axis=0))
    mass = problem.step * np.exp(p[:-1])
    gradient = -problem.weight
    gradient[:-1] += mass * (zeroth - first)
    gradient[1:] += mass * first
    stiffness = force / slack
    below, above = problem.below, problem.above
    bands = np.zeros((3, *p.shape))
    bands[0, :-1] += mass * (zeroth - 2 * first + second)
    bands[0, 1:] += mass * second
    bands[1, :-1] += mass * (first - second)
    bands[0, :-2] += stiffness * below * below
    bands[0, 1:-1] += stiffness
    bands[0, 2:] += stiffness * above * above
    bands[1, :-2] += stiffness * below
    bands[1, 1:-1] += stiffness * above
    bands[2, :-2] += stiffness * below * above
    bands[0] += _REGULAR
    _factorise(bands)

    def step(target: Floats) -> tuple[Floats, Floats, Floats]:
        change = _solve(bands, problem.spread(target) - gradient)
        of_slack = problem.slack(change)
        return change, of_slack, target - force - stiffness * of_slack

    _, of_slack, of_force = step(np.zeros_like(force))
    left = (slack + _length(slack, of_slack) * of_slack) * (
        force + _length(force, of_force) * of_force
    )
    barrier = gap / len(slack) * np.minimum(_sum(left) / gap, 1) ** _CENTERING
    change, of_slack, of_force = step((barrier - of_slack * of_force) / slack)
    unbalanced = problem.spread(force) - gradient
    decrement = np.abs(_sum(unbalanced * change))
    rise = np.maximum(change.max(axis=0), _REGULAR)
    length = np.minimum(_length(slack, of_slack, _BOUNDARY), _LONGEST / rise)
    force = force + _length(force, of_force, _BOUNDARY) * of_force
    return p + length * change, force, slack + length * of_slack, decrement


def _sum(values: Floats) -> Floats:
    """Add up knots one by one: NumPy's order, and thus the last bit, depends on the rows."""
    return np.asarray(np.cumsum(values, axis=0)[-1])


def _length(values: Floats, change: Floats, share: float = 1.0) -> Floats:
    """Return how much of a change to take: `share` of what keeps values positive, or all."""
    way = np.where(change < 0, -values / change, np.inf).min(axis=0)
    return np.asarray(np.minimum(1.0, share * way))


def _moments(slope: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the integrals of exp(a t), t exp(a t) and t^2 exp(a t) over t from 0 to 1."""
    small = np.abs(slope) < _SMALL
    a = np.where(small, 1.0, slope)
    e = np.exp(a)
    zeroth = (e - 1) / a
    first = (e - zeroth) / a
    second = (e - 2 * first) / a
    a = slope[small]
    zeroth[small] = 1 + a / 2 * (1 + a / 3 * (1 + a / 4))
    first[small] = 1 / 2 + a / 3 * (1 + a / 8 * (3 + a * 0.8))
    second[small] = 1 / 3 + a / 4 * (1 + a / 5 * (2 + a * 5 / 9))
    return zeroth, first, second


def _factorise(bands: Floats) -> None:
    """Factorise symmetric matrices of two bands beside the diagonal, shape (band, knot, row)."""
    # Lists of knots: taking them from an array one by one costs as much as the arithmetic.
    pivot, one, two = (list(band) for band in bands)
    for j in range(len(pivot) - 1):
        factor = one[j] / pivot[j]
        pivot[j + 1] -= factor * one[j]
        if j + 2 < len(pivot):
            one[j + 1] -= factor * two[j]
            further = two[j] / pivot[j]
            pivot[j + 2] -= further * two[j]
            two[j][:] = further
        one[j][:] = factor


def _solve(factors: Floats, right: Floats) -> Floats:
    """Solve systems whose matrices were factorised, in place."""
    x, one, two = list(right), list(factors[1]), list(factors[2])
    x[1] -= one[0] * x[0]
    for j in range(2, len(x)):
        x[j] -= one[j - 1] * x[j - 1] + two[j - 2] * x[j - 2]
    right /= factors[0]
    x[-2] -= one[-2] * x[-1]
    for j in range(len(x) - 3, -1, -1):
        x[j] -= one[j] * x[j + 1] + two[j] * x[j + 2]
    return right
