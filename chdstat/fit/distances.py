"""Distances between samples and a fitted distribution, and their bootstrap distribution.

Each is computed for all rows of samples or bins at once, from the distribution function at the
samples or at the edges of the bins; `chdstat.fit.goodness` explains them and computes p-values.

The bootstrap draws samples from the fit and fits them again. The random numbers of a row are made
of the seed and of the row's own samples, so that its p-value does not depend on which rows are
tested with it. The replicates of several rows are fitted at once. For mixtures, `mixture_family`
makes a family of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.positive import PositivePart
from chdstat.fit.families import estimate_part, get_family
from chdstat.fit.family import Estimate, Family, Parameters, summed, take
from chdstat.fit.mixtures import Mixture, mixture_of_part
from chdstat.fit.weighted_samples import WeightedSamples, take_part
from chdstat.summary.dispatch import Part, PositiveHistogram

__all__ = ["DISTANCES", "FitTest", "bootstrap", "mixture_family"]

FitTest = Literal["kolmogorov-smirnov", "cramer-von-mises", "anderson-darling", "chi-square"]

_LEAST = 1e-300
"""Least probability whose logarithm is taken."""
_FAR = 0.9
"""Where F is larger, 1 - F is computed separately, so that it does not lose its digits."""
_EXPECTED = 5.0
"""Least number of samples expected in a cell (Cochran 1954, doi:10.2307/3001616)."""


@dataclass(frozen=True)
class _Ranked:
    """Rows of samples through the distribution function, ascending; 0 or 1 where there is none.

    Attributes
    ----------
    below, above
        F and 1 - F at the samples, shape (row, sample).
    rank
        1 for the smallest, shape (sample,).
    present
        Which entries are samples, shape (row, sample).
    n
        Samples, shape (row, 1).
    parameters
        Estimated ones.
    """

    below: Floats
    above: Floats
    rank: Counts
    present: Any
    n: Counts
    parameters: int


@dataclass(frozen=True)
class _Binned:
    """Rows of bins: counts and probabilities, shape (row, bin); the rest as of `_Ranked`."""

    counts: Floats
    expected: Floats
    n: Counts
    parameters: int

    @property
    def excess(self) -> Floats:
        """Samples up to the end of each bin, less those expected."""
        return np.cumsum(self.counts - self.expected, axis=-1)


def _distances(
    part: Part, family: Family, parameters: Parameters, tests: Sequence[FitTest]
) -> Floats:
    """Return statistics, shape (row, test), at parameters of shape (row,); NaN without these."""
    fitted = np.asarray(np.isfinite(np.stack(list(parameters.values()))).all(axis=0))
    found = np.full((len(fitted), len(tests)), np.nan)
    rows = np.flatnonzero(fitted)
    if not len(rows):
        return found
    some = part if len(rows) == len(fitted) else take_part(part, rows)
    known, count = take(parameters, rows), len(parameters)
    n = some.n[:, np.newaxis]
    if isinstance(some, PositiveHistogram):
        binned = _Binned(some.counts, _bin_probabilities(some, family, known) * n, n, count)
        values = [DISTANCES[test][1](binned) for test in tests]
    else:
        # Rows have from few to all samples: distribution functions are dear, so of those alone.
        present = some.valid
        below, above = np.zeros(present.shape), np.ones(present.shape)
        x, of_samples = some.sorted[present].astype(np.float64), np.repeat(rows, some.n)
        below[present], above[present] = _both_sides(family, take(parameters, of_samples), x)
        rank = np.arange(1, present.shape[-1] + 1)
        ranked = _Ranked(below, above, rank, present, n, count)
        values = [DISTANCES[test][0](ranked) for test in tests]
    found[rows] = np.stack(values, axis=-1)
    return found


def _both_sides(family: Family, parameters: Parameters, x: Floats) -> tuple[Floats, Floats]:
    """Return F and 1 - F at samples, each with its own digits; parameters are those of each."""
    with np.errstate(all="ignore"):
        below = np.asarray(family.distribution(parameters).cdf(x))
        above = 1 - below
        far = below > _FAR
        above[far] = family.distribution(take(parameters, far)).sf(x[far])
    return below, above


def _bin_probabilities(part: PositiveHistogram, family: Family, parameters: Parameters) -> Floats:
    """Return the probability of each bin, shape (row, bin), given that it is one of them.

    The last bin has all above its lower edge, since it has the samples above the support; what is
    below the support counts as zeros, and takes no part.
    """
    edges = np.exp(part.log_centers - part.width[:, np.newaxis] / 2)
    columns = {name: value[:, np.newaxis] for name, value in parameters.items()}
    with np.errstate(all="ignore"):
        above = np.broadcast_to(family.distribution(columns).sf(edges), part.counts.shape)
        probability = -np.diff(above, axis=-1, append=0) / above[:, :1]
    return np.asarray(np.maximum(np.nan_to_num(probability), 0))


def _kolmogorov_smirnov(r: _Ranked) -> Floats:
    gap = np.maximum(r.rank / r.n - r.below, r.below - (r.rank - 1) / r.n)
    return np.asarray(np.where(r.present, gap, 0).max(axis=-1))


def _cramer_von_mises(r: _Ranked) -> Floats:
    gap = r.below - (r.rank - 0.5) / r.n
    return np.asarray(1 / (12 * r.n[:, 0]) + np.where(r.present, gap**2, 0).sum(axis=-1))


def _anderson_darling(r: _Ranked) -> Floats:
    below, above = (np.log(np.maximum(values, _LEAST)) for values in (r.below, r.above))
    terms = (2 * r.rank - 1) * below + (2 * (r.n - r.rank) + 1) * above
    n = r.n[:, 0]
    return np.asarray(-n - np.where(r.present, terms, 0).sum(axis=-1) / n)


def _chi_square(r: _Ranked) -> Floats:
    """Count samples in equiprobable cells of the fitted distribution; NaN for too few samples.

    There are ``2 n^(2/5)`` (Moore 1986, in D'Agostino and Stephens, "Goodness-of-fit techniques",
    chapter 3), and at most as many as have 5 samples expected.
    """
    n = r.n[:, 0]
    cells = np.minimum(2 * n**0.4, n / _EXPECTED).astype(np.int64)
    most = int(cells.max(initial=1))
    cell = np.minimum(r.below * cells[:, np.newaxis], cells[:, np.newaxis] - 1).astype(np.int64)
    index = np.where(r.present, cell, most) + np.arange(len(n))[:, np.newaxis] * (most + 1)
    counts = np.bincount(index.ravel(), minlength=len(n) * (most + 1)).reshape(len(n), most + 1)
    square = (counts[:, :most].astype(np.float64) ** 2).sum(axis=-1)
    enough = cells >= r.parameters + 2
    return np.where(enough, cells * square / n - n, np.nan)


def _binned_kolmogorov_smirnov(b: _Binned) -> Floats:
    return np.asarray(np.abs(b.excess).max(axis=-1) / b.n[:, 0])


def _binned_cramer_von_mises(b: _Binned) -> Floats:
    """Weigh by the bins (Choulakian, Lockhart and Stephens 1994, doi:10.2307/3315828)."""
    return np.asarray(np.vecdot(b.excess**2, b.expected) / b.n[:, 0] ** 2)


def _binned_anderson_darling(b: _Binned) -> Floats:
    """Weigh by the bins and the inverse variance of F (Choulakian, Lockhart and Stephens 1994)."""
    below = np.cumsum(b.expected, axis=-1) / b.n
    variance = below * (1 - below)
    # Beyond the first and the last bin that expect a sample, both are 0 but for rounding.
    weight = np.where(variance > 1e-12, b.expected / np.maximum(variance, 1e-12), 0)
    return np.asarray(np.vecdot(b.excess**2, weight) / b.n[:, 0] ** 2)


def _binned_chi_square(b: _Binned) -> Floats:
    """Merge bins from the left until a cell expects 5 samples, the rest into the last cell."""
    square, cells = np.zeros(len(b.n)), np.zeros(len(b.n), dtype=np.int64)
    counts, expected = np.zeros(len(b.n)), np.zeros(len(b.n))
    left = b.expected.sum(axis=-1) - np.cumsum(b.expected, axis=-1).T
    for count, mean, rest in zip(b.counts.T, b.expected.T, left, strict=True):
        counts, expected = counts + count, expected + mean
        # What is left must fill a cell, too.
        full = (expected >= _EXPECTED) & (rest >= _EXPECTED)
        square += np.where(full, (counts - expected) ** 2 / np.maximum(expected, _EXPECTED), 0)
        cells += full
        counts, expected = np.where(full, 0, counts), np.where(full, 0, expected)
    square += (counts - expected) ** 2 / np.maximum(expected, _LEAST)
    return np.where(cells + 1 >= b.parameters + 2, square, np.nan)


DISTANCES: dict[FitTest, tuple[Callable[[_Ranked], Floats], Callable[[_Binned], Floats]]] = {
    "kolmogorov-smirnov": (_kolmogorov_smirnov, _binned_kolmogorov_smirnov),
    "cramer-von-mises": (_cramer_von_mises, _binned_cramer_von_mises),
    "anderson-darling": (_anderson_darling, _binned_anderson_darling),
    "chi-square": (_chi_square, _binned_chi_square),
}
"""Statistics of rows of samples and of rows of bins, shape (row,), by the name of the test."""


_CHUNK = 2**18
"""Samples or bins worked on at once: fits of many rows cost less for each."""
_SAME = 1e-9
"""Relative difference below which two statistics are the same, but for rounding."""


def bootstrap(
    part: Part,
    usable: Mask,
    family: Family,
    parameters: Parameters,
    tests: Sequence[FitTest],
    resamples: int,
    seed: int,
) -> Floats:
    """Return statistics, p-values and replicates that could be fitted, shape (3, row, test).

    Rows are those of the flattened batch; what is not usable is NaN. P-values are NaN where fewer
    than half of the replicates could be fitted.
    """
    table = np.full((3, part.n.size, len(tests)), np.nan)
    statistic, p_value, fitted = table
    rows = np.flatnonzero(usable)
    # Rows of as many samples go together: a block is as wide as its rows need.
    rows = rows[np.argsort(part.n.ravel()[rows], kind="stable")]
    width = (part.counts if isinstance(part, PositiveHistogram) else part.x).shape[-1]
    for block in spans(len(rows), max(1, _CHUNK // width // max(1, resamples))):
        here = rows[block]
        some = take_part(part, here)
        known = take(parameters, here)
        statistic[here] = _distances(some, family, known, tests)
        if not resamples:
            continue
        more, count = _replicates(some, family, known, statistic[here], tests, resamples, seed)
        fitted[here] = count
        # Davison and Hinkley (1997), equation 4.11.
        known_enough = (count > 0) & (2 * count >= resamples)
        p_value[here] = np.where(known_enough, (more + 1) / (count + 1), np.nan)
    return table


def _replicates(
    part: Part,
    family: Family,
    parameters: Parameters,
    statistic: Floats,
    tests: Sequence[FitTest],
    resamples: int,
    seed: int,
) -> tuple[Floats, Floats]:
    """Count replicates at least as far from their fit as the samples, and all that could be fit."""
    if isinstance(part, PositiveHistogram):
        held = list(part.counts)
    else:
        held = [row[:n].astype(np.float64) for row, n in zip(part.sorted, part.n, strict=True)]
    # Of the seed and of the row's samples, whatever their order; never the generator of the seed
    # alone, of which the samples may be draws.
    streams = [np.random.default_rng([seed, zlib.crc32(row.tobytes())]) for row in held]
    more, count = np.zeros(statistic.shape), np.zeros(statistic.shape)
    least = statistic[:, np.newaxis] * (1 - _SAME)
    width = (part.counts if isinstance(part, PositiveHistogram) else part.x).shape[-1]
    for piece in spans(resamples, max(1, _CHUNK // width // len(part.n))):
        times = min(piece.stop, resamples) - piece.start
        repeated = {name: np.repeat(value, times) for name, value in parameters.items()}
        # Where the sum of the samples is close to overflow, that of a replicate may: no fit.
        with np.errstate(all="ignore"):
            drawn = _draw(part, family, parameters, times, streams)
            estimate, _ = estimate_part(drawn, family, repeated)
        found = _distances(drawn, family, estimate.parameters, tests)
        found = found.reshape(len(part.n), times, len(tests))
        more += np.count_nonzero(found >= least, axis=1)
        count += np.count_nonzero(np.isfinite(found) & np.isfinite(least), axis=1)
    return more, count


def _draw(
    part: Part,
    family: Family,
    parameters: Parameters,
    times: int,
    streams: Sequence[np.random.Generator],
) -> Part:
    """Draw as many samples from the family as a row has, so many times, one row after the other."""
    if isinstance(part, PositiveHistogram):
        probability = _bin_probabilities(part, family, parameters)
        total = np.maximum(probability.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
        rows = zip(streams, part.n, probability / total, strict=True)
        counts = [rng.multinomial(n, row, size=times) for rng, n, row in rows]
        drawn_counts = np.concatenate(counts).astype(np.float64)
        none = np.zeros(len(drawn_counts), dtype=np.int64)
        return PositiveHistogram(
            counts=drawn_counts,
            log_centers=np.repeat(part.log_centers, times, axis=0),
            width=np.repeat(part.width, times),
            n=drawn_counts.sum(axis=-1).astype(np.int64),
            **dict.fromkeys(("n_null", "n_zero", "n_negative", "n_bad"), none),
        )
    drawn = np.ones((len(part.n), times, int(part.n.max())))
    for i, (rng, n) in enumerate(zip(streams, part.n, strict=True)):
        distribution = family.distribution({name: value[i] for name, value in parameters.items()})
        drawn[i, :, :n] = distribution.rvs(size=(times, n), random_state=rng)
    bad = np.arange(drawn.shape[-1]) >= np.repeat(part.n, times)[:, np.newaxis]
    return PositivePart.of(drawn.reshape(-1, drawn.shape[-1]), bad=bad)


def mixture_family(mixture: Mixture, k: int) -> tuple[Family, Parameters]:
    """Return mixtures of as many components as a family, for the bootstrap, and those given.

    Its parameters are those of each component, numbered: ``mu_1``, ``sigma_1``, ``weight_1``, ...
    """
    base = get_family(mixture.family)
    names = (*base.units, "weight")

    def components(parameters: Parameters) -> list[dict[str, Floats]]:
        return [{name: parameters[f"{name}_{i}"] for name in names} for i in range(1, k + 1)]

    def estimate(part: Part, _near: Parameters | None) -> Estimate:
        found = mixture_of_part(part, k, family=mixture.family)
        errors = _numbered(found.standard_errors, k)
        return Estimate(_of_components(found, k), errors, found.converged)

    def log_density(points: WeightedSamples, parameters: Parameters) -> Floats:
        densities = [
            base.log_density(points, one) + np.log(one["weight"])[:, np.newaxis]
            for one in components(parameters)
        ]
        return np.asarray(np.logaddexp.reduce(densities))

    def distribution(parameters: Parameters) -> _MixtureDistribution:
        each = components(parameters)
        return _MixtureDistribution(
            [one["weight"] for one in each], [base.distribution(one) for one in each]
        )

    family = Family(
        name=mixture.name,
        label=f"mixture of {base.label}",
        documentation=None,
        units={f"{name}_{i}": base.units.get(name, "1") for i in range(1, k + 1) for name in names},
        estimate=estimate,
        log_likelihood=summed(log_density),
        log_density=log_density,
        distribution=distribution,
    )
    return family, _of_components(mixture, k)


def _of_components(mixture: Mixture, k: int) -> dict[str, Floats]:
    return _numbered({**mixture.parameters, "weight": mixture.weights}, k)


def _numbered(values: Parameters, k: int) -> dict[str, Floats]:
    return {f"{name}_{i + 1}": v[..., i] for i in range(k) for name, v in values.items()}


@dataclass(frozen=True)
class _MixtureDistribution:
    """Distribution of a mixture: what the bootstrap needs of SciPy's."""

    weights: Sequence[Floats]
    components: Sequence[Any]

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        return np.asarray(sum(w * c.cdf(x) for w, c in self._each()))

    def sf(self, x: Floats) -> Floats:
        """Return P(X > x)."""
        return np.asarray(sum(w * c.sf(x) for w, c in self._each()))

    def rvs(self, size: tuple[int, ...], random_state: np.random.Generator) -> Floats:
        """Draw samples."""
        # A sample is of the component in whose share of (0, 1) its number lies.
        number, drawn, below = random_state.random(size), np.zeros(size), np.zeros(1)
        for weight, component in self._each():
            values = component.rvs(size=size, random_state=random_state)
            drawn, below = np.where(number >= below, values, drawn), below + weight
        return drawn

    def _each(self) -> Iterator[tuple[Floats, Any]]:
        return zip(self.weights, self.components, strict=True)
