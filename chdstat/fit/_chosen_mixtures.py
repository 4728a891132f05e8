"""Chosen mixtures: of all that a search finds, those of the chosen numbers of components.

`chdstat.fit.mixture` and `chdstat.modality` share it, so that one search serves both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._multiplicity import wilson
from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat._reasons import Reason
from chdstat._routes import Part
from chdstat.fit._components import MixtureFamily
from chdstat.fit._grounds import Solution
from chdstat.fit._information import standard_errors
from chdstat.fit._search import Found
from chdstat.fit.mixture_results import Mixture
from chdstat.fit.mle import zero_log_likelihood

__all__ = ["ChosenMixtures", "allowed_components"]

_NAMES = {"lognormal": ("mu", "sigma"), "gamma": ("shape", "scale")}


@dataclass(frozen=True)
class ChosenMixtures:
    """Mixtures that a search finds, piece by piece, of the chosen numbers of components.

    Attributes
    ----------
    part
        What the search is of.
    reason
        Why rows are not searched, shape (...).
    allowed
        How many components a row may have, shape (row, component).
    chosen
        The number of components, or None for that of the best score.
    held_out
        What the score is, shape (row, component), or None for BIC.
    k, values, errors, likelihoods, converged
        What was found, shape (row,), (parameter, row, component) or (row, component).
    """

    part: Part
    reason: npt.NDArray[np.int8]
    allowed: Mask
    chosen: int | None
    held_out: Floats | None
    k: npt.NDArray[np.int8]
    values: Floats
    errors: Floats
    likelihoods: Floats
    converged: Mask

    @classmethod
    def of(
        cls,
        part: Part,
        reason: npt.NDArray[np.int8],
        largest: int,
        *,
        k: int | None = None,
        held_out: Floats | None = None,
    ) -> ChosenMixtures:
        """Begin with nothing found."""
        rows = part.n.size
        allowed = allowed_components(part, largest) & (reason == Reason.OK)[..., np.newaxis]
        allowed = allowed.reshape(rows, largest)
        return cls(
            part=part,
            reason=reason,
            allowed=allowed,
            chosen=k,
            held_out=None if held_out is None else np.where(allowed, held_out, np.nan),
            k=np.zeros(rows, dtype=np.int8),
            values=np.full((3, rows, largest), np.nan),
            errors=np.full((3, rows, largest), np.nan),
            likelihoods=np.full((rows, largest), np.nan),
            converged=np.zeros(rows, dtype=bool),
        )

    def enter(self, found: Found) -> None:
        """Take over what was found of some rows."""
        solutions, allowed = found.solutions, self.allowed[found.rows]
        values = np.stack([s.log_likelihood for s in solutions], axis=-1)
        # Minus infinity stands for what the search did not try.
        self.likelihoods[found.rows] = np.where(allowed & (values > -np.inf), values, np.nan)
        if self.chosen is None:
            n = np.log(found.cells.n)[:, np.newaxis]
            parameters = 3 * np.arange(1, len(solutions) + 1)
            bic = values - parameters * n / 2
            score = bic if self.held_out is None else self.held_out[found.rows]
            best = np.where(allowed & ~np.isnan(score), score, -np.inf).argmax(axis=-1)
        else:
            best = np.full(len(found.rows), self.chosen - 1)
        for k in np.unique(best):
            at = np.flatnonzero(best == k)
            self._describe(found.rows[at], solutions[k].take(at), found, at)

    def result(self, family: MixtureFamily) -> Mixture:
        """Return all of it."""
        return _result(self, family)

    def _describe(self, rows: Counts, solution: Solution, found: Found, at: Counts) -> None:
        k = solution.state.shape[1]
        values = _parameters(solution)
        errors = standard_errors(solution, found.cells.take(at))
        names = ("weight", *_NAMES[solution.family.name])
        order = np.argsort(_median(solution), axis=-1)
        for i, name in enumerate(names):
            self.values[i, rows, :k] = np.take_along_axis(values[name], order, axis=-1)
            self.errors[i, rows, :k] = np.take_along_axis(errors[name], order, axis=-1)
        self.k[rows] = k
        self.converged[rows] = solution.converged


def allowed_components(part: Part, largest: int) -> Mask:
    """Say how many components a row may have: with as many samples as parameters, or more.

    Nor may there be more components than distinct values, shape (..., component).
    """
    k = np.arange(1, largest + 1)
    if isinstance(part, PositivePart):
        rises = part.sorted[..., 1:] > part.sorted[..., :-1]
        distinct = np.count_nonzero(rises & part.valid[..., 1:], axis=-1) + (part.n > 0)
    else:
        distinct = np.count_nonzero(part.counts > 0, axis=-1)
    enough = part.n[..., np.newaxis] >= 3 * k - 1
    return np.asarray(enough & (distinct[..., np.newaxis] >= k))


def _parameters(solution: Solution) -> dict[str, Floats]:
    log_weight, location, log_scale = solution.state.transpose(0, 2, 1)
    origin = solution.origin[:, np.newaxis]
    weight = np.exp(log_weight)
    weight /= weight.sum(axis=-1, keepdims=True)
    if solution.family.name == "lognormal":
        return {"weight": weight, "mu": location + origin, "sigma": np.exp(log_scale)}
    scale = np.exp(location - log_scale + origin)
    return {"weight": weight, "shape": np.exp(log_scale), "scale": scale}


def _median(solution: Solution) -> Floats:
    """Return the medians of the components as log radiance less origin, shape (row, component)."""
    _, location, log_scale = solution.state.transpose(0, 2, 1)
    if solution.family.name == "lognormal":
        return np.asarray(location)
    shape = np.exp(log_scale)
    with np.errstate(divide="ignore"):
        return np.asarray(location + np.log(special.gammaincinv(shape, 0.5) / shape))


def _result(found: ChosenMixtures, family: MixtureFamily) -> Mixture:
    part = found.part
    shape, largest = part.n.shape, found.likelihoods.shape[-1]
    rest = (zero_log_likelihood(part) - part.n * part.log_statistics.log_mean)[..., np.newaxis]
    values = found.likelihoods.reshape(*shape, largest) + rest
    k = found.k.reshape(shape)
    at = np.maximum(k, 1).astype(np.int64)[..., np.newaxis] - 1
    chosen = np.where(k > 0, np.take_along_axis(values, at, axis=-1)[..., 0], np.nan)
    held_out = np.full(values.shape, np.nan) if found.held_out is None else found.held_out
    with np.errstate(divide="ignore"):
        log_n, log_good = np.log(part.n), np.log(part.n_good)
    of_shape = 3 * np.arange(1, largest + 1) - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        null_share = np.asarray(part.n_null / part.n_good)
        bics = of_shape * log_n[..., np.newaxis] + log_good[..., np.newaxis] - 2 * values
        bic = np.asarray((3.0 * k - 1) * log_n + log_good - 2 * chosen)
    weights, *estimates = found.values.reshape(3, *shape, largest)
    names = _NAMES[family]
    errors = found.errors.reshape(3, *shape, largest)
    return Mixture(
        family=family,
        criterion="bic" if found.held_out is None else "held_out",
        k=k,
        weights=weights,
        parameters=dict(zip(names, estimates, strict=True)),
        standard_errors=dict(zip(("weight", *names), errors, strict=True)),
        log_likelihood=chosen,
        aic=np.asarray(6.0 * k - 2 * chosen),
        bic=bic,
        bics=bics,
        held_out=held_out.reshape(*shape, largest),
        null_share=null_share,
        null_interval=wilson(part.n_null, part.n_good),
        n=part.n,
        n_null=part.n_null,
        n_zero=part.n_zero,
        n_negative=part.n_negative,
        n_bad=part.n_bad,
        converged=found.converged.reshape(shape),
        reason=found.reason,
    )
