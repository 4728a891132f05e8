"""Bootstrap: distances from a fitted family, and those of samples drawn from it and fitted again.

The random numbers of a row are made of the seed and of the row's own samples, so that its p-value
does not depend on which rows are tested with it. The replicates of several rows are fitted at once.
"""

from __future__ import annotations

import zlib
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
    seed: int,
) -> tuple[Floats, Floats, Floats]:
    """Return statistics, p-values and replicates that could be fitted, each of shape (row, test).

    Rows are those of the flattened batch; what is not usable is NaN, NaN and 0. P-values are NaN
    where fewer than half of the replicates could be fitted.
    """
    shape = (part.n.size, len(tests))
    statistic, p_value, fitted = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape)
    rows = np.flatnonzero(usable)
    # Rows of as many samples go together: a block is as wide as its rows need.
    rows = rows[np.argsort(part.n.ravel()[rows], kind="stable")]
    width = (part.counts if isinstance(part, BinnedPart) else part.x).shape[-1]
    for block in spans(len(rows), max(1, _CHUNK // width // max(1, resamples))):
        here = rows[block]
        some = _take(part, here)
        known = {name: value.ravel()[here] for name, value in parameters.items()}
        statistic[here] = _distances(some, family, known, tests)
        streams = _streams(some, seed) if resamples else []
        more, count = _replicates(some, family, known, statistic[here], tests, resamples, streams)
        fitted[here] = count
        # Davison and Hinkley (1997), equation 4.11.
        known_enough = (count > 0) & (2 * count >= resamples)
        p_value[here] = np.where(known_enough, (more + 1) / (count + 1), np.nan)
    return statistic, p_value, fitted


def _streams(part: Part, seed: int) -> list[np.random.Generator]:
    """Return a generator for each row, of the seed and of the row's samples, whatever their order.

    It is never that of `numpy.random.default_rng(seed)`, of which the samples may be draws.
    """
    held = (
        part.counts
        if isinstance(part, BinnedPart)
        else [row[:n].astype(np.float64) for row, n in zip(part.sorted, part.n, strict=True)]
    )
    return [np.random.default_rng([seed, zlib.crc32(row.tobytes())]) for row in held]


def _replicates(
    part: Part,
    family: Family,
    parameters: Parameters,
    statistic: Floats,
    tests: Sequence[FitTest],
    resamples: int,
    streams: Sequence[np.random.Generator],
) -> tuple[Floats, Floats]:
    """Count replicates at least as far from their fit as the samples, and all that could be fit."""
    more, count = np.zeros(statistic.shape), np.zeros(statistic.shape)
    least = statistic[:, np.newaxis] * (1 - _SAME)
    width = (part.counts if isinstance(part, BinnedPart) else part.x).shape[-1]
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
    part: Part,
    family: Family,
    parameters: Parameters,
    times: int,
    streams: Sequence[np.random.Generator],
) -> PositivePart | BinnedPart:
    """Draw as many samples from the family as a row has, so many times, one row after the other."""
    if isinstance(part, BinnedPart):
        probability = bin_probabilities(part, family, parameters)
        total = np.maximum(probability.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
        rows = zip(streams, part.n, probability / total, strict=True)
        counts = [rng.multinomial(n, row, size=times) for rng, n, row in rows]
        return _with_counts(part, np.concatenate(counts).astype(np.float64), times)
    drawn = np.ones((len(part.n), times, int(part.n.max())))
    for i, (rng, n) in enumerate(zip(streams, part.n, strict=True)):
        distribution = family.distribution({name: value[i] for name, value in parameters.items()})
        drawn[i, :, :n] = distribution.rvs(size=(times, n), random_state=rng)
    bad = np.arange(drawn.shape[-1]) >= np.repeat(part.n, times)[:, np.newaxis]
    return PositivePart.of(drawn.reshape(-1, drawn.shape[-1]), bad=bad)


def _with_counts(part: BinnedPart, counts: Floats, times: int) -> BinnedPart:
    none = np.zeros(len(counts), dtype=np.int64)
    one = len(part.log_centers) == 1
    return BinnedPart(
        counts=counts,
        log_centers=part.log_centers if one else np.repeat(part.log_centers, times, axis=0),
        width=part.width if len(part.width) == 1 else np.repeat(part.width, times),
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
