"""Pixel statistics: the scores that the rules of the patterns compare with thresholds.

A firefly must not decide what the rest of a pixel looks like: where one sample carries too much of
the mean, tail, modes and families are measured without it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.positive import Floats, Mask, PositivePart
from chdstat.fit.families import FAMILIES, SELECTED
from chdstat.fit.selection import Selection, select_part
from chdstat.fit.tail import Tail, tail_of_part
from chdstat.inference.modes import Modality, modality_of_part

__all__ = ["PixelStatistics", "firefly_limit", "gather", "without_largest"]

_POINTS = 32
"""Quantiles at which a family is compared with the samples: at 512, the distance is 1/64 off."""
_BODIES = ("gamma", "lognormal")
_TOP = 0.1
"""Share of the samples whose excesses define the tail index of a body."""


@dataclass(frozen=True)
class PixelStatistics:
    """Scores per pixel; arrays of the batch's shape, NaN where there is nothing to measure.

    Attributes
    ----------
    n, n_good, n_null
        Positive, good and null samples.
    constant
        Whether the positive samples are equal.
    spread
        Standard deviation of the natural logarithm of the positive samples.
    largest_share
        Share of the sum that the largest sample carries.
    tail_index, tail_index_se, tail_interval, tail_p_value
        Generalised Pareto tail index, its standard error, its interval, shape (..., 2), and the
        one-sided p-value of a tail no heavier than that of a gamma distribution.
    variance_unidentified
        Where the samples do not identify whether their variance is finite.
    modes
        Modes of the log density; 0 where they could not be counted.
    ashman_d, ashman_d_se
        Separation of neighbouring modes, shape (..., 2), the widest first; and its standard error.
    dip, dip_p_value
        Of unimodality.
    vuong_z
        Gamma against log-normal, positive for gamma.
    family
        Index of the best family in `chdstat.fit.families.SELECTED`, -1 for none.
    misfit
        Kolmogorov's distance between the samples and the better of the two.
    body_index, body_index_se
        Tail index that excesses over the quantile 0.9 of the better of the two would show (its
        penultimate one: Smith 1987, doi:10.1214/aos/1176350499), and its standard error.
    """

    n: npt.NDArray[np.int64]
    n_good: npt.NDArray[np.int64]
    n_null: npt.NDArray[np.int64]
    constant: Mask
    spread: Floats
    largest_share: Floats
    tail_index: Floats
    tail_index_se: Floats
    tail_interval: Floats
    tail_p_value: Floats
    variance_unidentified: Mask
    modes: npt.NDArray[np.int8]
    ashman_d: Floats
    ashman_d_se: Floats
    dip: Floats
    dip_p_value: Floats
    vuong_z: Floats
    family: npt.NDArray[np.int8]
    misfit: Floats
    body_index: Floats
    body_index_se: Floats


def gather(
    part: PositivePart,
    *,
    firefly_share: float,
    firefly_samples: float,
    tail: Tail | None = None,
    modes: Modality | None = None,
    families: Selection | None = None,
) -> PixelStatistics:
    """Measure every pixel; results for the same part that are already there are not repeated."""
    found = _measure(part, tail, modes, families)
    limit = firefly_limit(part.n, firefly_share, firefly_samples)
    rows = np.asarray(found.largest_share > limit)
    if not rows.any():
        return found
    rest = without_largest(part, rows)
    return _replace_shape(found, _measure(rest, None, None, None), rows)


def firefly_limit(n: npt.NDArray[np.int64], share: float, samples: float) -> Floats:
    """Return the share of the sum above which a sample is a firefly: that of `samples` at least."""
    return np.maximum(share, samples / np.maximum(n, 1))


def without_largest(part: PositivePart, rows: Mask) -> PositivePart:
    """Return some rows of a part, shape (row, sample), each without its largest sample."""
    x, positive = part.x[rows], part.positive[rows].copy()
    largest = np.where(positive, x, -np.inf).argmax(axis=-1)
    positive[np.arange(len(x)), largest] = False
    others = part.n_null, part.n_zero, part.n_negative, part.n_bad
    return PositivePart(x, positive, part.n[rows] - 1, *(count[rows] for count in others))


def _measure(
    part: PositivePart,
    tail: Tail | None,
    modes: Modality | None,
    families: Selection | None,
) -> PixelStatistics:
    tail = tail or tail_of_part(part)
    families = families or select_part(part, [FAMILIES[name] for name in SELECTED])
    if modes is None:
        modes = modality_of_part(part, fits=families.fits.values())
    widest = np.argsort(-np.nan_to_num(modes.ashman_d), axis=-1)
    statistics = part.log_statistics
    body_index, body_index_se = _body_index(families)
    return PixelStatistics(
        n=part.n,
        n_good=part.n_good,
        n_null=part.n_null,
        constant=statistics.constant,
        spread=np.asarray(np.sqrt(statistics.log_variance)),
        largest_share=_largest_share(part),
        tail_index=tail.xi,
        tail_index_se=np.asarray(tail.standard_error),
        tail_interval=tail.interval,
        tail_p_value=tail.p_exponential,
        variance_unidentified=tail.variance_unidentified,
        modes=modes.modes,
        ashman_d=np.take_along_axis(modes.ashman_d, widest, axis=-1),
        ashman_d_se=np.take_along_axis(modes.ashman_d_se, widest, axis=-1),
        dip=modes.dip,
        dip_p_value=modes.dip_p_value,
        vuong_z=families.vuong_z,
        family=families.best,
        misfit=_misfit(part, families),
        body_index=body_index,
        body_index_se=body_index_se,
    )


def _replace_shape(found: PixelStatistics, rest: PixelStatistics, rows: Mask) -> PixelStatistics:
    """Take what describes the shape from `rest`, in its rows; counts and the firefly stay."""
    kept = {"n", "n_good", "n_null", "constant", "spread", "largest_share"}
    values = {field.name: getattr(found, field.name) for field in fields(PixelStatistics)}
    for name in values.keys() - kept:
        values[name] = np.array(values[name])
        values[name][rows] = getattr(rest, name)
    return PixelStatistics(**values)


def _largest_share(part: PositivePart) -> Floats:
    last = np.maximum(part.n - 1, 0)[..., np.newaxis]
    largest = np.take_along_axis(part.sorted, last, axis=-1)[..., 0].astype(np.float64)
    with np.errstate(invalid="ignore"):
        share = largest / part.log_statistics.mean / part.n
    return np.where(part.n > 0, share, np.nan)


def _misfit(part: PositivePart, families: Selection) -> Floats:
    """Return the largest distance of distribution functions, at some of the samples."""
    misfit, z = np.full(part.n.shape, np.nan), families.vuong_z
    gamma, lognormal = (families.fits[name].parameters for name in _BODIES)
    for rows, one in ((z > 0, "gamma"), (z <= 0, "lognormal")):
        n = part.n[rows][:, np.newaxis]
        rank = ((np.arange(_POINTS) + 0.5) / _POINTS * n).astype(np.intp)
        log = np.take_along_axis(part.log_sorted[rows], rank, axis=-1)
        if one == "gamma":
            shape, scale = (gamma[name][rows][:, np.newaxis] for name in ("shape", "scale"))
            cdf = special.gammainc(shape, np.exp(log - np.log(scale)))
        else:
            mu, sigma = (lognormal[name][rows][:, np.newaxis] for name in ("mu", "sigma"))
            cdf = special.ndtr((log - mu) / sigma)
        misfit[rows] = np.maximum(cdf - rank / n, (rank + 1) / n - cdf).max(axis=-1)
    return misfit


def _body_index(families: Selection) -> tuple[Floats, Floats]:
    """Return the penultimate tail index of the better family, and its standard error.

    ``-1 - (1 - F) f' / f^2`` at the quantile 0.9 depends on the shape alone, so that the error
    follows from that of the shape (delta method).
    """
    gamma, lognormal = (families.fits[name] for name in _BODIES)
    is_gamma = families.vuong_z > 0
    index, error = np.full(is_gamma.shape, np.nan), np.full(is_gamma.shape, np.nan)
    shape = gamma.parameters["shape"][is_gamma]
    log_shapes, indices, slopes = _gamma_table()
    index[is_gamma] = np.interp(np.log(shape), log_shapes, indices)
    slope = np.interp(np.log(shape), log_shapes, slopes) / shape
    error[is_gamma] = np.abs(slope) * gamma.standard_errors["shape"][is_gamma]
    # Of a log-normal: z M - 1 + sigma M, with M the ratio of Mills at the Gaussian quantile z.
    z = special.ndtri(1 - _TOP)
    mills = _TOP * np.sqrt(2 * np.pi) * np.exp(z**2 / 2)
    other = ~is_gamma
    index[other] = z * mills - 1 + mills * lognormal.parameters["sigma"][other]
    error[other] = mills * lognormal.standard_errors["sigma"][other]
    return index, error


@cache
def _gamma_table() -> tuple[Floats, Floats, Floats]:
    """Return log shapes, the index of gamma distributions, and its slope over the log shape.

    The quantile of a gamma distribution costs as much as a whole fit; between the points, the index
    is right to 1e-4.
    """
    log_shapes = np.linspace(np.log(0.02), np.log(1e4), 800)
    indices = _gamma_index(np.exp(log_shapes))
    return log_shapes, indices, np.gradient(indices, log_shapes)


def _gamma_index(shape: Floats) -> Floats:
    x = special.gammaincinv(shape, 1 - _TOP)
    log_density = (shape - 1) * np.log(x) - x - special.gammaln(shape)
    return np.asarray(-1 - _TOP * ((shape - 1) / x - 1) * np.exp(-log_density))
