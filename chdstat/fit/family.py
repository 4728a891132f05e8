"""Family: what a row of the table of families holds, and how its likelihood is maximised.

Estimates in closed form aside, families have profile likelihoods of one or two parameters, which
Newton's method maximises for all rows at once. Steps are damped where the function is not concave
or a step did not climb (Levenberg 1944, doi:10.1090/qam/10666), so that a row converges from afar
and quadratically in the end; rows that are done leave the block. To a function of one parameter, a
second is added with gradient 0 and curvature -1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Mask
from chdstat.fit.weighted_samples import Halves, WeightedSamples, of_rows, sum_over_samples
from chdstat.summary.dispatch import Part

__all__ = ["RADIANCE", "Estimate", "Family", "Parameters", "maximise", "summed", "take"]

Parameters = Mapping[str, Floats]

LogDensity = Callable[[WeightedSamples, Parameters], Floats]

RADIANCE = "W sr-1 m-2"
"""Unit of a scale parameter."""


@dataclass(frozen=True)
class Estimate:
    """Parameters and standard errors by name, and where the estimate is a maximum.

    `limit` is the `Reason` code of the limit of the family that the likelihood rises towards, where
    it has no maximum, and 0 elsewhere.
    """

    parameters: Parameters
    standard_errors: Parameters
    converged: Mask
    limit: npt.NDArray[np.int8] | Literal[0] = 0


@dataclass(frozen=True)
class Family:
    """A parametric family on the positive numbers.

    Attributes
    ----------
    name
        What users call it.
    label
        Its name in running text.
    documentation
        ``__doc__`` of its module: "Name: what it is for.", the formula, references and an example.
    units
        Names of its parameters, with their units.
    estimate
        Maximum likelihood; a search may begin at given parameters, which are NaN where there are
        none. Rows that cannot be fitted may hold anything but must not warn.
    log_likelihood
        Sum over the positive samples of the log density in linear radiance, at given parameters.
    log_density
        Log density of log x at the points of some rows, shape (row, point), given the parameters of
        these rows, shape (row,). That of x is smaller by log x.
    distribution
        SciPy's frozen distribution with given parameters, which may be arrays.
    mean
        Expectation at given parameters; None where SciPy's will do.
    errors_from
        Positive samples from which on 1.96 standard errors hold the truth in nine of ten cases, by
        the name of the parameter, where it is more than the fit needs. Simulated.
    selected
        Whether `select` compares it by default.
    density, tail_index, error_formula
        For the table of the documentation: the density as TeX; the tail index and where standard
        errors come from as reStructuredText.
    typical
        Range of each parameter over the CHDs of rendered images at unit scale, from which to draw
        parameters for simulations.
    """

    name: str
    label: str
    documentation: str | None
    units: Mapping[str, str]
    estimate: Callable[[Part, Parameters | None], Estimate]
    log_likelihood: Callable[[Part, Parameters], Floats]
    log_density: LogDensity
    distribution: Callable[[Parameters], Any]
    mean: Callable[[Parameters], Floats] | None = None
    errors_from: Mapping[str, int] = field(default_factory=dict)
    selected: bool = False
    density: str = ""
    tail_index: str = ""
    error_formula: str = ""
    typical: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def minimum(self) -> int:
        """Positive samples that a fit needs: as many as there are parameters."""
        return len(self.units)


def take(parameters: Parameters, rows: npt.NDArray[Any]) -> dict[str, Floats]:
    """Return the parameters of some rows of the flattened batch."""
    return {name: value.reshape(-1)[rows] for name, value in parameters.items()}


def summed(log_density: LogDensity) -> Callable[[Part, Parameters], Floats]:
    """Return a log-likelihood that adds up log densities, for families without sufficient sums."""

    def log_likelihood(part: Part, parameters: Parameters) -> Floats:
        known = np.asarray(np.isfinite(np.stack(list(parameters.values()))).all(axis=0))

        def of_points(points: WeightedSamples) -> Floats:
            return (
                log_density(points, take(parameters, points.rows)) - points.log_mean[:, np.newaxis]
            )

        return sum_over_samples(part, known, of_points)

    return log_likelihood


_ITERATIONS = 60
_REACH = 2.0
_ROUGHLY, _HALVES, _EXACTLY = 1e-2, 1e-2, 3e-5
"""Newton steps at which to stop: what they leave is of the order of their squares."""
_CONCAVE = 1e-3
_NEXT, _APART = 0.3, 0.05
"""Distances below which a start leads to the same maximum, and above which two ends are two."""
_CLOSE = 0.05
"""Difference per sample that a few points may get wrong."""


Surface = Callable[[WeightedSamples, Floats], Floats]
"""A function of two parameters, given for some points, at parameters of shape (2, row).

It returns six numbers, shape (6, row): the value; the first derivatives by the first and the second
parameter; the second derivatives by the first, mixed, and by the second. NaN where it has no value.
One of the first parameter alone returns three: its value and its two derivatives.
"""


def _of_two(surface: Surface) -> Surface:
    """Return a surface as one of two parameters, whatever it is of."""

    def six(points: WeightedSamples, at: Floats) -> Floats:
        values = surface(points, at)
        return values if len(values) == 6 else _padded(*values)

    return six


def _padded(value: Floats, slope: Floats, curvature: Floats) -> Floats:
    zero = np.zeros_like(value)
    return np.stack([value, slope, zero, curvature, zero, zero - 1])


def _maximise_block(
    surface: Surface,
    points: WeightedSamples,
    start: Floats,
    *,
    floor: float = -np.inf,
    tolerance: float = _EXACTLY,
) -> tuple[Floats, Mask]:
    """Climb from `start`, shape (2, row), to the maximum next to it.

    Parameters
    ----------
    surface
        What to maximise.
    points
        What the function is of.
    start
        First parameters.
    floor
        Least value, above 0, of the second parameter, if it has any: a maximum at the floor counts.
    tolerance
        Steps this small end the search; being Newton's, they leave about their square.

    Returns
    -------
    parameters, converged
        Shapes (2, row) and (row,).
    """
    best, converged = start.copy(), np.zeros(start.shape[1], dtype=bool)
    rows = np.arange(start.shape[1])
    at, here = start, surface(points, start)
    damping = np.zeros(len(rows))
    for _ in range(_ITERATIONS):
        step = np.clip(_step(_along(at, here, floor), damping), -_REACH, _REACH)
        small = np.abs(step) < tolerance
        if np.isfinite(floor):
            # Towards the floor, a step goes to a hundredth of what there is.
            step[1] = np.maximum(step[1], np.maximum(-0.99 * at[1], floor - at[1]))
            small[1] = np.abs(step[1]) < tolerance * np.minimum(at[1], 1)
        # The last step is taken on trust: what it leaves is of the order of its square.
        done = small.all(axis=0) & (damping == 0)
        best[:, rows] = np.where(done, at + step, at)
        converged[rows] = done
        active = ~done & np.isfinite(step).all(axis=0) & (damping < 1e8)
        if not active.any():
            break
        if np.count_nonzero(active) < 0.7 * len(rows):
            kept = np.flatnonzero(active)
            rows, points, damping = rows[kept], points.take(kept), damping[kept]
            at, step, here = at[:, kept], step[:, kept], here[:, kept]
        trial = at + step
        there = surface(points, trial)
        with np.errstate(invalid="ignore"):
            climbs = there[0] >= here[0] - 1e-11 * (1 + np.abs(here[0]))
        if climbs.all() and not damping.any():
            at, here = trial, there
            continue
        at, here = np.where(climbs, trial, at), np.where(climbs, there, here)
        damping = np.where(climbs, np.where(damping < 1e-2, 0, damping / 10), 10 * damping + 0.1)
    return best, converged


def maximise(
    part: Part,
    surface: Surface,
    *,
    start: Callable[[WeightedSamples], Floats],
    finish: Callable[[WeightedSamples, Floats, Mask], Floats],
    names: int,
    minimum: int,
    floor: float = -np.inf,
    near: tuple[Floats, Floats] | None = None,
) -> Floats:
    """Maximise for all rows of a part, first for a few points of each, then for all of them.

    Parameters
    ----------
    part, surface, floor
        What to maximise, for all rows of a part; floor as of `_maximise_block`.
    start
        First parameters for the points of some rows, shape (2, row); or several, where there may be
        several maxima, shape (start, 2, row).
    finish
        What to return for the points of some rows, with the parameters and where they are a
        maximum; shape (names, row).
    names
        How many numbers that is.
    minimum
        Samples that a row needs.
    near
        First parameters, if they are known, each of the batch's shape: a row that has them needs no
        start. Of `Halves`, rows that have none are left out.

    Returns
    -------
    ndarray
        Shape (names, ...).
    """

    def roughly(points: WeightedSamples) -> Floats:
        first, *others = start(points).reshape(-1, 2, len(points.n))
        end, _ = _maximise_block(surface, points, first, floor=floor, tolerance=_ROUGHLY)
        if not others:
            return np.concatenate([end, np.full_like(end, np.nan)])
        return _in_order(surface, points, end, _from_afar(surface, points, end, others[0], floor))

    def exactly(points: WeightedSamples) -> Floats:
        begin, other = rough[:2, points.rows], rough[2:, points.rows]
        lost = np.isnan(begin).any(axis=0)
        if lost.any():
            # The few points were all equal, while some others are not.
            begin = np.where(lost, start(points).reshape(-1, *begin.shape)[0], begin)
        at, converged = _maximise_block(surface, points, begin, floor=floor, tolerance=tolerance)
        _try_others(surface, points, other, floor, at, converged)
        return finish(points, at, converged)

    surface = _of_two(surface)
    rough = np.full((4, part.n.size), np.nan)
    if near is not None:
        rough[:2] = np.stack(near).reshape(2, -1)
    unknown = np.asarray(np.isnan(rough[:2]).any(axis=0))
    halves = isinstance(part, Halves) and near is not None
    tolerance = _HALVES if halves else _EXACTLY
    if unknown.any() and not halves:
        found = of_rows(part, minimum, 4, roughly, thin=True, among=unknown)
        rough = np.where(unknown, found, rough)
    results = of_rows(part, minimum, names, exactly, among=~unknown if halves else None)
    return results.reshape(names, *part.n.shape)


def _from_afar(
    surface: Surface, points: WeightedSamples, end: Floats, start: Floats, floor: float
) -> Floats:
    """Climb from another start where that is not next to where the first climb ended; else NaN."""
    other = np.full_like(end, np.nan)
    rows = np.flatnonzero(~(np.abs(start - end) < _NEXT).all(axis=0))
    if len(rows):
        some = points.take(rows)
        other[:, rows], _ = _maximise_block(
            surface, some, start[:, rows], floor=floor, tolerance=_ROUGHLY
        )
    return other


def _in_order(surface: Surface, points: WeightedSamples, one: Floats, two: Floats) -> Floats:
    """Return the higher end, then the other if all points may make it the higher; else NaN."""
    first, second = surface(points, one)[0], surface(points, two)[0]
    with np.errstate(invalid="ignore"):
        swap = (second > first) | (np.isnan(first) & np.isfinite(second))
        open_question = (np.abs(two - one) > _APART).any(axis=0)
        open_question &= np.abs(second - first) < _CLOSE
    higher, lower = np.where(swap, two, one), np.where(swap, one, two)
    return np.concatenate([higher, np.where(open_question, lower, np.nan)])


def _try_others(
    surface: Surface,
    points: WeightedSamples,
    other: Floats,
    floor: float,
    at: Floats,
    converged: Mask,
) -> None:
    """Climb from the other start, too, where there is one; keep what is higher, in place."""
    rows = np.flatnonzero(np.isfinite(other).all(axis=0))
    if not len(rows):
        return
    some = points.take(rows)
    there, done = _maximise_block(surface, some, other[:, rows], floor=floor)
    with np.errstate(invalid="ignore"):
        better = surface(some, there)[0] > surface(some, at[:, rows])[0]
    at[:, rows] = np.where(better, there, at[:, rows])
    converged[rows] = np.where(better, done, converged[rows])


def _along(at: Floats, here: Floats, floor: float) -> Floats:
    """Return the derivatives along the floor for rows that lie on it and would fall through."""
    held = (at[1] <= floor) & (here[2] < 0)
    if not held.any():
        return here
    value, slope, _, curvature, _, _ = here
    return np.where(held, _padded(value, slope, curvature), here)


def _step(here: Floats, damping: Floats) -> Floats:
    """Solve (H - shift) step = -gradient, the shift large enough to make H negative definite."""
    _, by_first, by_second, a, b, d = here
    determinant = a * d - b * b
    concave = (a < 0) & (determinant > 0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if not concave.all() or damping.any():
            size = np.abs(a) + np.abs(d)
            largest = (a + d) / 2 + np.sqrt(((a - d) / 2) ** 2 + b**2)
            shift = np.where(concave, 0, largest + _CONCAVE * size) + damping * size
            a, d = a - shift, d - shift
            determinant = a * d - b * b
        p, q = by_first / determinant, by_second / determinant
        return np.stack([b * q - d * p, b * p - a * q])
