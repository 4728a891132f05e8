"""Grounds: what a search climbs on, and how it ends there: on the samples, or between bins.

The cells are a stand-in. Where samples are at hand, solutions are judged by them, and improved on
them where the cells have blurred too much. Where only bins are, their width is taken out again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from chdstat._arrays import spans
from chdstat._positive import Counts, Floats, Mask
from chdstat.fit._cells import Cells, single_cells
from chdstat.fit._components import ComponentFamily
from chdstat.fit._em import Climb, bound_at, climb, log_density, maximise, responsibilities
from chdstat.fit._starts import single

__all__ = ["Bins", "Ground", "SampleRows", "Solution", "log_likelihood"]

_CHUNK = 2**17
"""Samples worked on at once: they stay in the cache."""
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Solution:
    """The best mixture found for a family and a number of components, for each row.

    Attributes
    ----------
    family
        Of the components.
    state
        As in `chdstat.fit._components`, shape (3, component, row).
    origin
        Of y = log x - origin, shape (row,).
    log_likelihood
        Of log x, shape (row,): without the Jacobian of the logarithm.
    converged
        Shape (row,).
    """

    family: ComponentFamily
    state: Floats
    origin: Floats
    log_likelihood: Floats
    converged: Mask

    def take(self, rows: Counts) -> Solution:
        """Return some of the rows."""
        return Solution(
            self.family,
            self.state[..., rows],
            self.origin[rows],
            self.log_likelihood[rows],
            self.converged[rows],
        )

    def put(self, rows: Counts, origin: Floats) -> Solution:
        """Return the solution with these rows where they belong, and no others."""
        if len(rows) == len(origin):
            return self
        state = np.zeros((*self.state.shape[:2], len(origin)))
        value = np.full(len(origin), -np.inf)
        converged = np.zeros(len(origin), dtype=bool)
        state[..., rows], value[rows], converged[rows] = (
            self.state,
            self.log_likelihood,
            self.converged,
        )
        return Solution(self.family, state, origin, value, converged)


class Ground(Protocol):
    """What a search climbs on."""

    @property
    def cells(self) -> Cells:
        """What to climb on."""

    @property
    def sharp(self) -> Cells:
        """Cells as close to the samples as there are."""

    def take(self, rows: Counts) -> Ground:
        """Return some of the rows."""

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        """Turn where a climb ended into a solution."""


@dataclass(frozen=True)
class SampleRows:
    """Logarithms of samples in ascending order, of which `n` count, and their cells.

    Where the cells lose more than `loss` of log-likelihood per sample, the climb goes on for up to
    `cycles` on the samples.
    """

    cells: Cells
    log_sorted: Floats
    n: Counts
    loss: float
    cycles: int

    @property
    def sharp(self) -> Cells:
        return self.cells

    def take(self, rows: Counts) -> SampleRows:
        cells, log_sorted, n = self.cells.take(rows), self.log_sorted[rows], self.n[rows]
        return SampleRows(cells, log_sorted, n, self.loss, self.cycles)

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        state, converged, origin = end.state.copy(), end.converged.copy(), self.cells.origin
        if state.shape[1] == 1:
            # Without a choice of component, sums over cells are those over samples.
            return Solution(family, state, origin, end.bound, converged)
        value = log_likelihood(self.log_sorted, self.n, family, state, origin)
        blurred = np.flatnonzero(value - end.bound > self.loss * self.n)
        for piece in spans(len(blurred), _rows(self.log_sorted)):
            rows = blurred[piece]
            singles = single_cells(self.log_sorted[rows], self.n[rows])
            further = climb(
                singles, family, state[..., rows], cycles=self.cycles, tolerance=_TOLERANCE
            )
            state[..., rows], converged[rows] = further.state, further.converged
            value[rows] = bound_at(singles, family, further.state)
        return Solution(family, state, origin, value, converged)


@dataclass(frozen=True)
class Bins:
    """Cells that are bins, and the same cells with Sheppard's corrections.

    EM climbs on the bins as they are, whose likelihood is one of binned data: with corrected ones,
    it would be rewarded for components that hide within a bin. The last maximisation takes the
    corrected ones. Moving the samples to the centres of bins costs all mixtures alike about the
    same, so the likelihoods are shifted by what it costs one component.
    """

    cells: Cells
    sharp: Cells

    def take(self, rows: Counts) -> Bins:
        return Bins(self.cells.take(rows), self.sharp.take(rows))

    def finish(self, family: ComponentFamily, end: Climb) -> Solution:
        state = maximise(self.sharp, family, responsibilities(self.cells, family, end.state))
        one, sharp_one = single(self.cells, family), single(self.sharp, family)
        shift = bound_at(self.sharp, family, sharp_one) - bound_at(self.cells, family, one)
        return Solution(family, state, self.cells.origin, end.bound + shift, end.converged)


def log_likelihood(
    log_sorted: Floats, n: Counts, family: ComponentFamily, state: Floats, origin: Floats
) -> Floats:
    """Return the log-likelihood of log x of samples in ascending order, shape (row,)."""
    values = np.empty(len(n))
    coefficients = family.coefficients(state)
    for part in spans(len(n), _rows(log_sorted)):
        valid = np.arange(log_sorted.shape[-1]) < n[part, np.newaxis]
        y = np.where(valid, log_sorted[part] - origin[part, np.newaxis], 0.0)
        with np.errstate(over="ignore"):
            density = log_density(y, family.transform(y), coefficients[..., part])
        values[part] = np.vecdot(density, valid)
    return values


def _rows(samples: Floats) -> int:
    return max(1, _CHUNK // int(samples.shape[-1]))
