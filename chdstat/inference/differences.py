"""Differences: the distance between two CHDs, and whether chance alone explains it.

Use it for two pixels, or for all pixels of two stores that differ in integrator, path length or
spp. To compare estimators, use `chdstat.compare`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import (
    Counts,
    Floats,
    LeftOut,
    Mask,
    Seed,
    as_samples,
    generator,
    is_bad,
    seed_number,
    spans,
    warn_left_out,
    whole,
)
from chdstat._core.display import Shown
from chdstat._core.moments import Moments
from chdstat.errors import InputError
from chdstat.inference.permutations import p_of_means
from chdstat.samples import ImageLike, Samples, opened

_MOST = 4096
_REPLICATES = 199
_AT_ONCE = 2**19
"""Samples of a block of pixels that are shuffled together."""


@dataclass(frozen=True, repr=False)
class Difference(Shown):
    """How two sets of samples with the same channels differ; nulls count in both.

    For two pixels, the shapes are (channel,) and (); for two images, (y, x, channel) and (y, x).

    Attributes
    ----------
    distance
        Kolmogorov-Smirnov distance of the distribution functions, shape (..., channel).
    wasserstein
        Wasserstein distance, the mean shift of radiance, shape (..., channel), in radiance.
    p_value
        P-value of the hypothesis that both sets have one distribution, shape (...). The statistic
        is the largest distance over the channels; whole samples, or the two samples of a pair, are
        permuted. NaN without samples.
    mean_difference
        Mean of the second set minus mean of the first, shape (..., channel), in radiance.
    mean_t
        The mean difference over its standard error, shape (..., channel); NaN without scatter.
    mean_p_value
        Two-sided p-value of each mean difference, shape (..., channel), not corrected for the
        number of channels. Without pairs, it is the larger of two: Welch's test, and all divisions
        of the samples into two sets. With pairs, it is Student's.
    n
        Good samples of both sets that the distances look at, each of shape (...).
    paired
        Whether the samples were compared in pairs.
    """

    distance: Floats
    wasserstein: Floats
    p_value: Floats | float
    mean_difference: Floats
    mean_t: Floats
    mean_p_value: Floats
    n: tuple[Counts | int, Counts | int]
    paired: bool = False


def difference(
    a: npt.ArrayLike | ImageLike,
    b: npt.ArrayLike | ImageLike,
    *,
    paired: bool | None = None,
    replicates: int = _REPLICATES,
    seed: Seed = 0,
) -> Difference:
    """Compare two CHDs: the samples of two pixels, or of all pixels of two images.

    **Distance**: ``D = max |F_a - F_b|``. Ties, such as nulls, make textbook p-values of D wrong.
    Instead, the samples are shuffled between the two sets: ``p = (b + 1) / (B + 1)`` if b of B
    shuffles are at least as far apart. Whole samples are shuffled, so that dependent channels stay
    together and their number needs no correction.

    **Pairs.** Renders with equal seeds share random numbers: sample i of a pixel is correlated with
    sample i of the other render, and tests that assume independence are badly wrong. In pairs, the
    difference of each pair counts, and shuffles swap the two samples of a pair. That is right for
    any correlation, and a higher correlation shows smaller differences.

    **Means.** Welch's test rejects equal means too often if rare bright samples decide and one set
    is larger. Divisions of the samples between the sets are exact if both sets have one
    distribution, but not if only their means agree. The p-value of a mean is therefore the larger
    of the two.

    Parameters
    ----------
    a, b
        Linear radiance, shapes (..., channel, sample), with the same number of pixels; or two
        images of one size, as `Samples` or the paths of stores. Bad samples are left out, and so
        are their partners in pairs. Distances look at up to 4096 samples, means at all.
    paired
        Whether sample i of both was drawn with the same random numbers. By default, the seeds of
        `Samples` decide (`Samples.shares_numbers_with`); pairs then use as many samples as both
        have. Arrays do not know their seeds and count as independent.
    replicates, seed
        Number of shuffles B, the same in every pixel, and their seed.

    Returns
    -------
    Difference
        Distances and mean differences for each channel, and one p-value for all channels.

    Raises
    ------
    InputError
        If the numbers of channels or pixels differ, pairs are asked for with unequal numbers of
        samples, only one of the two is an array, or B is less than 1.
    StoreError
        If a store is damaged.

    References
    ----------
    Kolmogorov-Smirnov by permutation: Praestgaard, "Permutation and bootstrap Kolmogorov-Smirnov
    tests for the equality of two distributions", 1995, Scandinavian Journal of Statistics 22.
    Means: Welch, "The generalization of 'Student's' problem when several different population
    variances are involved", 1947, doi:10.1093/biomet/34.1-2.28; of renders, pixel by pixel: Jung,
    Hanika and Dachsbacher, "Detecting bias in Monte Carlo renderers using Welch's t-test", 2020,
    Journal of Computer Graphics Techniques 9(2); by divisions: Pitman, "Significance tests which
    may be applied to samples from any populations", 1937, doi:10.2307/2984124
    (`chdstat.inference.permutations.p_of_means`).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> same = difference(rng.gamma(2.0, size=(3, 500)), rng.gamma(2.0, size=(3, 500)))
    >>> other = difference(rng.gamma(2.0, size=(3, 500)), rng.gamma(3.0, size=(3, 500)))
    >>> bool(same.p_value > 0.05), float(other.p_value)
    (True, 0.005)

    Two renders of one seed:

    >>> x = rng.gamma(2.0, size=(2, 2, 3, 64))
    >>> one, two = (Samples.from_array(x + e, seed=0) for e in (0, rng.normal(0, 0.1, x.shape)))
    >>> found = difference(one, two)
    >>> found.paired, found.p_value.shape
    (True, (2, 2))
    """
    replicates = whole("replicates", replicates, least=1)
    first, second = (opened(x, averages=True) for x in (a, b))
    seed = seed_number(seed)
    if isinstance(first, Samples) and isinstance(second, Samples):
        _check_equal_shapes(first.shape[:3], second.shape[:3])
        return _of_images(first, second, paired, replicates, seed)
    if isinstance(first, Samples) or isinstance(second, Samples):
        message = "expected two arrays or two Samples, got one of each; read() returns an array"
        raise InputError(message)
    one, two = (np.atleast_2d(as_samples(x)).astype(np.float64) for x in (first, second))
    _check_equal_shapes(one.shape[:-1], two.shape[:-1])
    if paired and one.shape != two.shape:
        message = f"pairs need as many samples of both, got {one.shape[-1]} and {two.shape[-1]}"
        raise InputError(message)
    for x in (one, two):
        warn_left_out(x, channel_axis=-2)
    return _of_pixels(one, two, bool(paired), replicates, seed)


def _check_equal_shapes(one: tuple[int, ...], two: tuple[int, ...]) -> None:
    if 0 in one:
        message = f"expected pixels with channels, got shape {one} before the samples"
        raise InputError(message)
    if one[-1] != two[-1]:
        message = f"expected as many channels in both, got {one[-1]} and {two[-1]}"
        raise InputError(message)
    if one != two:
        message = f"expected as many pixels in both, got {one[:-1]} and {two[:-1]}"
        raise InputError(message)


def _of_images(
    a: Samples, b: Samples, paired: bool | None, replicates: int, seed: int
) -> Difference:
    """Compare two images row by row."""
    pairs = a.shares_numbers_with(b) if paired is None else paired
    count = min(a.spp, b.spp)
    most = slice(0, count) if pairs else slice(None)
    rows = max(1, _AT_ONCE // (a.shape[1] * a.shape[2] * (a.spp + b.spp)))
    left_out, parts = LeftOut(), []
    for ys in spans(a.shape[0], rows):
        read = [x.read(ys, ss=most).astype(np.float64) for x in (a, b)]
        for image, x in zip((a, b), read, strict=True):
            left_out.see(x, channel_axis=-2, absent=image.absent(ys, ss=most))
        parts.append(_of_pixels(read[0], read[1], pairs, replicates, seed))
    left_out.warn()
    joined = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts])
        for f in fields(Difference)
        if f.name not in {"n", "paired"}
    }
    one, two = (np.concatenate([part.n[i] for part in parts]) for i in (0, 1))
    return Difference(**joined, n=(one, two), paired=pairs)


@np.errstate(all="ignore")
def _of_pixels(a: Floats, b: Floats, paired: bool, replicates: int, seed: int) -> Difference:
    """Compare samples (..., channel, sample), block by block."""
    shape, channels = a.shape[:-2], a.shape[-2]
    one, two = (x.reshape(-1, channels, x.shape[-1]) for x in (a, b))
    good_a, good_b = (np.asarray(~np.asarray(is_bad(x)).any(axis=1)) for x in (one, two))
    if paired:
        good_a = good_b = np.asarray(good_a & good_b)
    found = _mean_differences(one, two, good_a, good_b, paired=paired)
    one, two = one[..., :_MOST], two[..., :_MOST]
    good_a, good_b = good_a[..., :_MOST], good_b[..., :_MOST]
    step = max(1, _AT_ONCE // (channels * (one.shape[-1] + two.shape[-1])))
    parts = [
        _distances(
            one[i], two[i], good_a[i], good_b[i], paired=paired, replicates=replicates, seed=seed
        )
        for i in spans(len(one), step)
    ]
    *distances, p_value = (np.concatenate(values) for values in zip(*parts, strict=True))
    names = ("mean_difference", "mean_t", "mean_p_value", "distance", "wasserstein")
    by_channel = {
        name: values.reshape(*shape, channels)
        for name, values in zip(names, (*found, *distances), strict=True)
    }
    n_a, n_b = (good.sum(axis=-1).reshape(shape)[()] for good in (good_a, good_b))
    return Difference(**by_channel, p_value=p_value.reshape(shape)[()], n=(n_a, n_b), paired=paired)


def _distances(
    a: Floats, b: Floats, good_a: Mask, good_b: Mask, *, paired: bool, replicates: int, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Return both distances (pixel, channel) and p-values (pixel,) of samples."""
    pool, good = np.concatenate([a, b], axis=-1), np.concatenate([good_a, good_b], axis=-1)
    # Bad samples have no weight, and are placed where they make no gap.
    top = np.where(good[:, np.newaxis], pool, -np.inf).max(axis=-1, keepdims=True)
    pool = np.where(good[:, np.newaxis], pool, top)
    order = np.argsort(pool, axis=-1, kind="stable")
    ordered = np.take_along_axis(pool, order, axis=-1)
    last = np.ones(pool.shape, bool)
    last[..., :-1] = ordered[..., 1:] > ordered[..., :-1]
    n_a, n_b = (g.sum(axis=-1, keepdims=True) for g in (good_a, good_b))
    known = (n_a > 0) & (n_b > 0)
    one, two = (known / np.maximum(n, 1) for n in (n_a, n_b))

    def gaps(weights: Floats) -> Floats:
        """Return |F_a - F_b| after each of the ordered samples, for each channel."""
        each = np.broadcast_to(weights[:, np.newaxis], order.shape)
        return np.asarray(np.abs(np.cumsum(np.take_along_axis(each, order, axis=-1), axis=-1)))

    weights = np.concatenate([good_a * one, good_b * -two], axis=-1)
    seen = gaps(weights)
    distance = np.where(last, seen, 0).max(axis=-1)
    wasserstein = (seen[..., :-1] * np.diff(ordered, axis=-1)).sum(axis=-1)
    largest = distance.max(axis=-1) - 1e-12
    rng, farther = generator(seed), np.zeros(len(pool), np.int64)
    for _ in range(replicates):
        if paired:
            sign = np.where(rng.random(a.shape[-1]) < 0.5, -1.0, 1.0)
            shuffled = weights * np.tile(sign, 2)
        else:
            first = _drawn(np.asarray(rng.random(pool.shape[-1])), good, n_a)
            shuffled = np.where(first, one, -two) * good
        farther += np.where(last, gaps(shuffled), 0).max(axis=(-2, -1)) >= largest
    p_value = np.where(known[:, 0], (farther + 1) / (replicates + 1), np.nan)
    return np.where(known, distance, np.nan), np.where(known, wasserstein, np.nan), p_value


def _drawn(keys: Floats, good: Mask, count: Counts) -> Mask:
    """Return which good samples (pixel, sample) have the `count` (pixel, 1) smallest keys."""
    if good.all():
        good, count = good[:1], count[:1]
    own = np.where(good, keys, np.inf)
    border = np.take_along_axis(np.sort(own, axis=-1), np.maximum(count - 1, 0), axis=-1)
    return np.asarray(good & (own <= border))


def _mean_differences(
    a: Floats, b: Floats, good_a: Mask, good_b: Mask, *, paired: bool
) -> tuple[Floats, Floats, Floats]:
    """Return differences of means, t and p, Welch's or Student's for pairs, (pixel, channel)."""
    used_a, used_b = good_a[:, np.newaxis], good_b[:, np.newaxis]
    sizes = [
        np.where(used, np.abs(x), 0).max(axis=-1, initial=0)
        for x, used in ((a, used_a), (b, used_b))
    ]
    # In units of the largest sample, so that the fourth power of 1e30 does not overflow.
    scale = np.max([np.where(size > 0, size, 1.0) for size in sizes], axis=0)
    unit = scale[..., np.newaxis]
    if paired:
        of = Moments.of((b - a) / unit, used_a)
        delta, squared, degrees = of.mean, of.variance / of.count, of.count - 1
        known, constant = of.count > 1, of.variance == 0
    else:
        first, second = Moments.of(a / unit, used_a), Moments.of(b / unit, used_b)
        errors = [x.variance / x.count for x in (first, second)]
        delta, squared = second.mean - first.mean, errors[0] + errors[1]
        # Welch (1947), equation 28: degrees of freedom of the sum of two variances.
        degrees = squared**2 / (
            errors[0] ** 2 / (first.count - 1) + errors[1] ** 2 / (second.count - 1)
        )
        known = (first.count > 1) & (second.count > 1)
        constant = squared == 0
    t = delta / np.sqrt(squared)
    p = 2 * special.stdtr(degrees, -np.abs(t))
    if not paired:
        for channel in range(p.shape[1]):
            of_divisions = p_of_means(a[:, channel], b[:, channel], good_a, good_b)
            p[:, channel] = np.fmax(p[:, channel], of_divisions)
    # Without scatter, there is no measure for a difference; rounding is not scatter.
    return np.where(known, delta * scale, np.nan), *np.where(known & ~constant, [t, p], np.nan)
