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

from chdstat._core.arrays import spans
from chdstat._core.positive import Floats, Mask, PositivePart
from chdstat.errors import InputError, Reason
from chdstat.fit.families import Family, Parameters, get_family
from chdstat.fit.family import take
from chdstat.fit.mle import estimate_part
from chdstat.fit.results import Fit
from chdstat.fit.weighted_samples import Halves, blocks
from chdstat.summary.dispatch import Part, PositiveHistogram

__all__ = ["HeldOut", "held_out_of_part", "ranked", "vuong"]

_CHUNK = 2**18
"""Samples of the rows worked on at once."""


@dataclass(frozen=True)
class HeldOut:
    """Families compared by the likelihood of samples that they were not fitted to.

    Attributes
    ----------
    loss
        Minus the log-likelihood per positive sample, in nats and for linear radiance, shape
        (..., family); the smaller the better, NaN where the family could not be fitted to all
        samples and to each of the halves, infinite where it is bounded and a sample of the other
        half lies beyond.
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

    @property
    def decided(self) -> Mask:
        """Whether the margin is above two standard errors, shape (...): else it is a draw."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.margin > 2 * self.margin_se)


def held_out_of_part(part: Part, families: Sequence[Family], near: Sequence[Parameters]) -> HeldOut:
    """Fit the even samples and score the odd ones, in stored order, and the other way round.

    `near` holds the parameters of each family for all samples, NaN where it has none: where the
    search of the halves' begins. It ends at Newton steps of 1 %, which leave about 1e-4 of the
    parameters and less than a hundredth of the margin's standard error (99.9 % of the pixels of a
    render).

    Raises
    ------
    InputError
        If the part is a histogram, which has lost the samples' order.
    """
    if isinstance(part, PositiveHistogram):
        message = "held-out likelihood needs samples: a histogram cannot be split, got a Histogram"
        raise InputError(message)
    size, count = part.n.size, len(families)
    loss, best = np.full((size, count), np.nan), np.full(size, -1, dtype=np.int8)
    margins = np.full((2, size), np.nan)
    n = part.n.reshape(-1)
    # Rows with similar numbers of samples, so that those of a piece fill it.
    order = np.argsort(n, kind="stable")[np.count_nonzero(n == 0) :]
    flat = [{name: values.reshape(-1) for name, values in at.items()} for at in near]
    for span in spans(len(order), max(1, _CHUNK // part.x.shape[-1])):
        rows = order[span]
        twice = np.concatenate([rows, rows])
        begin = [{name: values[twice] for name, values in at.items()} for at in flat]
        loss[rows], best[rows], margins[:, rows] = _compare(_halves(part, rows), families, begin)
    loss += part.log_statistics.log_mean.reshape(-1, 1)
    shape = part.n.shape
    return HeldOut(
        loss=loss.reshape(*shape, count),
        best=best.reshape(shape),
        margin=margins[0].reshape(shape),
        margin_se=margins[1].reshape(shape),
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


def vuong(part: Part, one: Fit, other: Fit) -> tuple[Floats, Floats]:
    """Return Vuong's z of one family against another, and its two-sided p-value, shape (...).

    ``z = sum(m) / (sd(m) sqrt(n))`` with m the difference of the log densities, sample by sample:
    normal where two families, neither of which contains the other, are equally far from the truth.

    References
    ----------
    Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses", 1989,
    doi:10.2307/1912557.
    """
    z = np.full(part.n.size, np.nan)
    usable = (one.reason == Reason.OK) & (other.reason == Reason.OK)
    for points in blocks(part, usable):
        density, subtracted = (
            get_family(fit.family).log_density(points, take(fit.parameters, points))
            for fit in (one, other)
        )
        difference = density - subtracted
        mean = points.average(difference)
        difference -= mean[:, np.newaxis]
        difference *= difference
        with np.errstate(invalid="ignore", divide="ignore"):
            z[points.rows] = mean * np.sqrt(points.n / points.average(difference))
    p_value = np.asarray(2 * special.ndtr(-np.abs(z)))
    return z.reshape(part.n.shape), p_value.reshape(part.n.shape)


def _halves(part: PositivePart, rows: npt.NDArray[np.intp]) -> Halves:
    """Return the even samples of some rows, in stored order, and below them the odd ones."""
    samples = part.x.shape[-1]
    x, positive = (values.reshape(-1, samples)[rows] for values in (part.x, part.positive))
    parity = [slice(first, None, 2) for first in (0, 1)]
    n = [np.count_nonzero(positive[:, half], axis=-1) for half in parity]
    packed = np.zeros((2, len(rows), max(1, int(np.max(n)))))
    columns = np.arange(packed.shape[-1])
    for to, half, count in zip(packed, parity, n, strict=True):
        # Positions cost a fifth of what masks do, where nulls and others alternate at random.
        place = np.flatnonzero(columns < count[:, np.newaxis])
        to.reshape(-1)[place] = x[:, half].reshape(-1)[np.flatnonzero(positive[:, half])]
    return Halves.of_samples(packed.reshape(-1, packed.shape[-1]), np.concatenate(n))


def _compare(
    halves: Halves, families: Sequence[Family], near: Sequence[Parameters]
) -> tuple[Floats, npt.NDArray[np.int8], Floats]:
    """Return the losses less the log mean, the best, and its margin over its standard error."""
    # Log densities of log x under the fit to the other half, 0 where there is no sample.
    points, twice = halves.points, halves.n.size
    density = np.empty((len(families), *points.log.shape))
    for to, family, at in zip(density, families, near, strict=True):
        fitted = estimate_part(halves, family, at)[0].parameters
        swapped = {name: np.roll(values, twice // 2) for name, values in fitted.items()}
        to[:] = family.log_density(points, take(swapped, points))
    np.copyto(density, 0, where=points.weight == 0)
    rows, n = halves.n.size // 2, halves.n.reshape(2, -1).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        loss = -density.sum(axis=-1).reshape(-1, 2, rows).sum(axis=1).T / n[:, np.newaxis]
        order, best, margin = ranked(loss)
        first, second = (np.tile(order[:, i], 2) for i in (0, min(1, len(families) - 1)))
        every = np.arange(2 * rows)
        difference = density[first, every] - density[second, every]
        square = np.vecdot(difference, difference).reshape(2, -1).sum(axis=0) / n - margin**2
        error = np.sqrt(np.maximum(square, 0) / (n - 1))
    return loss, best, np.stack([margin, np.where(np.isfinite(margin), error, np.nan)])
