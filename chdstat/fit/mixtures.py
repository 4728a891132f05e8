"""Mixtures: several kinds of light paths in one pixel, each a log-normal or gamma component.

One search finds the mixtures for all numbers of components. `chdstat.fit.mixture` and
`chdstat.modality` share it and choose among them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Mask
from chdstat._core.display import Card
from chdstat._core.positive import Part, PositivePart
from chdstat._core.statistic import result, variable
from chdstat.errors import InputError, Reason, check_option
from chdstat.fit import em
from chdstat.fit.atoms import Atoms, before_clamps, split
from chdstat.fit.em import COMPONENTS, ComponentFamily, MixtureFamily, Solution
from chdstat.fit.families import (
    Fit,
    ParametricFit,
    counts_of,
    expand,
    get_family,
    zero_log_likelihood,
)
from chdstat.fit.groups import SampleGroups
from chdstat.fit.search import EFFORTS, Effort, Piece, log_samples, score, search
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr


@result
class Mixture(Fit):
    """A zero-inflated mixture: point masses at 0 and at atoms, and up to K components on the rest.

    ``P(X = 0) = zero_share``. A positive X equals the i-th of `atoms` with probability
    ``atom_weights_i``; otherwise it follows ``sum_j weights_j f(x; parameters_j)``. Arrays have the
    batch's shape, () for a single pixel; for components, (..., K). The components of a row are
    sorted by their median, and are NaN beyond its `k`. A row that could not be fitted is NaN with
    `k` 0, and `reason` says why.

    Attributes
    ----------
    family
        Family of the components: 'lognormal' or 'gamma'.
    k
        Number of components, shape (...).
    weights
        Weights of the components, shape (..., K). They add up to 1, whatever the atoms hold.
    atoms, atom_weights
        Radiances that more samples share than a continuous distribution explains, such as that of a
        lamp or of a clamp, and their shares of the positive samples; shape (..., 8), the heaviest
        first; NaN and 0 where there are fewer atoms. Histograms show no atoms.
    parameters
        Parameters by name, shape (..., K): ``mu`` and ``sigma`` of the natural logarithm of
        radiance, or ``shape`` (1) and ``scale`` (radiance).
    standard_errors
        Standard errors of the parameters and of ``weight``, by name, shape (..., K); NaN where
        `error_reason` says why.
    log_likelihood
        Log-likelihood of all good samples: of the continuous ones in linear radiance, plus that of
        which ones are zeros or atoms. Without atoms, it compares with the log-likelihood of any
        family.
    aic, bic
        Criteria of the chosen mixture. It has 3 k parameters: 2 for each of the k components, k - 1
        weights, and the zero share, as in `Fit`. For each parameter beyond the first component, BIC
        adds log(max(n, 160)), since BIC is an approximation for many samples.
    bics
        BIC for 1 to K components, shape (..., K); NaN where there are too few samples for that
        many.
    null_share, null_interval
        Share of nulls among the good samples, shape (...), and its interval, shape (..., 2).
    n, n_null, n_zero, n_negative, n_bad
        Numbers of samples: fitted; null; zero in one channel of a sample that is not null;
        negative, which the model leaves out; bad.
    converged
        Whether the last cycle of the chosen fit raised its log-likelihood by less than the
        tolerance. If not, the fit is the best that was reached.
    reason
        `Reason` codes; `TIED` where the positive samples are only a few values.
    error_reason
        `Reason` codes of why there are no standard errors: as `reason`; `TOO_FEW` samples for
        errors to hold; or `NOT_REGULAR`, where the information is singular, or components overlap
        so much that errors would be too small.
    """

    name_of: ClassVar = "{}_mixture"

    family: MixtureFamily
    k: npt.NDArray[np.int8] = variable("number of components")
    weights: Floats = variable("weights of the components", "component")
    atoms: Floats = variable("radiance that many samples share", "atom")
    atom_weights: Floats = variable("shares of the positive samples at the atoms", "atom")
    log_likelihood: Floats = variable("log-likelihood of the zero-inflated mixture")
    bics: Floats = variable(
        "Bayesian information criterion for each number of components", "component"
    )
    converged: Mask = variable("the chosen fit converged")
    reason: npt.NDArray[np.int8] = variable("why there is no {} mixture")
    error_reason: npt.NDArray[np.int8] = variable("why the {} mixture has no standard errors")

    def _card(self) -> Card:
        card = super()._card()
        own = {"components": self.k, "weights": self.weights}
        if np.isfinite(self.atoms).any():
            own |= {"atoms": self.atoms, "their shares": self.atom_weights}
        return replace(card, facts={**own, **card.facts})

    def component_pdf(self, x: npt.ArrayLike) -> Floats:
        """Return the density of each component times its share; they add up to `pdf`.

        The result has shape (component, ...), with the batch's shape, then that of `x`; it is NaN
        beyond the components of a row.
        """
        points = np.asarray(x, np.float64)
        mixed = self._distribution(points.ndim)
        with np.errstate(all="ignore"):
            return np.asarray(mixed.weights * mixed.components.pdf(points))

    @property
    def _continuous_share(self) -> Floats:
        """Share of the components among the positive samples, shape (...)."""
        return np.asarray(1 - self.atom_weights.sum(axis=-1))

    def _mean(self) -> Floats:
        return self._distribution(0).mean()

    def _distribution(self, trailing: int) -> MixtureDistribution:
        def first(values: Floats) -> Floats:
            return expand(np.moveaxis(values, -1, 0), trailing)

        each = {name: first(values) for name, values in self.parameters.items()}
        return MixtureDistribution(
            get_family(self.family).distribution(each),
            first(self._continuous_share[..., np.newaxis] * self.weights),
            first(self.atoms),
            first(self.atom_weights),
        )


_HALVINGS = 70
"""Bisections of the logarithmic interval of a quantile: more than its 64 bits."""
_DARKEST = 1e-320


@dataclass(frozen=True)
class MixtureDistribution:
    """A distribution of mixtures with atoms, with the methods of SciPy that fits need.

    Attributes
    ----------
    components
        Distribution of all components, which lie along the first axis.
    weights
        Weights of the components; NaN where there is no component.
    atoms, atom_weights
        Values and shares of atoms along the first axis; NaN and 0 where there is no atom.
    """

    components: Any
    weights: Floats
    atoms: Floats
    atom_weights: Floats

    def pdf(self, x: Floats) -> Floats:
        """Return the density of the components."""
        return self._mixed(self.components.pdf(x))

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        at_atoms = np.where(self.atoms <= x, self.atom_weights, 0.0).sum(axis=0)
        return np.asarray(self._mixed(self.components.cdf(x)) + at_atoms)

    def ppf(self, q: Floats) -> Floats:
        """Bisect between the lowest and highest quantile of components and atoms."""
        # The ends of the range are known; 0.5 stands in for them.
        inside = np.where((q > 0) & (q < 1), q, 0.5)
        each = np.concatenate([self.components.ppf(inside), self.atoms + 0 * inside])
        low, high = (
            np.clip(end, _DARKEST, np.finfo(np.float64).max)
            for end in (np.fmin.reduce(each), np.fmax.reduce(each))
        )
        for _ in range(_HALVINGS):
            middle = np.sqrt(low) * np.sqrt(high)
            below = self.cdf(middle) < inside
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        ends = np.where(q == 0, 0.0, np.where(q == 1, np.inf, high))
        return np.where(np.isnan(q + self.weights[0]), np.nan, ends)

    def mean(self) -> Floats:
        """Return the expectation."""
        at_atoms = np.nan_to_num(self.atoms) * self.atom_weights
        return np.asarray(self._mixed(self.components.mean()) + at_atoms.sum(axis=0))

    def _mixed(self, values: Floats) -> Floats:
        """Return the weighted sum over components; NaN where there is none."""
        used = ~np.isnan(self.weights)
        mixed = np.sum(np.where(used, self.weights * values, 0.0), axis=0)
        return np.where(used.any(axis=0), mixed, np.nan)


@dataclass(eq=False)
class ChosenMixtures:
    """Chooses among the mixtures that a search finds piece by piece, and collects them.

    Parameters
    ----------
    atoms
        The atoms of the rows; the search is over the continuous rest.
    reason
        Why rows are not searched, shape (...).
    largest
        Most components.
    k
        Number of components; None for the best score.
    """

    atoms: Atoms
    reason: npt.NDArray[np.int8]
    largest: int
    k: int | None = None

    def __post_init__(self) -> None:
        size = self.reason.size, self.largest
        ok = (self.reason == Reason.OK)[..., np.newaxis]
        allowed = _allowed_components(self.atoms, self.largest) & ok
        self._allowed = allowed.reshape(size)
        self._k = np.zeros(size[0], dtype=np.int8)
        # Estimates and errors, of weights and of both parameters.
        self._table = np.full((2, 3, *size), np.nan)
        self._error_reason = self.reason.reshape(-1).copy()
        self._likelihoods = np.full(size, np.nan)
        self._converged = np.zeros(size[0], dtype=bool)

    def enter(self, piece: Piece, solutions: list[Solution]) -> None:
        """Collect the mixtures that were found for some rows."""
        allowed = self._allowed[piece.rows]
        values = np.stack([s.log_likelihood for s in solutions], axis=-1)
        # Minus infinity marks numbers of components that the search did not try.
        self._likelihoods[piece.rows] = np.where(allowed & (values > -np.inf), values, np.nan)
        log_n = log_samples(piece.corrected.n)
        scores = np.stack([score(s, log_n) for s in solutions], axis=-1)
        compared = np.where(allowed & ~np.isnan(scores), scores, -np.inf)
        best = compared.argmax(axis=-1)
        if self.k is not None:
            best[:] = self.k - 1
        for k in np.unique(best):
            at = np.flatnonzero(best == k)
            rows, solution = piece.rows[at], solutions[k].take(at)
            weight, family = np.exp(solution.state[0]), solution.family
            parameters = family.parameters(solution.state, solution.origin)
            estimates = np.stack([weight / weight.sum(axis=0), *parameters])
            gain = scores[at, k] - scores[at, :k].max(axis=-1, initial=-np.inf)
            groups = piece.corrected.take(at)
            errors, self._error_reason[rows] = _standard_errors(solution, groups, gain)
            order = np.argsort(family.median(solution.state), axis=0)[np.newaxis, np.newaxis]
            ordered = np.take_along_axis(np.stack([estimates, errors]), order, axis=2)
            self._table[:, :, rows, : k + 1] = np.moveaxis(ordered, -1, 2)
            self._k[rows] = k + 1
            self._converged[rows] = solution.converged

    def search_rest(self, family: MixtureFamily, effort: Effort) -> None:
        """Search rows with equal samples: what is left of them without atoms."""
        tied = np.flatnonzero(self.atoms.tied)
        usable = (self.reason == Reason.OK)[self.atoms.tied]
        for piece, solutions in search(
            self.atoms.rest, usable, family, self.largest, effort=effort
        ):
            self.enter(replace(piece, rows=tied[piece.rows]), solutions)

    def result(self, family: MixtureFamily) -> Mixture:
        """Return the chosen mixtures."""
        atoms, largest, part = self.atoms, self.largest, self.atoms.part
        shape, n = part.n.shape, atoms.n
        others = zero_log_likelihood(part) + atoms.log_likelihood() - n * atoms.log_mean
        values = self._likelihoods.reshape(*shape, largest) + others[..., np.newaxis]
        k = self._k.reshape(shape)
        further = 3 * np.arange(largest) * log_samples(n)[..., np.newaxis]
        penalty = 2 * np.log(n)[..., np.newaxis] + further
        bics = penalty + np.log(part.n_good)[..., np.newaxis] - 2 * values
        at = np.maximum(k, 1).astype(np.int64)[..., np.newaxis] - 1
        chosen, bic = (
            np.where(k > 0, np.take_along_axis(each, at, axis=-1)[..., 0], np.nan)
            for each in (values, bics)
        )
        names = ("weight", *get_family(family).units)
        estimates, errors = (
            dict(zip(names, values, strict=True))
            for values in self._table.reshape(2, 3, *shape, largest)
        )
        return Mixture(
            family=family,
            k=k,
            weights=estimates.pop("weight"),
            atoms=atoms.values,
            atom_weights=atoms.counts / np.maximum(part.n, 1)[..., np.newaxis],
            parameters=estimates,
            standard_errors=errors,
            log_likelihood=chosen,
            aic=np.asarray(6.0 * k - 2 * chosen),
            bic=bic,
            bics=bics,
            **counts_of(part),
            converged=self._converged.reshape(shape),
            reason=self.reason,
            error_reason=self._error_reason.reshape(shape),
        )


def _allowed_components(atoms: Atoms, largest: int) -> Mask:
    """Return which numbers of components are allowed, shape (..., component).

    A mixture needs as many samples as parameters, and no more components than bins.
    """
    k, part = np.arange(1, largest + 1), atoms.part
    enough = atoms.n[..., np.newaxis] >= 3 * k - 1
    if isinstance(part, PositivePart):
        return enough
    return np.asarray(enough & (np.count_nonzero(part.counts > 0, axis=-1)[..., np.newaxis] >= k))


_LARGEST_K = 8


@dataclass(frozen=True)
class MixtureFit(ParametricFit[Mixture]):
    """Mixtures of log-normal or gamma components; options as in `mixture`."""

    result: ClassVar = Mixture
    description: ClassVar = "fitting {} mixtures"
    prefix: ClassVar = "{}_mixture_"
    of_components: ClassVar = True

    k: int | None = None
    family: MixtureFamily = "lognormal"
    max_k: int = 3
    effort: Effort = "thorough"

    def __post_init__(self) -> None:
        check_option("family", self.family, COMPONENTS)
        check_option("effort", self.effort, EFFORTS)
        for name, given in (("k", 1 if self.k is None else self.k), ("max_k", self.max_k)):
            if not isinstance(given, (int, np.integer)) or not 1 <= given <= _LARGEST_K:
                message = f"{name} must be a whole number from 1 to {_LARGEST_K}, got {given!r}"
                raise InputError(message)

    @property
    def subject(self) -> str:
        """Family of the components."""
        return self.family

    def coordinates(self) -> dict[str, npt.NDArray[np.int64]]:
        """Return the numbers of the components."""
        return {"component": np.arange(1, 1 + (self.k or self.max_k))}

    def measure(self, part: Part) -> Mixture:
        """Fit a mixture to each row."""
        k, family, effort = self.k, self.family, self.effort
        largest = self.max_k if k is None else k
        atoms = split(part)
        reason = atoms.reason(3 * min(largest, 2) - 1)
        if k is not None:
            least = _allowed_components(atoms, k)[..., k - 1]
            reason[(reason == Reason.OK) & ~least] = Reason.TOO_FEW
        atoms = before_clamps(atoms, family)
        chosen = ChosenMixtures(atoms, reason, largest, k=k)
        whole = (reason == Reason.OK) & ~atoms.tied
        for found in search(part, whole, family, largest, effort=effort):
            chosen.enter(*found)
        chosen.search_rest(family, effort)
        return chosen.result(family)


@of_source
def mixture(
    x: Source,
    k: int | None = None,
    *,
    family: MixtureFamily = "lognormal",
    max_k: int = 3,
    effort: Effort = "thorough",
    null: npt.ArrayLike | None = None,
    progress: bool = True,
) -> Mixture | xr.Dataset:
    """Fit a zero-inflated mixture of log-normal or gamma components by maximum likelihood.

    The positive part has the density ``f(x) = sum_j w_j f_j(x)``. Expectation-maximisation starts
    from fixed, not random, starts and works on groups of neighbouring samples (see
    `chdstat.fit.em`), so that the cost hardly depends on spp. The log-likelihood is that of linear
    radiance and compares with that of any family.

    The likelihood of a mixture has no maximum: a component may shrink to one sample. Therefore,
    each of several components counts 0.3 of a sample more, at 3.5 median distances of neighbouring
    samples from its centre, and its standard deviation in log x is at least 1e-3.

    Values that more samples share than a continuous distribution explains are atoms (see
    `chdstat.fit.atoms`). The components describe the rest. Samples that rounding made equal are
    spread over the interval that was rounded to them. Clamped samples count as the tail that one
    component has above the clamp. More than one component needs 5 samples or more.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`. A log histogram cannot show components narrower than a bin: their
        standard deviation in log x is at least 0.28 of a bin's width h, 0.063 by default. Its
        log-likelihood is that of the bins, per h.
    k
        Number of components; None to choose from 1 to `max_k` by BIC.
    family
        Family of the components: 'lognormal' or 'gamma'.
    max_k
        Largest number of components that is tried, at most 8.
    effort
        'thorough', or 'fast', which has fewer starts and a looser tolerance and takes a quarter of
        the time.

    Returns
    -------
    Mixture or xarray.Dataset
        `Mixture` for an array or a `Histogram`. For an image, its fields as variables over (y, x,
        channel) and (y, x, channel, component), with names such as ``lognormal_mixture_k``,
        ``lognormal_mixture_mu`` and ``lognormal_mixture_mu_se``, except for fields that all fits
        share.

    Raises
    ------
    InputError
        If an option is unknown or out of range.

    References
    ----------
    Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm", 1977,
    doi:10.1111/j.2517-6161.1977.tb01600.x. Verbeek, Nunnink and Vlassis, "Accelerated EM-based
    clustering of large data sets", 2006, doi:10.1007/s10618-005-0033-3. Fraley and Raftery,
    "Bayesian regularization for normal mixture estimation and model-based clustering", 2007,
    doi:10.1007/s00357-007-0004-5 (the penalty is the inverse gamma prior there, much weaker). Chen
    and Tan, "Inference for multivariate normal mixtures", 2009, doi:10.1016/j.jmva.2008.12.006.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> x = np.concatenate([rng.lognormal(-4, 0.5, size=300), rng.lognormal(1, 0.3, size=700)])
    >>> result = mixture(x)
    >>> int(result.k), result.weights.round(2), result.parameters["mu"].round(1)
    (2, array([0.3, 0.7, nan]), array([-4.1,  1. ,  nan]))
    """
    statistic = MixtureFit(k, family, max_k, effort)
    return run(statistic, x, null=null, progress=progress)


_SMALLEST = 1e-150
_WORST = 1e-12
"""Reciprocal condition at or below which an information matrix counts as singular."""
_FEWEST, _TIMES, _CLEAR = 30, 10, 18.0
"""Fewest samples of each of several components; how many times the samples that the family's errors
need must be there in total; and least score by which several components beat fewer."""
_FALL, _FLATTER, _STEEPER = 0.5 * 1.96**2, 0.7, 2.0
"""Expected fall of the log-likelihood at either end of a 95 % interval, and the least and largest
multiple of it that counts as parabolic."""
_WIDER = 1.1
"""Factor of the errors of several components, for the remaining error of all this."""


def _standard_errors(
    solution: Solution, groups: SampleGroups, gain: Floats
) -> tuple[Floats, npt.NDArray[np.int8]]:
    """Return standard errors of weights and both parameters, and why some are missing.

    They are those of maximum likelihood for many samples, given the number of components. They
    would be too small if a component has few samples, components overlap, or the samples barely
    support the number of components; then there are none. The limits were measured: 1.96 errors
    hold the truth in 90 to 99 % (``tests/fit/test_mixture.py``).

    The errors come from the inverse of the empirical information, the sum of the outer products of
    the samples' scores (McLachlan and Peel, "Finite mixture models", 2000, doi:10.1002/0471721182,
    equation 2.62), here with the mean scores of the groups. With several components, the likelihood
    must also fall about as a parabola does along every parameter (Meeker and Escobar, "Teaching
    about approximate confidence regions based on maximum likelihood estimation", 1995,
    doi:10.1080/00031305.1995.10476112).

    Parameters
    ----------
    solution, groups
        The mixtures, and the groups of samples.
    gain
        How far their score is above that of fewer components, shape (row,).

    Returns
    -------
    ndarray
        Errors, shape (3, component, row).
    ndarray
        `Reason` codes, shape (row,).
    """
    family, k = solution.family, solution.state.shape[1]
    size, few = np.exp(solution.state[0]) * groups.n, np.zeros(len(gain), dtype=bool)
    small = (k > 1) & (size < _FEWEST).any(axis=0)
    regular = ~small & (gain >= _CLEAR)
    rows, found = np.flatnonzero(regular), np.full((len(gain), 3 * k - 1, 3 * k - 1), np.nan)
    some, held = solution.take(rows), groups.take(rows)
    found[rows] = covariance(some, held)
    if k > 1:
        regular[rows] = _is_parabolic(some, held, found[rows])
    own = np.sqrt(np.diagonal(found, axis1=-2, axis2=-1)).T
    last = np.sqrt(found[:, : k - 1, : k - 1].sum(axis=(-2, -1)))
    described = get_family(family.name)
    errors = [np.vstack([own[: k - 1], np.where(k > 1, last, 0.0)])]
    for name, error, parameter, logarithmic in zip(
        described.units,
        own[k - 1 :].reshape(2, k, -1),
        family.parameters(solution.state, solution.origin),
        family.logarithmic,
        strict=True,
    ):
        least = described.errors_from.get(name, 0)
        enough = (size >= least) & ((k == 1) | (groups.n >= _TIMES * least))
        few |= ~enough.all(axis=0)
        error = error * parameter if logarithmic else error
        errors.append(np.where(enough, error, np.nan))
    table = np.stack(errors) * (1 if k == 1 else _WIDER)
    table[..., ~regular] = np.nan
    reason = np.where(few | small, Reason.TOO_FEW, Reason.OK)
    reason[(reason == Reason.OK) & np.isnan(table).any(axis=(0, 1))] = Reason.NOT_REGULAR
    return table, reason.astype(np.int8)


def _is_parabolic(solution: Solution, groups: SampleGroups, found: Floats) -> Mask:
    """Return where the log-likelihood falls as the errors say, along each parameter's profile."""
    family, k = solution.family, solution.state.shape[1]
    moves = directions(family, k)
    top = em.bound_at(groups, family, solution.state)
    state = np.stack([np.exp(solution.state[0]), *solution.state[1:]])
    good = np.ones(len(top), dtype=bool)
    for parameter in range(3 * k - 1):
        along = found[:, parameter] / np.sqrt(found[:, parameter, parameter])[:, np.newaxis]
        step = 1.96 * np.einsum("rp,pik->ikr", along, moves)
        for end in (state + step, state - step):
            there = np.stack([np.log(end[0]), *end[1:]])
            fall = (top - em.bound_at(groups, family, there)) / _FALL
            good &= (fall > _FLATTER) & (fall < _STEEPER)
    return good


def directions(family: ComponentFamily, k: int) -> Floats:
    """Return how weight, location and log scale move with each parameter of `covariance`.

    The result has shape (parameter, 3, component).
    """
    moves, one = np.zeros((3 * k - 1, 3, k)), np.eye(k)
    moves[: k - 1, 0] = one[:-1] - one[-1]
    both = np.reshape(family.directions, (2, 1, 2, 1)) * one[:, np.newaxis]
    moves[k - 1 :, 1:] = both.reshape(2 * k, 2, k)
    return moves


def covariance(solution: Solution, groups: SampleGroups) -> Floats:
    """Return the covariance that the information gives, shape (row, parameter, parameter).

    The parameters are all weights but the last, then those of the family's scores: the first of
    each component, then the second of each.
    """
    shares = em.responsibilities(groups, solution.family, solution.state)
    share = shares / np.maximum(groups.count, 1)
    weight = np.exp(solution.state[0])[:, np.newaxis]
    of_weights = share[:-1] / weight[:-1] - share[-1] / weight[-1]
    first, second = solution.family.scores(groups, solution.state[:, :, np.newaxis])
    scores = np.concatenate([of_weights, share * first, share * second])
    information = np.einsum("icr,jcr,cr->rij", scores, scores, groups.count, optimize=True)
    return _inverse(information)


def _inverse(information: Floats) -> Floats:
    """Invert symmetric matrices, scaled to a unit diagonal; NaN where they are singular."""
    size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    size = np.where(size > _SMALLEST, size, 1.0)
    scaled = information / (size[:, :, np.newaxis] * size[:, np.newaxis, :])
    values, vectors = np.linalg.eigh(np.nan_to_num(scaled))
    singular = values[:, :1] <= _WORST * values[:, -1:]
    inverse = np.where(singular, np.nan, 1 / np.where(singular, 1.0, values))
    unscaled = (vectors * inverse[:, np.newaxis, :]) @ vectors.transpose(0, 2, 1)
    return np.asarray(unscaled / size[:, :, np.newaxis] / size[:, np.newaxis, :])
