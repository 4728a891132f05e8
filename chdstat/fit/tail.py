"""Tail: how heavy the largest samples of a CHD are.

`tail_index` fits a generalised Pareto distribution to the excesses over a threshold that it chooses
from the data. Its tail index xi orders the tails: below 0 bounded, 0 exponential (gamma, too), from
1/4 on the sample variance has an infinite variance of its own, so that its error bar means nothing,
from 1/2 on the variance is infinite, and from 1 on the mean is. `effective_tail_index` is the index
to expect of a distribution.

An automatic threshold may miss a rare heavy tail. The `FAR` largest samples therefore have an index
of their own, and the variance of a pixel is trusted only where both indices allow it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from scipy import interpolate, special

from chdstat._core.arrays import Counts, Floats, Mask, rows_by_count, spans
from chdstat._core.display import Card, Width, each, in_unit, reasons, with_interval, written
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import RADIANCE, Result, Statistic, result, variable
from chdstat.errors import InputError, Reason
from chdstat.fit._gamma import gamma_shape
from chdstat.summary.runner import Source, of_source, run

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


__all__ = ["FAR", "Tail", "TailIndex", "effective_tail_index", "tail_index"]

TailShare = float | Literal["auto"]

_STEP = 1e-4
"""Of log radiance, for a derivative."""
FAR = 28
"""Excesses of the estimate far in the tail: fewer hardly determine an index."""
_LIGHT_LEVEL = 0.06
"""Share of exponential samples whose variance is not trusted, for the sake of rare heavy tails."""
_LEAST_SCORE = -3.0
"""A bounded tail at one threshold does not make up for more than so much evidence at another."""

_ROUNDING = 1e-4
"""Samples that exceed the threshold by this share of it or less count as equal to it. In single
precision, paths that see one lamp through glass or in a mirror differ by 1e-5, or a few times that;
the first quartile of the excesses of continuous samples was at least 1.8e-4 of the threshold
(scenes bathroom, caustic, day-room, night-room and gallery)."""

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
"""The index that a generalised Pareto fit gives 4000 evenly spaced quantiles above that of
1 - share, of gamma distributions with these variances of log x: those of the shapes 1 to 0.1."""


@result
class Tail(Result):
    """Tail of the positive part; arrays of the batch's shape, (...), NaN where `reason` says why.

    Attributes
    ----------
    xi, standard_error
        Tail index and its asymptotic standard error, ``(1 + xi) / sqrt(n)``, but at least
        ``0.9 / sqrt(n)``, as simulations of bounded tails show.
    interval
        Low and high end for xi, shape (..., 2), with the largest sample and without it; wide where
        that one carries more than half of the sum.
    xi_far, interval_far
        Tail index of the `FAR` largest samples alone, and its interval: it detects a few samples of
        a heavier tail than the rest, which `interval` does not account for.
    p_value
        One-sided, of the hypothesis that the tail index is at most `tested`.
    p_exponential
        One-sided, of the hypothesis that the tail is no heavier than that of an exponential, or of
        a gamma distribution whose logarithms vary as much as the samples' do.
    tested, level
        That index, and the level of the intervals.
    scale, threshold
        Generalised Pareto scale, and radiance above which the tail begins.
    n, share
        Excesses that were used, and their share of the positive samples.
    hill, hill_interval, hill_n
        Hill's estimate, for power laws only, since it is positive for every tail; its interval,
        shape (..., 2); the excesses that it was made of.
    variance_suspect
        Where xi >= 1/2: the variance may be infinite, the sample variance is not to be trusted, nor
        is any error bar made of it.
    variance_trusted
        Where the upper end of the interval is below 1/2, and neither the largest candidate nor the
        `FAR` largest samples are heavier than those of a gamma distribution; nor do fewer than 512
        samples vary more than those of one. A heavy tail of which few samples lie beyond the others
        is not seen: see the notes of `tail_index`.
    variance_unidentified
        Where neither holds: the samples do not determine whether their variance is finite.
    reason
        `Reason` codes; where it is not `OK`, none of the three holds.
    """

    xi: Floats = variable("generalised Pareto tail index xi", name="tail_index")
    standard_error: Floats = variable("standard error of the tail index", name="tail_index_se")
    interval: Floats = variable("interval of the tail index", "bound")
    xi_far: Floats = variable("tail index of the largest samples alone", name="tail_index_far")
    interval_far: Floats = variable("interval of the tail index of the largest samples", "bound")
    p_value: Floats = variable("p-value of a tail index at most the tested one", pooled=True)
    p_exponential: Floats = variable(
        "p-value of a tail no heavier than a gamma distribution's", pooled=True
    )
    tested: float
    level: float
    scale: Floats = variable("generalised Pareto scale", unit=RADIANCE)
    threshold: Floats = variable("radiance above which the tail begins", unit=RADIANCE)
    n: Counts = variable("samples above the threshold")
    share: Floats = variable("share of the positive samples above the threshold")
    hill: Floats = variable("Hill estimate of the tail index")
    hill_interval: Floats = variable("interval of the Hill estimate", "bound")
    hill_n: Counts = variable("samples of the Hill estimate")
    variance_suspect: Mask = variable("xi >= 1/2: do not trust the sample variance")
    variance_trusted: Mask = variable("no estimate of the tail contradicts a finite variance")
    variance_unidentified: Mask = variable(
        "the samples do not determine whether the variance is finite"
    )
    reason: npt.NDArray[np.int8] = variable("why there is no tail index")
    _drawn: ClassVar[str] = "share of the positive samples above it; dotted: an exponential tail"

    def plot(self, *, width: Width = "column", fig: Figure | None = None) -> Figure:
        """Draw the tail, as `chdstat.viz.tail_curve`.

        Raises
        ------
        InputError
            If there are more than six rows.
        """
        from chdstat import viz

        ax = None if fig is None else fig.subplots()
        return cast("Figure", viz.tail_curve(self, width=width, ax=ax).figure)

    def _card(self) -> Card:
        cases = {
            "trusted": self.variance_trusted,
            "suspect": self.variance_suspect,
            "not determined": self.variance_unidentified,
        }
        low, high = self.interval[..., 0], self.interval[..., 1]
        facts = {
            "tail index": each(with_interval, self.xi, low, high),
            "excesses": self.n,
            "above": in_unit(written(self.threshold), RADIANCE),
            "variance": np.select([*cases.values()], [*cases], "not known"),
            "not fitted": reasons(self.reason),
        }
        return Card("Tail", facts)


@dataclass(frozen=True)
class TailIndex(Statistic[Tail]):
    """The tail index; options as of `tail_index`."""

    result: ClassVar = Tail
    description: ClassVar = "measuring tails"
    prefix: ClassVar = "tail_"

    share: TailShare = "auto"
    tested: float = 0.25
    level: float = 0.95

    def __post_init__(self) -> None:
        _check(self.share, self.tested, self.level)

    def measure(self, part: PositivePart) -> Tail:
        """Estimate the tail index of each row."""
        reason = part.reason()
        k = _candidates(part.n.ravel(), None if self.share == "auto" else self.share)
        k = k.reshape(*part.n.shape, k.shape[-1])
        reason[(reason == Reason.OK) & (k[..., 0] < MINIMUM_EXCESSES)] = Reason.TOO_FEW
        if part.x.shape[-1] > 1:
            largest, second = np.moveaxis(_ranked(part, np.arange(2)), -1, 0)
            k = _above_ties(part, np.concatenate([k, np.minimum(k[..., :1], FAR)], axis=-1))
            ends = (part.n > 1) & (largest == second) | (k[..., 0] == 0)
            reason[(reason == Reason.OK) & ends] = Reason.TIED
            reason[(reason == Reason.OK) & (k[..., 0] < MINIMUM_EXCESSES)] = Reason.TOO_FEW
        usable = np.asarray(reason == Reason.OK)
        ascending, n, k_far = part.sorted[usable], part.n[usable], k[usable][:, -1:]
        k_tried = k[usable][:, :-1]
        found = _fits(_generalised_pareto, ascending, n, k_tried, usable)
        far = _fits(_generalised_pareto, ascending, n, k_far, usable)
        hill = _fits(_power_law, ascending, n, k_tried, usable)
        reason[usable & np.isnan(found.xi)] = Reason.CONSTANT
        root = np.sqrt(np.maximum(found.n, 1))
        interval = _interval(found.xi, root, self.level)
        interval = _without_largest(
            interval, found.n, part, usable & np.isfinite(found.xi), self.level
        )
        light = _is_light(part, (found.first_xi, k[..., 0]), (far.xi, far.n))
        suspect = np.asarray(found.xi >= 0.5)
        trusted = np.asarray((interval[..., 1] < 0.5) & light)
        trusted[trusted] = ~_scatters(part, trusted)
        return Tail(
            xi=found.xi,
            standard_error=_deviation(found.xi) / root,
            interval=interval,
            xi_far=far.xi,
            interval_far=_interval(far.xi, np.sqrt(np.maximum(far.n, 1)), self.level),
            p_value=_p_value(found.xi, self.tested, root),
            p_exponential=_p_value(found.xi, _gamma_index(part, found.n), root),
            tested=self.tested,
            level=self.level,
            scale=found.scale,
            threshold=found.threshold,
            n=found.n,
            share=np.where(np.isnan(found.xi), np.nan, found.n / np.maximum(part.n, 1)),
            hill=hill.xi,
            hill_interval=_hill_interval(hill.xi, hill.n, self.level),
            hill_n=hill.n,
            variance_suspect=suspect,
            variance_trusted=trusted,
            variance_unidentified=np.isfinite(found.xi) & ~suspect & ~trusted,
            reason=reason,
        )


@of_source
def tail_index(
    x: Source,
    *,
    share: TailShare = "auto",
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

    A 95 % interval covers the index of generalised Pareto samples in 94 to 97 % of cases. If the
    tail begins somewhere within the samples, it covers the index in 91 % of cases with 512 samples
    and in 94 % with 8192, on average; in 76 to 80 % if a heavy tail is a tenth of 512 samples,
    since the body biases xi towards 0. If the tail turns into a power law slowly, the bias stays
    while the interval narrows: the 1/3 of Student's t with 3 degrees of freedom is covered in 87,
    82 and 74 % of cases with 512, 4096 and 16384 samples. The interval does **not** cover the index
    of a tail that is rarer than the threshold: where 1 % of exponential samples have a tail of
    index 1, xi is 0.3 to 0.4 and the interval hardly ever holds 1. ``xi_far``, of the 28 largest
    samples, detects such tails; ``variance_trusted`` depends on it and, with fewer than 512
    samples, on whether they scatter more than gamma ones. It detects a tail only if some of its
    samples are larger than all others. Where there are five or more of them, the variance is
    trusted in at most 5 % of pixels if the tail has index 1 or more, in at most 10 % (15 % with
    fewer than 512 samples) if it has 2/3, and in up to 25 % as the index nears 1/2. A tail that
    begins among the other samples needs more, since most of its own are lost there: if exactly 20
    of 1024 exponential samples, of mean 1, are Pareto ones from 1 on, the variance is trusted in 12
    % for index 1 and in half of the pixels for 2/3; with 40, in 1 % and 28 %. So a trusted variance
    is no proof of a finite one. 90 % and more of exponential, uniform and gamma pixels are trusted
    from 512 samples on (of gamma shapes below 0.5 from 2048 on). Log-normal and Weibull samples
    with tails heavier than a gamma distribution's often are not identified, although their variance
    is finite. Hill's interval is one for pure power laws only: with an offset, as generalised
    Pareto samples have, it is too high at any threshold within the samples.

    The index describes only the range that was sampled. A gamma tail gives about 0 for
    shapes from 1/2 on; below, the density still curves where the tail begins: with 512, 2048 and
    8192 samples, the index is 0.15, 0.10 and 0.07 for a shape of 0.3, and 0.22, 0.14 and 0.11 for
    0.2. ``p_exponential`` allows for that: it tests against the gamma distribution with the
    variance of log x that the samples have, if that is above an exponential's. A log-normal tail
    has index 0 too, but only far beyond the largest sample: where it was seen, at the 90 % quantile
    and above, it is that of a power law of index 0.2 to 0.3 with sigma = 1 and about 0.5 with sigma
    = 1.5. See `effective_tail_index`.

    Where the largest value occurs twice, samples were clamped or rounded, or are a few atoms: they
    have no tail index (`TIED`). A lamp behind glass or in a mirror gives many samples that differ
    by rounding only. Where a quarter of the excesses or more are within 1e-4 of the threshold,
    relative to it, those are no excesses, and the tail is what lies above them: `TOO_FEW` where
    that is fewer than 10 samples, `TIED` where it is none.

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
    return run(TailIndex(share, tested, level), x, null=null, progress=progress)


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
    """Return the tail index that so many excesses of a gamma distribution would show.

    It is the gamma distribution whose logarithms have the variance of the samples' logarithms. If
    its shape is 1 or more, the index is 0; below 1, its tail above a finite threshold is a little
    heavier than an exponential.
    """
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
        k_other = excesses[rows][:, np.newaxis]
        other = _fits(_generalised_pareto, part.sorted[rows], n, k_other, rows)
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


def _check(share: TailShare, tested: float, level: float) -> None:
    known = share == "auto" if isinstance(share, str) else 0 < share < 1
    if not known or tested < 0 or not 0 < level < 1:
        message = (
            "share must be 'auto' or lie in (0, 1), tested be >= 0 and level lie in (0, 1), "
            f"got {share!r}, {tested} and {level}"
        )
        raise InputError(message)


MINIMUM_EXCESSES = 10
"""Fewer samples above the threshold give no tail index."""

_LARGEST_SHARE = 0.5
_STEPS = 3
_CELLS, _SINGLES = 32, 8
"""Groups that excesses are put into where they are averaged; the largest stay alone."""
_PRIOR_QUARTILE = 3.0
"""Zhang and Stephens' constant: how far their grid reaches beyond the largest excess."""
_LEAST = 1e-12
"""Least distribution function in the test: that of ties with the threshold."""


class _Fits(NamedTuple):
    """A fit to the excesses of each row, all of the batch's shape.

    Attributes
    ----------
    xi, scale
        Tail index, NaN where excesses are equal, and scale in units of the samples.
    threshold
        Largest sample that is no excess.
    n
        Excesses.
    first_xi
        Tail index of the first candidate, whether the test rejects it or not.
    """

    xi: Floats
    scale: Floats
    threshold: Floats
    n: Counts
    first_xi: Floats


class _Excesses(NamedTuple):
    """Excesses in ascending order, the largest in the last column, shape (row, excess).

    Attributes
    ----------
    y
        Relative to the largest, hence at most 1; 0 in the columns that a row does not need.
    rank
        1 for the smallest excess; not positive in columns that a row does not need.
    n, threshold, largest
        Excesses, the sample below them, and the largest excess, shape (row,).
    """

    y: Floats
    rank: Counts
    n: Counts
    threshold: Floats
    largest: Floats


_Model = Callable[[_Excesses], tuple[Floats, Floats, Mask]]
"""Returns xi, the scale relative to the largest excess, and where the test does not reject."""


def _candidates(n: Counts, share: float | None) -> Counts:
    """Return numbers of excesses to try, largest first, shape (row, candidate).

    A given share is the only one. Otherwise the largest is ``1.1 n^(3/4)``, and at most half of the
    samples; each further one has a half of the last one's variance more.
    """
    if share is not None:
        return np.asarray(np.floor(share * n), dtype=np.int64)[:, np.newaxis]
    largest = np.minimum(1.1 * n**0.75, _LARGEST_SHARE * n)[:, np.newaxis]
    k = np.floor(largest * 2.0 ** (-np.arange(_STEPS) / 2)).astype(np.int64)
    return np.asarray(np.maximum(k, np.minimum(k[:, :1], MINIMUM_EXCESSES)))


def _above_ties(part: PositivePart, k: Counts) -> Counts:
    """Return numbers of excesses without those that equal the threshold but for rounding.

    They are left out where they are a quarter or more, since the first quartile sets the scale of
    the fit. A candidate that keeps fewer than `MINIMUM_EXCESSES` gives way to the first one.
    """
    k, threshold, upper = k.copy(), _ranked(part, k), _ranked(part, k - _quartile(k))
    tied = (k > 0) & (upper / (1 + _ROUNDING) <= threshold)
    for i in range(k.shape[-1]):
        at = tied[..., i]
        equal_or_less = part.sorted[at] / (1 + _ROUNDING) <= threshold[at][:, i, np.newaxis]
        k[at, i] = part.n[at] - np.count_nonzero(equal_or_less, axis=-1)
    return np.where(k < MINIMUM_EXCESSES, k[..., :1], k)


def _ranked(part: PositivePart, rank: Counts) -> npt.NDArray[Any]:
    """Return the samples with so many larger ones, shape (..., rank)."""
    at = np.maximum(part.n[..., np.newaxis] - 1 - rank, 0)
    return np.take_along_axis(part.sorted, at, axis=-1)


def _quartile(k: Counts) -> Counts:
    """Return the rank of the first quartile of k excesses, as Zhang and Stephens define it."""
    return np.asarray(np.floor(k / 4 + 0.5), dtype=np.int64)


def _fits(model: _Model, ascending: npt.NDArray[Any], n: Counts, k: Counts, usable: Mask) -> _Fits:
    """Fit a model to the excesses of each row.

    Parameters
    ----------
    model
        `_generalised_pareto` or `_power_law`.
    ascending
        Samples of the usable rows in ascending order, shape (row, sample); the first `n` count.
    n
        Shape (row,).
    k
        Numbers of excesses to try, shape (row, candidate), the preferred one first.
    usable
        Where the rows belong in the batch, shape (...): other rows get NaN and 0.
    """
    values = np.full((5, usable.size), np.nan)
    place = np.flatnonzero(usable)
    for rows in rows_by_count(k.max(axis=1), np.ones(len(n), bool), ascending.shape[-1]):
        values[:, place[rows]] = _choose(model, ascending, n, k, rows)
    xi, scale, threshold, count, first_xi = values.reshape(5, *usable.shape)
    return _Fits(xi, scale, threshold, np.nan_to_num(count).astype(np.int64), first_xi)


def _choose(
    model: _Model, ascending: npt.NDArray[Any], n: Counts, k: Counts, rows: Counts
) -> Floats:
    """Take the first candidate whose fit is not rejected, or the last one that can be fitted.

    Returns xi, scale, threshold, excesses, and xi of the first candidate, shape (5, row).
    """
    found, open_ = np.full((5, len(rows)), np.nan), np.arange(len(rows))
    for tried in range(k.shape[1]):
        here = rows[open_]
        excesses = _excesses(ascending, n[here], k[here, tried], here, log=model is _power_law)
        xi, scale, accepted = model(excesses)
        if tried == 0:
            found[4] = xi
        known = np.isfinite(xi)
        chosen = xi, scale * excesses.largest, excesses.threshold, excesses.n
        found[:4, open_[known]] = np.stack(chosen)[:, known]
        open_ = open_[~accepted]
        if not len(open_):
            break
    return found


def _excesses(
    ascending: npt.NDArray[Any], n: Counts, k: Counts, rows: Counts, *, log: bool
) -> _Excesses:
    width = int(k.max())
    columns = n[:, np.newaxis] - width + np.arange(width)
    top = ascending[rows[:, np.newaxis], np.maximum(columns, 0)].astype(np.float64)
    threshold = ascending[rows, n - 1 - k].astype(np.float64)
    rank = np.arange(width) - (width - k)[:, np.newaxis] + 1
    low = threshold[:, np.newaxis]
    top = np.maximum(top, low)
    excess = np.log(top) - np.log(low) if log else top - low
    largest = excess[:, -1].copy()
    excess /= largest[:, np.newaxis]
    return _Excesses(y=excess, rank=rank, n=k, threshold=threshold, largest=largest)


def _generalised_pareto(e: _Excesses) -> tuple[Floats, Floats, Mask]:
    """Average over the profile likelihood: Zhang and Stephens (2009), section 2.

    Their k is -xi and their theta is -xi / scale.
    """
    count, mean = _groups(e)
    place = e.y.shape[1] - e.n + _quartile(e.n) - 1
    quartile = np.take_along_axis(e.y, place[:, np.newaxis], axis=-1)[:, 0]
    points = 20 + np.sqrt(e.n).astype(np.int64)
    weight, theta = _profile(count, mean, quartile, points, e.n)
    best = np.vecdot(weight, theta) / weight.sum(axis=-1)
    log = np.log1p(-best[:, np.newaxis] * e.y)
    xi = log.sum(axis=-1) / e.n
    passed = _anderson_darling(-log / xi[:, np.newaxis], e) <= _critical(xi, e.n)
    return xi, -xi / best, passed


def _profile(
    count: Floats, mean: Floats, quartile: Floats, points: Counts, n: Counts
) -> tuple[Floats, Floats]:
    """Return the likelihood of the points of their grid, relative to the largest, and the grid."""
    grid = np.arange(points.max()) + 0.5
    reach = 1 - np.sqrt(points[:, np.newaxis] / grid)
    theta = 1 + reach / (_PRIOR_QUARTILE * quartile[:, np.newaxis])
    theta[theta == 0] = _LEAST
    xi = np.empty(theta.shape)
    for i in range(len(grid)):
        # Logarithms of numbers near 1 lose digits only where xi is 0, to all that matters here.
        xi[:, i] = np.vecdot(count, np.log(1 - theta[:, i, np.newaxis] * mean))
    xi /= n[:, np.newaxis]
    log = n[:, np.newaxis] * (np.log(-theta / xi) - xi - 1)
    log[grid > points[:, np.newaxis]] = -np.inf
    return np.exp(log - log.max(axis=-1, keepdims=True)), theta


def _groups(e: _Excesses) -> tuple[Floats, Floats]:
    """Return counts and means of neighbouring excesses, shape (row, group)."""
    rows, width = e.y.shape
    # Sums from the smallest on keep the digits of small excesses.
    below = np.zeros((rows, width + 1))
    np.cumsum(e.y, axis=-1, out=below[:, 1:])
    single = np.minimum(e.n, _SINGLES)[:, np.newaxis]
    even = (e.n[:, np.newaxis] - single) * np.linspace(0, 1, _CELLS + 1)
    alone = e.n[:, np.newaxis] - np.minimum(np.arange(_SINGLES)[::-1], single)
    edges = np.concatenate([np.rint(even).astype(np.int64), alone], axis=-1)
    count = np.diff(edges, axis=-1).astype(np.float64)
    sums = np.take_along_axis(below, edges + (width - e.n)[:, np.newaxis], axis=-1)
    return count, np.diff(sums, axis=-1) / np.maximum(count, 1)


def _power_law(e: _Excesses) -> tuple[Floats, Floats, Mask]:
    """Average the log excesses: Hill (1975)."""
    mean = e.y.sum(axis=-1) / e.n
    statistic = _anderson_darling(-e.y / mean[:, np.newaxis], e)
    xi = np.where(mean > 0, mean * e.largest, np.nan)
    # D'Agostino and Stephens (1986), table 4.14: 5 % of an exponential of unknown scale.
    passed = statistic * (1 + 0.6 / e.n) <= 1.321
    return xi, e.threshold / e.largest, np.asarray(passed)


def _anderson_darling(log_survival: Floats, e: _Excesses) -> Floats:
    """Return A^2 from the logarithms of 1 - F at the excesses."""
    log_below = np.log(np.maximum(1 - np.exp(log_survival), _LEAST))
    twice = 2.0 * e.rank
    terms = (twice - 1) * log_below + (2.0 * e.n[:, np.newaxis] - twice + 1) * log_survival
    return np.asarray(-e.n - np.sum(terms, axis=-1, where=e.rank > 0) / e.n)


def _critical(xi: Floats, n: Counts) -> Floats:
    """Return the 5 % point of A^2, both parameters fitted, as simulated for 15 to 400 excesses."""
    at_120, growth = np.interp(xi, _XI, _CRITICAL), np.interp(xi, _XI, _GROWTH)
    return np.asarray(at_120 + growth * np.log(n / 120))


_XI = np.array([-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
_CRITICAL = np.array([1.086, 1.019, 0.938, 0.873, 0.825, 0.788, 0.756])
_GROWTH = np.array([0.075, 0.061, 0.044, 0.030, 0.023, 0.015, 0.009])
"""Fitted to 25 000 to 200 000 samples per xi and number of excesses, to 0.01."""
