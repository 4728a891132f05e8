"""Tail: how heavy the largest samples of a CHD are.

`tail_index` fits a generalised Pareto distribution to the excesses over a high quantile. Its tail
index xi orders the tails: below 0 bounded, 0 exponential (gamma, too), above 1/4 the error of the
sample variance is itself without a variance, from 1/2 on the variance is infinite, and from 1 on
the mean is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat._reasons import Reason, flag_attributes
from chdstat.errors import InputError
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MINIMUM_EXCESSES", "Tail", "tail_index", "tail_of_part"]

MINIMUM_EXCESSES = 20
"""Fewer samples above the threshold give no tail index."""

_RADIANCE = "W sr-1 m-2"
_PRIOR_QUARTILE = 3.0
"""Zhang and Stephens' constant: how far their grid reaches beyond the largest excess."""
_LABELS = {
    "tail_index": ("generalised Pareto tail index xi", "1"),
    "tail_index_se": ("standard error of the tail index", "1"),
    "tail_p_value": ("p-value of a tail index at most the tested one", "1"),
    "tail_scale": ("generalised Pareto scale", _RADIANCE),
    "tail_threshold": ("radiance above which the tail begins", _RADIANCE),
    "tail_n": ("samples above the threshold", "1"),
    "tail_hill": ("Hill estimate of the tail index", "1"),
    "tail_hill_se": ("standard error of the Hill estimate", "1"),
    "tail_variance_suspect": ("xi >= 1/2: do not trust the sample variance", "1"),
}


@dataclass(frozen=True)
class Tail:
    """Tail of the positive part; all arrays of the batch's shape, NaN where `reason` says why.

    Attributes
    ----------
    xi, standard_error
        Tail index and its asymptotic standard error, ``(1 + xi) / sqrt(n)``.
    p_value
        One-sided: of the hypothesis that the tail index is at most `tested`.
    tested
        That index.
    scale, threshold
        Generalised Pareto scale, and radiance above which the tail begins.
    n
        Excesses that were used.
    hill, hill_standard_error
        Hill's estimate, for power laws only: it is positive for every tail.
    variance_suspect
        Where xi >= 1/2: the variance may be infinite, the sample variance is not to be trusted, nor
        is any error bar made of it.
    reason
        `Reason` codes.
    """

    xi: Floats
    standard_error: Floats
    p_value: Floats
    tested: float
    scale: Floats
    threshold: Floats
    n: Counts
    hill: Floats
    hill_standard_error: Floats
    variance_suspect: Mask
    reason: npt.NDArray[np.int8]


@overload
def tail_index(
    x: Samples, *, share: float = ..., tested: float = ..., progress: bool | None = None
) -> xr.Dataset: ...
@overload
def tail_index(
    x: npt.ArrayLike,
    *,
    share: float = ...,
    tested: float = ...,
    null: npt.ArrayLike | None = None,
) -> Tail: ...
def tail_index(
    x: Samples | npt.ArrayLike,
    *,
    share: float = 0.1,
    tested: float = 0.25,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Tail | xr.Dataset:
    """Estimate the tail index from the largest samples.

    The excesses over the quantile ``1 - share`` of the positive part follow, for a high threshold,
    the generalised Pareto distribution ``P(excess > y) = (1 + xi y / scale)^(-1/xi)``; its two
    parameters are estimated by the quasi-Bayesian average over the profile likelihood of Zhang and
    Stephens, which is close to maximum likelihood, needs no iteration and never fails to converge.

    An index at finite radiance is that of the range of the samples. A gamma tail gives about 0, as
    it should. A log-normal tail has index 0 too, but only far beyond the largest sample: where
    it was seen, at the 90 % quantile and above, it is that of a power law of index 0.2 to
    0.3 with sigma = 1 and about 0.5 with sigma = 1.5. So with ``tested=0.25``, a log-normal
    with sigma of 0.9 to 1.2 is in the zone of indifference.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    share
        Share of the positive samples that make the tail, in (0, 1).
    tested
        Tail index, at least 0, above which a tail counts as heavy.

    Returns
    -------
    Tail or xarray.Dataset
        `Tail` for an array; for `Samples`, its fields over (y, x, channel), with the prefix
        ``tail_``.

    Raises
    ------
    InputError
        If `share` or `tested` is out of range.

    References
    ----------
    Zhang and Stephens, "A new and efficient estimation method for the generalized Pareto
    distribution", 2009, doi:10.1198/tech.2009.08017. Hill, "A simple general approach to inference
    about the tail of a distribution", 1975, doi:10.1214/aos/1176343247.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> tail = tail_index(np.stack([rng.exponential(size=4096), rng.pareto(1.0, size=4096)]))
    >>> tail.xi.round(1), tail.variance_suspect
    (array([-0. ,  1.1]), array([False,  True]))
    """
    if not 0 < share < 1 or tested < 0:
        message = f"share must lie in (0, 1) and tested be >= 0, got {share} and {tested}"
        raise InputError(message)
    if not isinstance(x, Samples):
        return tail_of_part(PositivePart.of(x, null=null), share=share, tested=tested)

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        part = PositivePart.of_pixels(block)
        return _variables(tail_of_part(part, share=share, tested=tested))

    return _label(x.map(of_block, description="measuring tails", progress=progress))


def tail_of_part(part: PositivePart, *, share: float = 0.1, tested: float = 0.25) -> Tail:
    """Estimate the tail index of samples that are already split."""
    reason = part.reason()
    n = np.asarray(np.floor(share * part.n), dtype=np.int64)
    reason[(reason == Reason.OK) & (n < MINIMUM_EXCESSES)] = Reason.TOO_FEW
    usable = reason == Reason.OK
    values = np.full((4, *part.n.shape), np.nan)
    if usable.any():
        threshold, top = _top(part.sorted[usable], part.n[usable], n[usable])
        excess = top - threshold[:, np.newaxis]
        values[:2, usable] = _pareto(excess, n[usable])
        values[2, usable] = threshold
        values[3, usable] = np.log(top / threshold[:, np.newaxis]).sum(axis=-1) / n[usable]
    xi, scale, threshold, hill = values
    reason[usable & np.isnan(xi)] = Reason.CONSTANT
    root = np.sqrt(np.maximum(n, 1))
    return Tail(
        xi=xi,
        standard_error=(1 + xi) / root,
        # The error at the tested index, not at the estimate: that is the hypothesis.
        p_value=special.ndtr((tested - xi) * root / (1 + tested)),
        tested=tested,
        scale=scale,
        threshold=threshold,
        n=np.where(usable, n, 0),
        hill=hill,
        hill_standard_error=hill / root,
        variance_suspect=xi >= 0.5,
        reason=reason,
    )


def _top(ascending: npt.NDArray[Any], n: Counts, k: Counts) -> tuple[Floats, Floats]:
    """Return the sample below the k largest, and those, largest first, padded with it."""
    rank = np.arange(k.max())
    places = np.maximum(n[:, np.newaxis] - 1 - rank, (n - 1 - k)[:, np.newaxis])
    top = np.take_along_axis(ascending, places, axis=-1).astype(np.float64)
    threshold = np.take_along_axis(ascending, (n - 1 - k)[:, np.newaxis], axis=-1)
    return threshold[:, 0].astype(np.float64), top


def _pareto(excess: Floats, k: Counts) -> tuple[Floats, Floats]:
    """Return xi and scale by Zhang and Stephens (2009).

    Their k is -xi and their theta is -xi / scale; `excess` is in descending order, padded with 0.
    """
    first_quartile = (k - np.floor(k / 4 + 0.5).astype(np.int64))[:, np.newaxis]
    quartile = np.take_along_axis(excess, first_quartile, axis=-1)
    points = 20 + int(np.sqrt(k.max()))
    reach = 1 - np.sqrt(points / (np.arange(points) + 0.5))
    with np.errstate(invalid="ignore", divide="ignore"):
        theta = 1 / excess[:, :1] + reach / (_PRIOR_QUARTILE * quartile)
        xi = np.stack([_xi_of(theta[:, i], excess, k) for i in range(points)], axis=-1)
        profile = k[:, np.newaxis] * (np.log(-theta / xi) - xi - 1)
        weight = np.exp(profile - profile.max(axis=-1, keepdims=True))
        best = np.vecdot(weight, theta) / weight.sum(axis=-1)
        xi = _xi_of(best, excess, k)
        return xi, -xi / best


def _xi_of(theta: Floats, excess: Floats, k: Counts) -> Floats:
    return np.asarray(np.log1p(-theta[:, np.newaxis] * excess).sum(axis=-1) / k)


def _variables(tail: Tail) -> Mapped:
    values = {
        "tail_index": tail.xi,
        "tail_index_se": tail.standard_error,
        "tail_p_value": tail.p_value,
        "tail_scale": tail.scale,
        "tail_threshold": tail.threshold,
        "tail_n": tail.n,
        "tail_hill": tail.hill,
        "tail_hill_se": tail.hill_standard_error,
        "tail_variance_suspect": tail.variance_suspect,
        "tail_reason": tail.reason,
    }
    return {name: (("channel",), value) for name, value in values.items()}


def _label(dataset: xr.Dataset) -> xr.Dataset:
    for name, (long_name, units) in _LABELS.items():
        dataset[name].attrs.update(long_name=long_name, units=units)
    dataset["tail_reason"].attrs.update(
        long_name="why there is no tail index", units="1", **flag_attributes()
    )
    return dataset
