"""Pixel statistics: the scores that the rules of the patterns compare with thresholds.

A firefly must not decide what the rest of a pixel looks like: where one sample carries too much of
the mean, tail, modes and families are measured without it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from chdstat._core.arrays import Floats, Mask
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError
from chdstat.fit.selection import FamilySelection, Selection
from chdstat.fit.tail import Tail, TailIndex, effective_tail_index
from chdstat.inference.modes import Modality, Modes

__all__ = ["PixelStatistics", "Thresholds", "firefly_limit", "gather"]

_POINTS = 32
"""Quantiles at which a family is compared with the samples: at 512, the distance is 1/64 off."""
_BODIES = ("gamma", "lognormal")
_TOP = 0.1
"""Share of the samples whose excesses define the tail index of a body."""


@dataclass(frozen=True)
class Thresholds:
    """When a pattern counts as one.

    Attributes
    ----------
    alpha
        False discovery rate of every tested flag over an image; level of the test of one pixel.
    null_share
        A pixel is null-heavy where more than this share of its samples is null.
    tail_index
        A tail is long where its index is at least this, and significantly above 0.
    ashman_d
        Neighbouring modes count as two from this separation on.
    firefly_share, firefly_samples
        A sample is a firefly where it carries more than this share of the sum of all, and more than
        this many average samples do.
    misfit
        A family describes a pixel where Kolmogorov's distance to the samples is at most this, or no
        larger than chance makes it in 95 % of all cases.
    constant
        A pixel is constant where the standard deviation of the natural logarithm of its luminance
        is at most this: float32 leaves 1e-7 for each of the products along a path.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    alpha: float = 0.05
    null_share: float = 0.5
    tail_index: float = 0.2
    ashman_d: float = 2.0
    firefly_share: float = 0.1
    firefly_samples: float = 8.0
    misfit: float = 0.05
    constant: float = 1e-4

    def __post_init__(self) -> None:
        shares = (self.alpha, self.null_share, self.firefly_share)
        others = self.tail_index, self.ashman_d, self.firefly_samples, self.misfit, self.constant
        if not all(0 < share < 1 for share in shares) or not all(v >= 0 for v in others):
            message = (
                "thresholds need alpha, null_share and firefly_share in (0, 1), and tail_index, "
                f"ashman_d, firefly_samples, misfit and constant >= 0; got {self}"
            )
            raise InputError(message)


@dataclass(frozen=True)
class PixelStatistics:
    """Scores per pixel; arrays of the batch's shape, NaN where there is nothing to measure.

    Attributes
    ----------
    part
        All positive samples.
    largest_share
        Share of the sum that the largest sample carries.
    tail, modes
        Without a sample that dominates, as all that follows.
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

    part: PositivePart
    largest_share: Floats
    tail: Tail
    modes: Modality
    vuong_z: Floats
    family: npt.NDArray[np.int8]
    misfit: Floats
    body_index: Floats
    body_index_se: Floats

    @cached_property
    def widest(self) -> tuple[Floats, Floats]:
        """Separations of neighbouring modes, shape (..., 2), widest first, and standard errors."""
        d, error = self.modes.ashman_d, self.modes.ashman_d_se
        order = np.argsort(-np.nan_to_num(d), axis=-1)
        return np.take_along_axis(d, order, axis=-1), np.take_along_axis(error, order, axis=-1)


def gather(part: PositivePart, thresholds: Thresholds) -> PixelStatistics:
    """Measure every pixel, without a sample that dominates it but for the share of that one."""
    found = _measure(part)
    rows = np.asarray(found.largest_share > firefly_limit(part.n, thresholds))
    if not rows.any():
        return found
    rest = _measure(_without_largest(part, rows))
    names = {f.name for f in fields(found)} - {"part", "largest_share"}
    return replace(found, **{n: _put(getattr(found, n), getattr(rest, n), rows) for n in names})


def _put(found: Any, rest: Any, rows: Mask) -> Any:
    """Return a result, an array or a dataclass of them, with that of the `rest` in some rows."""
    if is_dataclass(found) and not isinstance(found, type):
        names = [f.name for f in fields(found)]
        return replace(found, **{n: _put(getattr(found, n), getattr(rest, n), rows) for n in names})
    if not isinstance(found, np.ndarray | np.generic):
        return found
    values = np.array(found)
    values[rows] = rest
    return values


def firefly_limit(n: npt.NDArray[np.int64], thresholds: Thresholds) -> Floats:
    """Return the share of the sum above which a sample is a firefly."""
    return np.maximum(thresholds.firefly_share, thresholds.firefly_samples / np.maximum(n, 1))


def _without_largest(part: PositivePart, rows: Mask) -> PositivePart:
    """Return some rows of a part, shape (row, sample), each without its largest sample."""
    x, positive = part.x[rows], part.positive[rows].copy()
    largest = np.where(positive, x, -np.inf).argmax(axis=-1)
    positive[np.arange(len(x)), largest] = False
    others = part.n_null, part.n_zero, part.n_negative, part.n_bad
    return PositivePart(x, positive, part.n[rows] - 1, *(count[rows] for count in others))


def _measure(part: PositivePart) -> PixelStatistics:
    families = part.measured(FamilySelection())
    body_index, body_index_se = _body_index(families)
    return PixelStatistics(
        part=part,
        largest_share=part.largest_share,
        tail=part.measured(TailIndex()),
        modes=part.measured(Modes()),
        vuong_z=families.vuong_z,
        family=families.best,
        misfit=_misfit(part, families),
        body_index=body_index,
        body_index_se=body_index_se,
    )


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
    indices = effective_tail_index(stats.gamma(np.exp(log_shapes)), _TOP)
    return log_shapes, indices, np.gradient(indices, log_shapes)
