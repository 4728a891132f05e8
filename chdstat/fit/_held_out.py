"""Held out: how likely families, fitted to half of the samples, make the other half.

Unlike an information criterion, the held-out likelihood needs no count of parameters and no belief
that one of the families is true; and its differences come with a standard error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._binned import BinnedPart
from chdstat._positive import Floats, PositivePart
from chdstat._reasons import Reason
from chdstat._routes import Part
from chdstat.errors import InputError
from chdstat.fit._family import Family, Parameters, take
from chdstat.fit._points import Points, blocks
from chdstat.fit.mle import estimate_part
from chdstat.fit.results import Fit

__all__ = ["HeldOut", "held_out_of_part", "ranked", "vuong"]


@dataclass(frozen=True)
class HeldOut:
    """Families compared by the likelihood of samples that they were not fitted to.

    Attributes
    ----------
    loss
        Minus the log-likelihood per positive sample, in nats and for linear radiance, shape
        (..., family); the smaller the better, NaN where the family could not be fitted to each of
        the halves, infinite where it is bounded and a sample of the other half lies beyond.
    best
        Index of the best family, shape (...); -1 where none could be fitted.
    margin, margin_se
        Loss of the runner-up minus that of the best, and its standard error from the differences
        sample by sample, shape (...); NaN with fewer than two fits.
    """

    loss: Floats
    best: npt.NDArray[np.int8]
    margin: Floats
    margin_se: Floats


def held_out_of_part(part: Part, families: Sequence[Family], near: Sequence[Parameters]) -> HeldOut:
    """Fit the even samples and score the odd ones, in stored order, and the other way round.

    `near` holds the parameters of each family for all samples: where the search of the halves'
    begins.

    Raises
    ------
    InputError
        If the part is a histogram, which has lost the samples' order.
    """
    if isinstance(part, BinnedPart):
        message = "held-out likelihood needs samples: a histogram cannot be split, got a Histogram"
        raise InputError(message)
    halves = [_half(part, 0), _half(part, 1)]
    fitted = [
        [estimate_part(half, f, at)[0].parameters for f, at in zip(families, near, strict=True)]
        for half in halves
    ]
    size, count = part.n.size, len(families)
    sums, products = np.zeros((size, count)), np.zeros((size, count, count))
    for half, parameters in zip(halves, reversed(fitted), strict=True):
        _score(half, families, parameters, sums, products)
    n = np.maximum(part.n, 1).reshape(-1)
    per_sample = sums / n[:, np.newaxis]
    log_mean = part.log_statistics.log_mean.reshape(-1, 1)
    order, best, margin = ranked(log_mean - per_sample)
    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = order[:, 0], order[:, min(1, count - 1)]
        row = np.arange(size)
        square = products[row, first, first] + products[row, second, second]
        square = (square - 2 * products[row, first, second]) / n - margin**2
        error = np.sqrt(np.maximum(square, 0) / (n - 1))
    shape = part.n.shape
    return HeldOut(
        loss=(log_mean - per_sample).reshape(*shape, count),
        best=best.reshape(shape),
        margin=margin.reshape(shape),
        margin_se=np.where(np.isfinite(margin), error, np.nan).reshape(shape),
    )


def ranked(values: Floats) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int8], Floats]:
    """Rank the families, best first, by the smallest value; return order, best and margin.

    `values` has shape (..., family), NaN where there is none; best is -1 where all are NaN.
    """
    order = np.argsort(values, axis=-1)
    ascending = np.take_along_axis(values, order[..., :2], axis=-1)
    with np.errstate(invalid="ignore"):
        margin = ascending[..., -1] - ascending[..., 0]
    if values.shape[-1] < 2:
        margin = margin * np.nan
    best = np.where(np.isnan(ascending[..., 0]), -1, order[..., 0]).astype(np.int8)
    return order, best, np.asarray(margin)


def vuong(part: Part, one: tuple[Family, Fit], other: tuple[Family, Fit]) -> tuple[Floats, Floats]:
    """Return Vuong's z of one family against another, and its two-sided p-value, shape (...).

    ``z = sum(m) / (sd(m) sqrt(n))`` with m the difference of the log densities, sample by sample:
    normal where two families, neither of which contains the other, are equally far from the truth.

    References
    ----------
    Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses", 1989,
    doi:10.2307/1912557.
    """
    z = np.full(part.n.size, np.nan)
    usable = (one[1].reason == Reason.OK) & (other[1].reason == Reason.OK)
    for points in blocks(part, usable):
        difference = _density(one[0], one[1].parameters, points)
        difference -= _density(other[0], other[1].parameters, points)
        mean = points.average(difference)
        difference -= mean[:, np.newaxis]
        difference *= difference
        with np.errstate(invalid="ignore", divide="ignore"):
            z[points.rows] = mean * np.sqrt(points.n / points.average(difference))
    p_value = np.asarray(2 * special.ndtr(-np.abs(z)))
    return z.reshape(part.n.shape), p_value.reshape(part.n.shape)


def _half(part: PositivePart, first: int) -> PositivePart:
    """Take every second sample; what is not positive counts as null, for no one looks at it."""
    one_of_two = (..., slice(first, None, 2))
    x = part.x[one_of_two]
    positive = part.positive[one_of_two]
    n = np.asarray(np.count_nonzero(positive, axis=-1), dtype=np.int64)
    none = np.zeros_like(n)
    return PositivePart(x, positive, n, n_null=x.shape[-1] - n, n_zero=none, n_bad=none)


def _score(
    half: PositivePart,
    families: Sequence[Family],
    parameters: Sequence[Parameters],
    sums: Floats,
    products: Floats,
) -> None:
    """Add the log densities of log x, and their products between families, of every row."""
    scored = half.n.reshape(-1) > 0
    for points in blocks(half, scored):
        density = np.stack(
            [_density(f, p, points) for f, p in zip(families, parameters, strict=True)], axis=1
        )
        with np.errstate(invalid="ignore"):
            density = np.where(points.weight[:, np.newaxis] > 0, density, 0)
            sums[points.rows] += density.sum(axis=-1)
            products[points.rows] += density @ density.swapaxes(-1, -2)
    sums[~scored] = np.nan


def _density(family: Family, parameters: Parameters, points: Points) -> Floats:
    return family.log_density(points, take(parameters, points))
