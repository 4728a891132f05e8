"""Maximum likelihood: maximises profile likelihoods of one or two parameters.

Newton's method climbs all rows at once. Steps are damped where the function is not concave or a
step did not climb (Levenberg 1944, doi:10.1090/qam/10666). A row thus converges from afar, and
quadratically in the end. Rows that are done leave the block.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import Part
from chdstat.fit.family import TIGHT, WeightedSamples, of_rows

_ITERATIONS, _FEW_ITERATIONS = 60, 30
"""Most steps of the search on all points, and of the search on a few points."""
_REACH = 2.0
_ROUGHLY = 1e-2
"""Newton step at which the search on a few points ends."""
_CONCAVE = 1e-3
_NEXT, _APART = 0.3, 0.05
"""Distance below which a start leads to the same maximum, and above which two maxima differ."""
_CLOSE = 0.05
"""Difference per sample that the few points may get wrong."""

_Surface = Callable[[WeightedSamples, Floats], Floats]
"""A function of two parameters, for some points, at parameters of shape (2, row).

It returns six numbers, shape (6, row): the value; the first derivatives by the first and the second
parameter; the second derivatives by the first, mixed, and by the second. They are NaN where there
is no value. A function of the first parameter alone returns three numbers: the value and its two
derivatives.
"""


def maximise(
    part: Part,
    surface: _Surface,
    *,
    start: Callable[[WeightedSamples], Floats],
    finish: Callable[[WeightedSamples, Floats, Mask], Floats],
    names: int,
    minimum: int,
    floor: float = -np.inf,
    near: tuple[Floats, Floats] | None = None,
    tolerance: float = TIGHT,
) -> Floats:
    """Maximise for all rows of a part, first on a few points of each row, then on all points.

    Parameters
    ----------
    part, surface
        The samples, and the function to maximise for each row.
    start
        Returns first parameters for the points of some rows, shape (2, row); or two sets, where
        there may be two maxima, shape (2, 2, row).
    finish
        Returns the result for the points of some rows, shape (names, row), from the parameters and
        where they are a maximum.
    names
        Numbers that `finish` returns for a row.
    minimum
        Fewest samples of a row.
    floor
        Least value of the second parameter, above 0, if it has any: a maximum at the floor counts.
    near
        First parameters, if they are known, each with the batch's shape. The search on a few points
        is then skipped, and rows where they are NaN are left out.
    tolerance
        Step size that ends the search; after a Newton step, the error is about its square.

    Returns
    -------
    Results of `finish`, shape (names, ...).
        Shape (names, ...).
    """
    climb = _Climb(surface, floor)

    def roughly(points: WeightedSamples) -> Floats:
        first, *others = start(points).reshape(-1, 2, len(points.n))
        one, _ = climb.from_start(points, first, _ROUGHLY, _FEW_ITERATIONS)
        two = np.full_like(one, np.nan)
        for other in others:
            # A start close to the first maximum would lead to it again.
            rows = np.flatnonzero(~(np.abs(other - one) < _NEXT).all(axis=0))
            if len(rows):
                some = points.take(rows), other[:, rows], _ROUGHLY, _FEW_ITERATIONS
                two[:, rows], _ = climb.from_start(*some)
        if not others:
            return np.concatenate([one, two])
        # The higher maximum comes first. The other is kept if it may be the higher one on all
        # points.
        of_one, of_two = climb.value(points, one)[0], climb.value(points, two)[0]
        swap = (of_two > of_one) | (np.isnan(of_one) & np.isfinite(of_two))
        undecided = (np.abs(two - one) > _APART).any(axis=0) & (np.abs(of_two - of_one) < _CLOSE)
        higher, lower = np.where(swap, two, one), np.where(swap, one, two)
        return np.concatenate([higher, np.where(undecided, lower, np.nan)])

    def exactly(points: WeightedSamples) -> Floats:
        begin, other = rough[:2, points.rows], rough[2:, points.rows]
        lost = np.isnan(begin).any(axis=0)
        if lost.any():
            # The few points were all equal, but other points are not.
            begin = np.where(lost, start(points).reshape(-1, *begin.shape)[0], begin)
        at, converged = climb.from_start(points, begin, tolerance)
        rows = np.flatnonzero(np.isfinite(other).all(axis=0))
        if len(rows):
            some = points.take(rows)
            there, done = climb.from_start(some, other[:, rows], tolerance)
            better = climb.value(some, there)[0] > climb.value(some, at[:, rows])[0]
            at[:, rows] = np.where(better, there, at[:, rows])
            converged[rows] = np.where(better, done, converged[rows])
        return finish(points, at, converged)

    known = None
    if near is None:
        rough = of_rows(part, minimum, 4, roughly, thin=True)
    else:
        rough = np.full((4, part.n.size), np.nan)
        rough[:2] = np.stack(near).reshape(2, -1)
        known = np.asarray(np.isfinite(rough[:2]).all(axis=0))
    return of_rows(part, minimum, names, exactly, among=known).reshape(names, *part.n.shape)


@dataclass(frozen=True)
class _Climb:
    """Newton's method on a surface whose second parameter has a floor."""

    surface: _Surface
    floor: float

    def value(self, points: WeightedSamples, at: Floats) -> Floats:
        """Return six numbers; without a second parameter, the surface is at its maximum in it."""
        found = self.surface(points, at)
        if len(found) == 6:
            return found
        value, slope, curvature = found
        zero = np.zeros_like(value)
        return np.stack([value, slope, zero, curvature, zero, zero - 1])

    def from_start(
        self, points: WeightedSamples, start: Floats, tolerance: float, most: int = _ITERATIONS
    ) -> tuple[Floats, Mask]:
        """Climb from `start` to the next maximum, shape (2, row); return it and where it is one."""
        best, (converged, closed) = start.copy(), np.zeros((2, start.shape[1]), dtype=bool)
        rows = np.arange(start.shape[1])
        at, here = start, self.value(points, start)
        damping = np.zeros(len(rows))
        for _ in range(most):
            step = np.clip(self._step(at, here, damping), -_REACH, _REACH)
            small = np.abs(step) < tolerance
            if np.isfinite(self.floor):
                # A step towards the floor leaves at least a hundredth of the parameter.
                step[1] = np.maximum(step[1], np.maximum(-0.99 * at[1], self.floor - at[1]))
                small[1] = np.abs(step[1]) < tolerance * np.minimum(at[1], 1)
            # The last step is not checked: the remaining error is of the order of its square.
            done = small.all(axis=0) & (damping == 0)
            # A row that is done does not change, however long the others take.
            open_ = ~closed[rows]
            best[:, rows[open_]] = np.where(done, at + step, at)[:, open_]
            converged[rows[open_]] = done[open_]
            closed[rows] |= done | ~np.isfinite(step).all(axis=0) | (damping >= 1e8)
            active = ~closed[rows]
            if not active.any():
                break
            if np.count_nonzero(active) < 0.7 * len(rows):
                kept = np.flatnonzero(active)
                rows, points, damping = rows[kept], points.take(kept), damping[kept]
                at, step, here = at[:, kept], step[:, kept], here[:, kept]
            trial = at + step
            there = self.value(points, trial)
            climbs = there[0] >= here[0] - 1e-11 * (1 + np.abs(here[0]))
            if climbs.all() and not damping.any():
                at, here = trial, there
                continue
            at, here = np.where(climbs, trial, at), np.where(climbs, there, here)
            damping = np.where(
                climbs, np.where(damping < 1e-2, 0, damping / 10), 10 * damping + 0.1
            )
        return best, converged

    def _step(self, at: Floats, here: Floats, damping: Floats) -> Floats:
        """Solve (H - shift) step = -gradient, with a shift that makes H negative definite.

        Rows at the floor whose step would cross it move along it.
        """
        _, by_first, by_second, a, b, d = here
        held = (at[1] <= self.floor) & (by_second < 0)
        if held.any():
            by_second, b, d = (
                np.where(held, fixed, free) for fixed, free in ((0, by_second), (0, b), (-1, d))
            )
        determinant = a * d - b * b
        concave = (a < 0) & (determinant > 0)
        if not concave.all() or damping.any():
            size = np.abs(a) + np.abs(d)
            largest = (a + d) / 2 + np.sqrt(((a - d) / 2) ** 2 + b**2)
            shift = np.where(concave, 0, largest + _CONCAVE * size) + damping * size
            a, d = a - shift, d - shift
            determinant = a * d - b * b
        p, q = by_first / determinant, by_second / determinant
        return np.stack([b * q - d * p, b * p - a * q])
