"""Bootstrap: distances from a fitted family, and those of samples drawn from it and fitted again.

All rows of a block take part in each replicate. Rows differ in their number of samples, and so do
their replicates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat._binned import BinnedPart
from chdstat._positive import Floats, Mask, PositivePart
from chdstat._routes import Part
from chdstat.fit._distances import (
    FitTest,
    bin_probabilities,
    distances_of_bins,
    distances_of_samples,
)
from chdstat.fit._family import Family, Parameters
from chdstat.fit.mle import estimate_part

__all__ = ["bootstrap"]

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
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Floats]:
    """Return statistics, p-values and replicates that could be fitted, each of shape (row, test).

    Rows are those of the flattened batch; what is not usable is NaN, NaN and 0.
    """
    shape = (part.n.size, len(tests))
    statistic, p_value, fitted = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape)
    rows = np.flatnonzero(usable)
    # Rows of as many samples go together: a block is as wide as its rows need.
    rows = rows[np.argsort(part.n.ravel()[rows], kind="stable")]
    width = (part.counts if isinstance(part, BinnedPart) else part.x).shape[-1]
    for block in spans(len(rows), max(1, _CHUNK // width)):
        here = rows[block]
        some = _take(part, here)
        known = {name: value.ravel()[here] for name, value in parameters.items()}
        statistic[here] = _distances(some, family, known, tests)
        more, count = _replicates(some, family, known, statistic[here], tests, resamples, rng)
        fitted[here] = count
        # Davison and Hinkley (1997), equation 4.11.
        p_value[here] = np.where(count > 0, (more + 1) / (count + 1), np.nan)
    return statistic, p_value, fitted


def _replicates(
    part: Part,
    family: Family,
    parameters: Parameters,
    statistic: Floats,
    tests: Sequence[FitTest],
    resamples: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Count replicates at least as far from their fit as the samples, and all that could be fit."""
    more, count = np.zeros(statistic.shape), np.zeros(statistic.shape)
    least = statistic * (1 - _SAME)
    for _ in range(resamples):
        # Where the sum of the samples is close to overflow, that of a replicate may: no fit.
        with np.errstate(all="ignore"):
            drawn = _draw(part, family, parameters, rng)
            estimate, _ = estimate_part(drawn, family, parameters)
        found = _distances(drawn, family, estimate.parameters, tests)
        more += found >= least
        count += np.isfinite(found) & np.isfinite(least)
    return more, count


def _distances(
    part: Part, family: Family, parameters: Parameters, tests: Sequence[FitTest]
) -> Floats:
    """Return statistics, shape (row, test); NaN in rows without parameters."""
    fitted = np.asarray(np.isfinite(np.stack(list(parameters.values()))).all(axis=0))
    distances = np.full((len(fitted), len(tests)), np.nan)
    rows = np.flatnonzero(fitted)
    if not len(rows):
        return distances
    some = part if len(rows) == len(fitted) else _take(part, rows)
    known = {name: value[rows] for name, value in parameters.items()}
    if isinstance(some, BinnedPart):
        distances[rows] = distances_of_bins(some, family, known, tests)
    else:
        distances[rows] = distances_of_samples(some, family, known, tests)
    return distances


def _draw(
    part: Part, family: Family, parameters: Parameters, rng: np.random.Generator
) -> PositivePart | BinnedPart:
    """Draw as many samples for each row from the family as it has."""
    if isinstance(part, BinnedPart):
        probability = bin_probabilities(part, family, parameters)
        total = np.maximum(probability.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
        counts = rng.multinomial(part.n, probability / total).astype(np.float64)
        return _with_counts(part, counts)
    columns = {name: value[:, np.newaxis] for name, value in parameters.items()}
    width = int(part.n.max())
    drawn = family.distribution(columns).rvs(size=(len(part.n), width), random_state=rng)
    return PositivePart.of(drawn, bad=np.arange(width) >= part.n[:, np.newaxis])


def _with_counts(part: BinnedPart, counts: Floats) -> BinnedPart:
    none = np.zeros_like(part.n)
    return BinnedPart(
        counts=counts,
        log_centers=part.log_centers,
        width=part.width,
        n=counts.sum(axis=-1).astype(np.int64),
        n_null=none,
        n_zero=none,
        n_negative=none,
        n_bad=none,
    )


def _take(part: Part, rows: npt.NDArray[np.intp]) -> PositivePart | BinnedPart:
    """Return some rows of the flattened batch."""
    others = {
        name: getattr(part, name).ravel()[rows]
        for name in ("n", "n_null", "n_zero", "n_negative", "n_bad")
    }
    if isinstance(part, BinnedPart):
        bins = part.counts.shape[-1]
        centers = part.log_centers.reshape(-1, bins)
        width = part.width.ravel()
        return BinnedPart(
            counts=part.counts.reshape(-1, bins)[rows],
            log_centers=centers if len(centers) == 1 else centers[rows],
            width=width if len(width) == 1 else width[rows],
            **others,
        )
    samples = part.x.shape[-1]
    x, positive = part.x.reshape(-1, samples), part.positive.reshape(-1, samples)
    return PositivePart(x=x[rows], positive=positive[rows], **others)
