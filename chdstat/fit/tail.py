"""Tail: how heavy the largest samples of a CHD are.

`tail_index` fits a generalised Pareto distribution to the excesses over a threshold that it chooses
from the data. Its tail index xi orders the tails: below 0 bounded, 0 exponential (gamma, too),
above 1/4 the error of the sample variance is itself without a variance, from 1/2 on the variance is
infinite, and from 1 on the mean is. `effective_tail_index` is the index to expect of a
distribution.

An automatic threshold may miss a rare heavy tail. The `FAR` largest samples therefore have an index
of their own, and the variance of a pixel is trusted only where both indices allow it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from scipy import interpolate, special

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.positive import PositivePart
from chdstat.errors import InputError, Reason
from chdstat.fit._gamma import gamma_shape
from chdstat.fit.tail_fits import (
    MINIMUM_EXCESSES,
    Tail,
    candidates,
    finish_tail,
    hill_tail,
    pareto_tail,
    tail_variables,
)
from chdstat.summary.dispatch import Part, PositiveHistogram, Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["FAR", "Tail", "effective_tail_index", "tail_index", "tail_of_part"]

Share = float | Literal["auto"]

_STEP = 1e-4
"""Of log radiance, for a derivative."""
FAR = 28
"""Excesses of the estimate far in the tail: fewer hardly determine an index."""
_LIGHT_LEVEL = 0.06
"""Share of exponential samples whose variance is not trusted, for the sake of rare heavy tails."""
_LEAST_SCORE = -3.0
"""A bounded tail at one threshold does not make up for more than so much evidence at another."""

_DOMINATES = 0.5
"""Share of the sum of all samples above which the largest one dominates them."""

_FEW, _WIDEST = 512, 2.5
"""Of fewer samples, both estimates of the tail use nearly the same ones, so that the scatter of all
counts, too: of gamma samples of any shape, it is at most this many standardised units in 96 %, as
simulated for the shapes 0.3 to 5 and 128 to 384 samples."""

_LOG_SHARES = np.log([0.01, 0.02, 0.05, 0.1, 0.2, 0.3])
_LOG_VARIANCES = np.log(special.polygamma(1, [1.0, 0.7, 0.5, 0.3, 0.2, 0.15, 0.1]))
_GAMMA_INDEX = interpolate.RegularGridInterpolator((_LOG_VARIANCES, _LOG_SHARES), [
    [0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
    [0.000, 0.001, 0.005, 0.010, 0.019, 0.028],
    [0.006, 0.009, 0.018, 0.029, 0.050, 0.073],
    [0.016, 0.024, 0.041, 0.065, 0.113, 0.169],
    [0.026, 0.037, 0.063, 0.103, 0.187, 0.291],
    [0.033, 0.047, 0.083, 0.137, 0.261, 0.424],
    [0.044, 0.065, 0.117, 0.205, 0.423, 0.737],
])  # fmt: skip
"""The index that `pareto_tail` gives 4000 evenly spaced quantiles above that of 1 - share, of gamma
distributions with these variances of log x, which are those of the shapes 1 to 0.1."""


@of_source
def tail_index(
    x: Source,
    *,
    share: Share = "auto",
    tested: float = 0.25,
    level: float = 0.95,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Tail | xr.Dataset:
    """Estimate the tail index from the largest samples.

    The excesses over a high threshold follow the generalised Pareto distribution ``P(excess > y) =
    (1 + xi y / scale)^(-1/xi)``; its two parameters are estimated by the quasi-Bayesian average
    over the profile likelihood of Zhang and Stephens, which is close to maximum likelihood, needs
    no iteration and never fails to converge. The interval is symmetric in log(1 + xi), whose
    variance does not depend on xi, but for what one sample does to it: see below.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    share
        Share of the positive samples that make the tail, in (0, 1), or 'auto': see below.
    tested
        Tail index, at least 0, above which a tail counts as heavy.
    level
        Of the intervals, in (0, 1).

    Returns
    -------
    Tail or xarray.Dataset
        `Tail` for an array; for `Samples`, its fields over (y, x, channel), with the prefix
        ``tail_``, and q-values of both p-values over the image, for each channel separately.

    Raises
    ------
    InputError
        If `share`, `tested` or `level` is out of range, or `x` is a histogram.

    Notes
    -----
    The automatic threshold follows Bader, Yan and Zhang in that the Anderson-Darling test decides:
    the tail is the largest of three candidates whose generalised Pareto fit is not rejected at 5 %,
    or the smallest. The candidates are ``1.1 n^(3/4)`` of n samples (0.23 of 512, 0.12 of 8192),
    and 0.7 and 0.5 times as many. That bound keeps the bias of what lies below a tail smaller than
    its standard error: in simulations the error is less than that of larger candidates, of
    Clauset's minimum of Kolmogorov's distance, and of Lepski's rule. Hill's estimate goes by the
    same rule, with a test of the power law.

    One sample can raise the index to any value. So the interval also holds the one without the
    largest sample. Where that carries more than half of the sum of the positive samples, nothing is
    known of what lies between it and the others: the interval then holds those of the 10 largest
    samples as well, with it and without it, and is wide. Of path-traced pixels with such a sample
    among 256, at least 95 % of the intervals hold the index that 16384 samples show. Elsewhere,
    more samples may show another index, since their tail begins farther out, at a larger
    ``threshold``.

    A 95 % interval covers the index of generalised Pareto samples in 94 to 97 % of cases. Where the
    tail begins somewhere within the samples, it is 91 % on average with 512 samples and 94 % with
    8192, and 76 to 80 % for a heavy tail of a tenth of 512 samples, as the body biases xi towards
    0. It does **not** cover the index of a tail that is rarer than the threshold: of 1 % with index
    1 among exponential samples, the index is 0.3 to 0.4 and the interval holds 1 next to never.
    ``xi_far``, of the 28 largest samples, detects such tails; ``variance_trusted`` depends on it,
    and, of fewer than 512 samples, on whether they scatter more than gamma ones. What it can detect
    is samples of the tail beyond all others. Where there are five or more of them, the variance is
    trusted in at most 5 % of pixels if the tail has index 1 or more, in at most 10 % (15 % with
    fewer than 512 samples) if it has 2/3, and in up to 25 % as the index nears 1/2. A tail that
    begins among the other samples needs more, since most of its own are lost there: if exactly 20
    of 1024 exponential samples, of mean 1, are Pareto ones from 1 on, the variance is trusted in
    12 % for index 1 and in half of the pixels for 2/3; with 40, in 1 % and 28 %. So a trusted
    variance is no proof of a finite one. 90 % and more of exponential, uniform and gamma pixels
    are trusted from 512 samples on (of gamma shapes below 0.5 from 2048 on). Log-normal and Weibull
    samples with tails heavier than a gamma distribution's often are not identified, although their
    variance is finite. Hill's interval is one for pure power laws only: with an offset, as
    generalised Pareto samples have, it is too high at any threshold within the samples.

    An index at finite radiance is that of the range of the samples. A gamma tail gives about 0 for
    shapes from 1/2 on; below, the density still curves where the tail begins: with 512, 2048 and
    8192 samples, the index is 0.15, 0.10 and 0.07 for a shape of 0.3, and 0.22, 0.14 and 0.11 for
    0.2. ``p_exponential`` allows for that: it tests against the gamma distribution with the
    variance of log x that the samples have, if that is above an exponential's. A log-normal tail
    has index 0 too, but only far beyond the largest sample: where it was seen, at the 90 % quantile
    and above, it is that of a power law of index 0.2 to 0.3 with sigma = 1 and about 0.5 with sigma
    = 1.5. See `effective_tail_index`.

    Where the largest value occurs twice, samples were clamped or rounded, or are a few atoms: they
    have no tail index (`TIED`).

    References
    ----------
    Zhang and Stephens, "A new and efficient estimation method for the generalized Pareto
    distribution", 2009, doi:10.1198/tech.2009.08017. Hill, "A simple general approach to inference
    about the tail of a distribution", 1975, doi:10.1214/aos/1176343247. Bader, Yan and Zhang,
    "Automated threshold selection for extreme value analysis via ordered goodness-of-fit tests with
    adjustment for false discovery rate", 2018, doi:10.1214/17-AOAS1092. Choulakian and Stephens,
    "Goodness-of-fit tests for the generalized Pareto distribution", 2001,
    doi:10.1198/00401700152672573.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> tail = tail_index(np.stack([rng.exponential(size=4096), rng.pareto(1.0, size=4096)]))
    >>> tail.xi.round(1), tail.variance_suspect
    (array([-0. ,  1.1]), array([False,  True]))
    """
    _check(share, tested, level)

    def of_part(part: Part) -> Tail:
        if isinstance(part, PositiveHistogram):
            message = "a tail index needs the largest samples themselves, got a histogram"
            raise InputError(message)
        return tail_of_part(part, share=share, tested=tested, level=level)

    found = run(
        x, of_part, tail_variables, null=null, description="measuring tails", progress=progress
    )
    return found if isinstance(found, Tail) else finish_tail(found)


def tail_of_part(
    part: PositivePart, *, share: Share = "auto", tested: float = 0.25, level: float = 0.95
) -> Tail:
    """Estimate the tail index of samples that are already split."""
    reason = part.reason()
    k = candidates(part.n.ravel(), None if share == "auto" else share)
    k = k.reshape(*part.n.shape, k.shape[-1])
    reason[(reason == Reason.OK) & (k[..., 0] < MINIMUM_EXCESSES)] = Reason.TOO_FEW
    if part.x.shape[-1] > 1:
        # Where the largest value occurs more than once.
        last = np.maximum(part.n - 1, 1)[..., np.newaxis]
        one, other = (np.take_along_axis(part.sorted, i, axis=-1)[..., 0] for i in (last - 1, last))
        reason[(reason == Reason.OK) & (part.n > 1) & (one == other)] = Reason.TIED
    usable = np.asarray(reason == Reason.OK)
    ascending, n = part.sorted[usable], part.n[usable]
    found = pareto_tail(ascending, n, k[usable], usable)
    far = pareto_tail(ascending, n, np.minimum(k[usable][:, :1], FAR), usable)
    hill = hill_tail(ascending, n, k[usable], usable)
    reason[usable & np.isnan(found.xi)] = Reason.CONSTANT
    root = np.sqrt(np.maximum(found.n, 1))
    interval = _interval(found.xi, root, level)
    interval = _without_largest(interval, found.n, part, usable & np.isfinite(found.xi), level)
    light = _is_light(part, (found.first_xi, k[..., 0]), (far.xi, far.n))
    suspect = np.asarray(found.xi >= 0.5)
    trusted = np.asarray((interval[..., 1] < 0.5) & light)
    trusted[trusted] = ~_scatters(part, trusted)
    return Tail(
        xi=found.xi,
        standard_error=_deviation(found.xi) / root,
        interval=interval,
        xi_far=far.xi,
        interval_far=_interval(far.xi, np.sqrt(np.maximum(far.n, 1)), level),
        p_value=_p_value(found.xi, tested, root),
        p_exponential=_p_value(found.xi, _gamma_index(part, found.n), root),
        tested=tested,
        level=level,
        scale=found.scale,
        threshold=found.threshold,
        n=found.n,
        share=np.where(np.isnan(found.xi), np.nan, found.n / np.maximum(part.n, 1)),
        hill=hill.xi,
        hill_interval=_hill_interval(hill.xi, hill.n, level),
        hill_n=hill.n,
        variance_suspect=suspect,
        variance_trusted=trusted,
        variance_unidentified=np.isfinite(found.xi) & ~suspect & ~trusted,
        reason=reason,
    )


def effective_tail_index(distribution: Any, share: float = 0.1) -> Floats:
    """Return the tail index that a distribution seems to have above a quantile.

    That is the penultimate index ``d/du [(1 - F(u)) / f(u)]`` at the quantile u of ``1 - share``:
    that of the generalised Pareto distribution which is closest to the excesses over u. It is xi
    for a power law, and tends to 0 slowly for a log-normal distribution.

    Parameters
    ----------
    distribution
        Frozen SciPy distribution, whose parameters may be arrays.
    share
        Probability of the tail, in (0, 1).

    Returns
    -------
    ndarray
        Shape of the parameters.

    Raises
    ------
    InputError
        If `share` is out of range.

    References
    ----------
    Smith, "Estimating tails of probability distributions", 1987, doi:10.1214/aos/1176350499.

    Examples
    --------
    >>> from scipy import stats
    >>> effective_tail_index(stats.lognorm([0.5, 1.0, 1.5])).round(2)
    array([0.02, 0.3 , 0.58])
    """
    _check(share, 0.0, 0.5)
    u = np.asarray(distribution.isf(share), dtype=np.float64)
    ends = (distribution.logpdf(u * np.exp(sign * _STEP)) for sign in (1, -1))
    slope = np.subtract(*ends) / (2 * _STEP) / u
    # With f' = f (log f)', the derivative is -1 - (1 - F) (log f)' / f.
    return np.asarray(-1 - share * slope / distribution.pdf(u))


def _gamma_index(part: PositivePart, excesses: Counts) -> Floats:
    """Return the index of so many excesses of gamma distributions, 0 for shapes of 1 and more.

    They are those whose logarithms vary as much as the samples' do. Above a finite threshold, the
    tail of one with a shape below 1 is a little heavier than an exponential.
    """
    with np.errstate(divide="ignore"):
        log_variance = np.log(np.nan_to_num(part.log_statistics.log_variance))
    log_share = np.log(np.maximum(excesses, 1) / np.maximum(part.n, 1))
    low, high = np.transpose([ends[[0, -1]] for ends in _GAMMA_INDEX.grid])
    at = np.clip(np.stack([log_variance, log_share], axis=-1), low, high)
    return np.asarray(_GAMMA_INDEX(at).reshape(part.n.shape))


def _is_light(part: PositivePart, *estimates: tuple[Floats, Counts]) -> Mask:
    """Return where tail indices, of k excesses each, are together no higher than gamma ones.

    A rare heavy tail raises the index of many excesses a little, but significantly, and that of few
    much. Their standardised differences are added with weights k^(1/4), between equal ones and
    the sqrt(k) of equally good evidence. Of n excesses, the k largest share sqrt(k / n) of their
    errors with all.
    """
    total, variance = np.zeros(part.n.shape), np.zeros(part.n.shape)
    for xi, k in estimates:
        with np.errstate(invalid="ignore"):
            difference = np.log1p(np.maximum(xi, -0.99)) - np.log1p(_gamma_index(part, k))
        total += k**0.25 * np.maximum(difference * np.sqrt(k), _LEAST_SCORE)
        for _, other in estimates:
            shared = np.sqrt(np.minimum(k, other) / np.maximum(np.maximum(k, other), 1))
            variance += (k * other) ** 0.25 * shared
    return np.asarray(total <= -special.ndtri(_LIGHT_LEVEL) * np.sqrt(variance))


def _scatters(part: PositivePart, rows: Mask) -> Mask:
    """Return which of the rows have few samples that vary more than gamma ones, shape (row,).

    The logarithm of their squared coefficient of variation, over that of the likeliest gamma
    distribution, has nearly the same error for all shapes if it is multiplied by the root of n
    times the shape.
    """
    n, statistics = part.n[rows], part.log_statistics
    mean, gap = (np.asarray(v)[rows] for v in (statistics.mean, statistics.gap))
    shape, _ = gamma_shape(gap)
    excess = np.full(len(n), -np.inf)
    few = np.flatnonzero(n < _FEW)
    x, positive = part.x[rows], part.positive[rows]
    for piece in spans(len(few), _FEW):
        at = few[piece]
        ratio = np.where(positive[at], x[at], mean[at, np.newaxis]) / mean[at, np.newaxis]
        excess[at] = np.log(np.sum((ratio - 1) ** 2, axis=-1) / n[at] * shape[at])
    return np.asarray(excess * np.sqrt(n * shape) > _WIDEST)


def _deviation(xi: Floats) -> Floats:
    """Return the standard error times sqrt(n): 1 + xi (Smith 1987), but at least 0.9.

    For bounded tails the errors in samples do not fall as those in theory do: at xi = -0.3, with
    120 to 330 excesses, they are 1.2 to 1.3 times as large.
    """
    return np.maximum(1 + xi, 0.9)


def _p_value(xi: Floats, tested: float | Floats, root: Floats) -> Floats:
    """Return the p-value of a tail index at most `tested`, by the Gaussian log(1 + xi)."""
    with np.errstate(divide="ignore"):
        log = np.log(np.maximum(1 + xi, 0))
    return np.asarray(special.ndtr((np.log1p(tested) - log) * root))


def _interval(xi: Floats, root: Floats, level: float) -> Floats:
    """Return the interval that is symmetric in log(1 + xi), of which 1 / root is the error."""
    z = special.ndtri(0.5 + level / 2) / root
    return np.stack([xi + _deviation(xi) * np.expm1(sign * z) for sign in (-1, 1)], axis=-1)


def _without_largest(
    interval: Floats, k: Counts, part: PositivePart, usable: Mask, level: float
) -> Floats:
    """Widen the interval of k excesses until it holds that without the largest sample, too.

    One sample can raise the index to any value. Where it dominates, nothing is known of what lies
    between it and the others, and the tail may begin there: then the intervals of the largest
    `MINIMUM_EXCESSES` samples count, too, with it and without it.
    """
    dominated = usable & (part.largest_share > _DOMINATES)
    fewest = np.minimum(k, MINIMUM_EXCESSES)
    low, high = interval[..., 0], interval[..., 1]
    for rows, left_out, excesses in (
        (usable, 1, k - 1),
        (dominated, 1, np.minimum(k - 1, fewest)),
        (dominated, 0, fewest),
    ):
        excesses = np.maximum(excesses, 1)
        n = part.n[rows] - left_out
        other = pareto_tail(part.sorted[rows], n, excesses[rows][:, np.newaxis], rows)
        # Where the other samples are equal, they are a bounded tail.
        equal = rows & np.isnan(other.xi) & (left_out == 1)
        ends = _interval(np.where(equal, -1.0, other.xi), np.sqrt(excesses), level)
        low, high = np.fmin(low, ends[..., 0]), np.fmax(high, ends[..., 1])
    return np.stack([low, high], axis=-1)


def _hill_interval(hill: Floats, n: Counts, level: float) -> Floats:
    """Return the exact interval of a power law, where n hill / xi has a gamma distribution."""
    shape = np.maximum(n, 1)
    ends = (special.gammaincinv(shape, p) for p in (0.5 + level / 2, 0.5 - level / 2))
    return np.stack([hill * shape / end for end in ends], axis=-1)


def _check(share: Share, tested: float, level: float) -> None:
    known = share == "auto" if isinstance(share, str) else 0 < share < 1
    if not known or tested < 0 or not 0 < level < 1:
        message = (
            "share must be 'auto' or lie in (0, 1), tested be >= 0 and level lie in (0, 1), "
            f"got {share!r}, {tested} and {level}"
        )
        raise InputError(message)
