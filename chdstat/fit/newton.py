"""Newton: maximise smooth functions of two parameters, one for each row, all rows at once.

Steps are damped where the function is not concave or a step did not climb (Levenberg 1944,
doi:10.1090/qam/10666), so that a row converges from afar and quadratically in the end; rows that
are done leave the block. A function of one parameter fills the second with gradient 0 and
curvature -1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._core.positive import Floats, Mask
from chdstat.fit.weighted_samples import Halves, Points, of_rows
from chdstat.summary.dispatch import Part

__all__ = ["Surface", "climb", "maximize"]

_ITERATIONS = 60
_REACH = 2.0
_ROUGHLY, _HALVES, _EXACTLY = 1e-2, 1e-2, 3e-5
"""Newton steps at which to stop: what they leave is of the order of their squares."""
_CONCAVE = 1e-3
_NEXT, _APART = 0.3, 0.05
"""Distances below which a start leads to the same maximum, and above which two ends are two."""
_CLOSE = 0.05
"""Difference per sample that a few points may get wrong."""


@dataclass(frozen=True)
class Surface:
    """A function of two parameters at one point per row.

    Attributes
    ----------
    value
        Shape (row,).
    gradient
        Shape (2, row).
    curvature
        Second derivatives: of the first parameter, mixed, of the second; shape (3, row).
    """

    value: Floats
    gradient: Floats
    curvature: Floats


def maximize(
    surface: Callable[[Points, Floats], Surface],
    points: Points,
    start: Floats,
    *,
    floor: float = -np.inf,
    tolerance: float = _EXACTLY,
) -> tuple[Floats, Mask]:
    """Climb from `start`, shape (2, row), to the maximum next to it.

    Parameters
    ----------
    surface
        The function for these points at these parameters; NaN where it has no value.
    points
        What the function is of.
    start
        First parameters.
    floor
        Least value, above 0, of the second parameter, if it has any: a maximum at the floor counts.
    tolerance
        Steps this small end the climb; being Newton's, they leave about their square.

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
        step = _within(at, _step(_along(at, here, floor), damping), floor)
        # The last step is taken on trust: what it leaves is of the order of its square.
        done = (np.abs(step) < tolerance * _unit(at, floor)).all(axis=0) & (damping == 0)
        best[:, rows] = np.where(done, at + step, at)
        converged[rows] = done
        active = ~done & np.isfinite(step).all(axis=0) & (damping < 1e8)
        if not active.any():
            break
        if np.count_nonzero(active) < 0.7 * len(rows):
            kept = np.flatnonzero(active)
            rows, points, at, step, damping = (
                rows[kept],
                points.take(kept),
                at[:, kept],
                step[:, kept],
                damping[kept],
            )
            here = _choose(here, kept)
        trial = at + step
        there = surface(points, trial)
        with np.errstate(invalid="ignore"):
            climbs = there.value >= here.value - 1e-11 * (1 + np.abs(here.value))
        if climbs.all():
            at, here = trial, there
            damping = np.where(damping < 1e-2, 0, damping / 10) if damping.any() else damping
            continue
        at = np.where(climbs, trial, at)
        here = _merge(climbs, there, here)
        damping = np.where(climbs, np.where(damping < 1e-2, 0, damping / 10), 10 * damping + 0.1)
    return best, converged


def climb(
    part: Part,
    surface: Callable[[Points, Floats], Surface],
    *,
    start: Callable[[Points], Floats],
    finish: Callable[[Points, Floats, Mask], Floats],
    names: int,
    minimum: int,
    floor: float = -np.inf,
    near: tuple[Floats, Floats] | None = None,
) -> Floats:
    """Maximise for all rows of a part, first for a few points of each, then for all of them.

    Parameters
    ----------
    part, surface, floor
        As for `maximize`, but for a whole part.
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

    def roughly(points: Points) -> Floats:
        first, *others = start(points).reshape(-1, 2, len(points.n))
        end, _ = maximize(surface, points, first, floor=floor, tolerance=_ROUGHLY)
        if not others:
            return np.concatenate([end, np.full_like(end, np.nan)])
        return _in_order(surface, points, end, _from_afar(surface, points, end, others[0], floor))

    def exactly(points: Points) -> Floats:
        begin, other = rough[:2, points.rows], rough[2:, points.rows]
        lost = np.isnan(begin).any(axis=0)
        if lost.any():
            # The few points were all equal, while some others are not.
            begin = np.where(lost, start(points).reshape(-1, *begin.shape)[0], begin)
        at, converged = maximize(surface, points, begin, floor=floor, tolerance=tolerance)
        _try_others(surface, points, other, floor, at, converged)
        return finish(points, at, converged)

    tolerance = _EXACTLY
    rough = np.full((4, part.n.size), np.nan)
    if near is not None:
        rough[:2] = np.stack(near).reshape(2, -1)
    unknown = np.asarray(np.isnan(rough[:2]).any(axis=0))
    if isinstance(part, Halves) and near is not None:
        tolerance = _HALVES
        return of_rows(part, minimum, names, exactly, among=~unknown).reshape(names, *part.n.shape)
    if unknown.any():
        found = of_rows(part, minimum, 4, roughly, thin=True, among=unknown)
        rough = np.where(unknown, found, rough)
    return of_rows(part, minimum, names, exactly).reshape(names, *part.n.shape)


def _from_afar(
    surface: Callable[[Points, Floats], Surface],
    points: Points,
    end: Floats,
    start: Floats,
    floor: float,
) -> Floats:
    """Climb from another start where that is not next to where the first climb ended; else NaN."""
    other = np.full_like(end, np.nan)
    rows = np.flatnonzero(~(np.abs(start - end) < _NEXT).all(axis=0))
    if len(rows):
        some = points.take(rows)
        other[:, rows], _ = maximize(surface, some, start[:, rows], floor=floor, tolerance=_ROUGHLY)
    return other


def _in_order(
    surface: Callable[[Points, Floats], Surface], points: Points, one: Floats, two: Floats
) -> Floats:
    """Return the higher end, then the other if all points may make it the higher; else NaN."""
    first, second = surface(points, one).value, surface(points, two).value
    with np.errstate(invalid="ignore"):
        swap = (second > first) | (np.isnan(first) & np.isfinite(second))
        open_question = (np.abs(two - one) > _APART).any(axis=0)
        open_question &= np.abs(second - first) < _CLOSE
    higher, lower = np.where(swap, two, one), np.where(swap, one, two)
    return np.concatenate([higher, np.where(open_question, lower, np.nan)])


def _try_others(
    surface: Callable[[Points, Floats], Surface],
    points: Points,
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
    there, done = maximize(surface, some, other[:, rows], floor=floor)
    with np.errstate(invalid="ignore"):
        better = surface(some, there).value > surface(some, at[:, rows]).value
    at[:, rows] = np.where(better, there, at[:, rows])
    converged[rows] = np.where(better, done, converged[rows])


def _unit(at: Floats, floor: float) -> Floats | float:
    """Return what steps are small in comparison with: 1, or a positive parameter that is less."""
    if not np.isfinite(floor):
        return 1.0
    return np.stack([np.ones_like(at[1]), np.minimum(at[1], 1)])


def _along(at: Floats, here: Surface, floor: float) -> Surface:
    """Return the surface along the floor for rows that lie on it and would fall through."""
    held = (at[1] <= floor) & (here.gradient[1] < 0)
    if not held.any():
        return here
    zero = np.array([[1.0], [0.0]])
    return Surface(
        value=here.value,
        gradient=np.where(held, here.gradient * zero, here.gradient),
        curvature=np.where(held, [here.curvature[0], 0 * at[0], 0 * at[0] - 1], here.curvature),
    )


def _within(at: Floats, step: Floats, floor: float) -> Floats:
    """Cut steps that go too far; towards the floor, to a hundredth of what there is."""
    step = np.clip(step, -_REACH, _REACH)
    if np.isfinite(floor):
        step[1] = np.maximum(step[1], np.maximum(-0.99 * at[1], floor - at[1]))
    return step


def _step(here: Surface, damping: Floats) -> Floats:
    """Solve (H - shift) step = -gradient, the shift large enough to make H negative definite."""
    a, b, d = here.curvature
    determinant = a * d - b * b
    concave = (a < 0) & (determinant > 0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if not concave.all() or damping.any():
            size = np.abs(a) + np.abs(d)
            largest = (a + d) / 2 + np.sqrt(((a - d) / 2) ** 2 + b**2)
            shift = np.where(concave, 0, largest + _CONCAVE * size) + damping * size
            a, d = a - shift, d - shift
            determinant = a * d - b * b
        p, q = here.gradient / determinant
        return np.stack([b * q - d * p, b * p - a * q])


def _choose(surface: Surface, rows: npt.NDArray[np.intp]) -> Surface:
    return Surface(surface.value[rows], surface.gradient[:, rows], surface.curvature[:, rows])


def _merge(first: Mask, one: Surface, other: Surface) -> Surface:
    return Surface(
        value=np.where(first, one.value, other.value),
        gradient=np.where(first, one.gradient, other.gradient),
        curvature=np.where(first, one.curvature, other.curvature),
    )
