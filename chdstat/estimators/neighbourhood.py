"""Neighbourhood: pixels whose samples are similar share their statistics.

`delbracio2014` compares histograms of the samples, patch by patch; `sakai2024` compares their means
by a test of significance, pixel by pixel; `rousselle2012` compares patches of means, and filters
each half of the samples with weights from the other half, so that a firefly of one does not choose
its own neighbours. None shares across an edge that the samples show.

One is new here: `shared_patches` averages pixels whose surroundings are statistically similar, in
two passes; on rendered scenes at 32 samples, its error is the smallest of all that are not learned.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Floats, Reals, as_pixels, whole
from chdstat._core.image_scales import exposure_unit
from chdstat.errors import check_option
from chdstat.estimators import similarity
from chdstat.estimators.registry import (
    check_positive,
    check_probability,
    known_features,
    register,
    whole_samples,
)
from chdstat.estimators.shapes import PowerSums, ShapeStatistics
from chdstat.estimators.validation import reordered

__all__ = ["Fireflies", "delbracio2014", "rousselle2012", "sakai2024", "shared_patches"]

Fireflies = Literal["limit", "keep"]

_FIRST, _SECOND = 0.3, 0.5
"""How fast weights fall with the distance, in the first and in the second pass."""
_CORRELATED = 3.0
"""Factor on the variances of means that have been averaged once: neighbours share their samples,
and what they share was chosen for being similar."""
_HUE = 0.02
"""Difference between channels, relative to their level, that tells nothing: light takes on the
colour of what is around."""
_ROUNDING = 1e-6
_ALPHA = 0.005
"""Level of the test of means."""
_GUIDES = {"albedo": 0.02, "normal": 0.1}
"""Standard deviations of what guides (authors' code)."""
_CUT = 7.0
"""Weights below e^-7 are none."""
_FAR = 1e6
_LEAST_WEIGHT = 0.05
"""Weights of non-local means below it are none (authors' code)."""
_OURS = "this library, after Sakai et al. 2024, doi:10.1145/3680528.3687591"


@register(
    "delbracio2014",
    "Delbracio et al. 2014, doi:10.1145/2532708",
    label="Delbracio et al. 2014",
    place=7,
    uses_neighbours=True,
)
def delbracio2014(
    x: Reals, *, threshold: float = 1.0, radius: int = 6, patch: int = 1, unit: float | None = None
) -> Reals:
    """Ray histogram fusion: average patches whose samples have similar histograms.

    Pixels i and j share their samples if ``chi^2 = sum (n_j h_i - n_i h_j)^2 / (n_i n_j (h_i +
    h_j)) <= threshold`` per used bin, summed over a patch around each and over the channels. Bins
    are used that hold more than one sample of both. Every similar patch lends all its pixels.

    Histogram and distance are those of the code of Bayesian collaborative denoising, a successor.
    The coarse scales of the publication are left out, and the sums over patches that overlap are
    divided once, by all their weights.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    threshold
        Distance up to which patches are similar, larger than 0; 1 is what noise gives.
    radius
        Of the search window, in pixels: 6 for 13 x 13.
    patch
        Radius of the patches: 1 for 3 x 3, 0 for single pixels.
    unit
        Radiance that is exposed as 1, see `zirr2018`; None makes the log-average of the image
        0.18. Histograms end at about 7.5 of it; their last bin is full at 34.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Where no whole sample is
        good, the mean of a channel's good samples; NaN where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, or an option is out of range.

    References
    ----------
    M. Delbracio, P. Muse, A. Buades, J. Chauvier, N. Phelps and J.-M. Morel, "Boosting Monte Carlo
    rendering by ray histogram fusion", ACM Transactions on Graphics 33(1), 2014,
    doi:10.1145/2532708. M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte
    Carlo rendering", Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> alone, shared = image.mean(axis=-1), delbracio2014(image)
    >>> bool(shared.std() < alone.std() / 3)
    True
    """
    whole("radius", radius, least=0)
    whole("patch", patch, least=0)
    check_positive(threshold=threshold)
    image = similarity.ScaledSamples.of(x)
    mean = image.mean()
    exposed = exposure_unit(mean.mean(axis=-1) * image.unit, unit)
    counts = image.count[..., np.newaxis].astype(np.float64)
    fields = (similarity.histograms(image, exposed), counts)

    def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
        distance, used = similarity.chi_square(*here, *there)
        similar = similarity.window_sum(distance, patch) <= threshold * similarity.window_sum(
            used, patch
        )
        # A patch lends to each of its pixels what lies at the same place of the other patch.
        return similarity.window_sum(similar.astype(np.float64), patch) / (2 * patch + 1) ** 2

    window = similarity.Window(weigh, fields, radius, reach=2 * patch)
    return image.radiance(window.average(mean, counts)[0])


@register(
    "sakai2024",
    "Sakai et al. 2024, doi:10.1145/3680528.3687591",
    label="Sakai et al. 2024",
    place=7,
    minimum_samples=2,
    uses_neighbours=True,
    uses_features=True,
)
def sakai2024(
    x: Reals,
    *,
    features: Mapping[str, npt.NDArray[Any]] | None = None,
    alpha: float = 0.005,
    radius: int = 20,
    spread: float = 10.0,
) -> Reals:
    """Statistical denoising: average pixels whose means do not differ significantly.

    Pixels i and j share their samples if, in every channel, ``(m_i - m_j)^2 <= t_i^2 SE_i^2 + t_j^2
    SE_j^2``: Welch's test on the samples after a Box-Cox transform with lambda = 1/2, their means
    corrected for skewness as by Johnson. They share by ``exp(-d^2 / 2)``, where d^2 adds up the
    squared differences of place, albedo and shading normal, each in its own unit: `spread` pixels,
    0.02 and 0.1.

    Formulas and settings are those of the authors' published code, which repeats the border of the
    image; here there is nothing outside. The root of a negative sample, minus that of its size, is
    that of Bickel and Doksum 1981.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    features
        First-hit features of the image, as of `Samples.features`; ``albedo`` and ``normal`` are
        used where they are there, each of shape (y, x, 3).
    alpha
        Level of the two-sided test, between 0 and 1: the smaller, the more is shared.
    radius
        Of the round window, in pixels.
    spread
        Standard deviation of the Gaussian that weighs the window, in pixels, larger than 0.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Where no whole sample is
        good, the mean of a channel's good samples; NaN where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, has less than 2 samples, a feature is no image of its size, or an option
        is out of range.

    References
    ----------
    H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer, "A statistical approach to Monte Carlo
    denoising", SIGGRAPH Asia Conference Papers, 2024, doi:10.1145/3680528.3687591.
    B. L. Welch, "The generalization of Student's problem when several different population
    variances are involved", Biometrika 34, 1947, doi:10.1093/biomet/34.1-2.28.
    G. E. P. Box and D. R. Cox, "An analysis of transformations", Journal of the Royal Statistical
    Society B 26(2), 1964, doi:10.1111/j.2517-6161.1964.tb00553.x.
    P. J. Bickel and K. A. Doksum, "An analysis of transformations revisited", Journal of the
    American Statistical Association 76(374), 1981, doi:10.1080/01621459.1981.10477649.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> image[:, 4:] *= 100
    >>> sakai2024(image)[4, [0, 3, 4, 7], 0].round(1).tolist()
    [1.0, 1.0, 95.1, 94.9]
    """
    whole("radius", radius, least=0)
    check_probability(alpha=alpha)
    check_positive(spread=spread)
    image = similarity.ScaledSamples.of(as_pixels(x, minimum=2))
    place = np.moveaxis(np.indices(image.count.shape, dtype=np.float64), 0, -1)
    known = known_features(features or {}, image.count.shape, tuple(_GUIDES))
    images = [known[name] / unit for name, unit in _GUIDES.items() if name in known]
    guides = np.concatenate([place[..., :0], *images], axis=-1)
    # 2 (sqrt(x) - 1) gives the same test as sqrt(x).
    tested = similarity.significance(similarity.corrected_means(image), image.count, alpha)

    def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
        far = np.square(here[0] - there[0]).sum(axis=-1)
        unlike = np.square(here[1] - there[1]).sum(axis=-1)
        weight = np.exp(-far / (2 * spread**2) - unlike / 2)
        weight *= (far <= radius**2) * similarity.not_different(here[2:], there[2:])
        return np.asarray(weight)

    window = similarity.Window(weigh, (place, guides, *tested), radius)
    return image.radiance(window.average(image.mean(), image.count[..., np.newaxis])[0])


@register("shared_patches", _OURS, place=7, minimum_samples=2, uses_neighbours=True)
def shared_patches(
    x: Reals,
    *,
    threshold: float = 1.0,
    radius: int = 5,
    patch: int = 1,
    fireflies: Fireflies = "limit",
) -> Reals:
    """Average pixels whose patches are statistically similar, in two passes.

    The distance of two pixels is Welch's statistic, ``d = (m_i - m_j)^2 / (SE_i^2 + SE_j^2)``,
    averaged over the pixels of a patch around each and over statistics: the mean of the samples, of
    their roots, and of the differences between the roots of neighbouring channels. They share with
    weight ``exp(-max(0, d - threshold) / s)``; noise alone gives d = 1. Patches lend all their
    pixels, as in non-local means, except to pixels that differ significantly by the test of
    `sakai2024`. A first pass (s = 0.3) averages the statistics. A second (s = 0.5) compares these
    averages, whose errors are several times smaller, and averages the estimates.

    Test and transform are those of `sakai2024`, patches those of `delbracio2014`. A single pixel
    is no evidence: its error may be large for one firefly, or small because none has come yet.
    The second pass is that of Rousselle et al. 2012. Weights, statistics and passes are
    new here.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    threshold
        Distance up to which patches share fully, larger than 0: the larger, the smoother.
    radius
        Of the search window, in pixels: 5 for 11 x 11.
    patch
        Radius of the patches: 1 for 3 x 3, 0 for single pixels.
    fireflies
        "limit" averages what `shared_shape` makes of the pixels, which loses about 1 % of the
        energy; "keep" averages their means.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Where no whole sample is
        good, the mean of a channel's good samples; NaN where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, has less than 2 samples, or an option is out of range.

    References
    ----------
    H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer, "A statistical approach to Monte Carlo
    denoising", SIGGRAPH Asia Conference Papers, 2024, doi:10.1145/3680528.3687591.
    F. Rousselle, C. Knaus and M. Zwicker, "Adaptive rendering with non-local means filtering", ACM
    Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> image[:, 4:] *= 100
    >>> shared_patches(image, fireflies="keep")[4, [0, 3, 4, 7], 0].round(1).tolist()
    [1.0, 0.9, 100.0, 93.1]
    """
    whole("radius", radius, least=0)
    whole("patch", patch, least=0)
    check_positive(threshold=threshold)
    check_option("fireflies", fireflies, get_args(Fireflies))
    samples = as_pixels(x, minimum=2)
    image = similarity.ScaledSamples.of(samples)
    own = image.mean()
    if fireflies == "limit":
        own = ShapeStatistics.of(PowerSums.of(samples)).limited() / image.unit
    members = similarity.significance(similarity.corrected_means(image), image.count, _ALPHA)

    def pooled(
        means: similarity.Means, scale: float, values: Floats, squares: Floats | None = None
    ) -> similarity.Means:
        def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
            distance = _distance(here[:2], there[:2])
            apart = _patch_mean(np.minimum(distance, _FAR), np.isfinite(distance), patch)
            excess = np.maximum(apart - threshold, 0) / scale
            weight = np.where(excess < _CUT, np.exp(-np.minimum(excess, _CUT)), 0)
            lent = similarity.window_sum(weight, patch) / (2 * patch + 1) ** 2
            return lent * similarity.not_different(here[2:], there[2:])

        window = similarity.Window(weigh, (*means, *members), radius, reach=2 * patch)
        return window.average(values, good, squares)

    good = image.count[..., np.newaxis] > 0
    mean, variance = _statistics(image)
    averaged, its = pooled((mean, variance), _FIRST, mean, np.nan_to_num(variance, posinf=0))
    found, _ = pooled((averaged, _CORRELATED * its), _SECOND, own)
    return image.radiance(found)


def _statistics(image: similarity.ScaledSamples) -> similarity.Means:
    """Return means of samples, of their roots and of the differences of these between channels."""

    def transform(rows: Floats) -> Floats:
        roots = similarity.root(rows)
        return np.concatenate([rows, roots, -np.diff(roots, axis=-2)], axis=-2)

    mean, variance = similarity.corrected_means(image, transform)
    channels = image.samples.shape[2]
    roots = mean[..., channels : 2 * channels].mean(axis=-1, keepdims=True)
    # Equal samples differ by rounding alone.
    floor = (_ROUNDING * mean) ** 2
    floor[..., 2 * channels :] = (_HUE * roots) ** 2
    return mean, variance + floor


def _distance(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
    """Return Welch's statistic, squared and averaged over the statistics."""
    (mean, variance), (other, its) = here, there
    with np.errstate(over="ignore", invalid="ignore"):
        apart = (mean - other) ** 2
        both = variance + its
        # Pixels that are black without noise are similar.
        found = np.divide(apart, both, out=np.zeros_like(apart), where=(both > 0) | ~(apart >= 0))
        # A product adds short rows up several times faster than a mean does.
        return np.asarray(found @ np.full(found.shape[-1], 1 / found.shape[-1]))


def _patch_mean(values: Floats, known: npt.NDArray[np.bool_], radius: int) -> Floats:
    """Average the known values of (y, x) over patches; infinite where there are none."""
    count = similarity.window_sum(known.astype(values.dtype), radius)
    total = similarity.window_sum(np.where(known, values, 0), radius)
    return np.divide(total, count, out=np.full_like(total, np.inf), where=count > 0)


@register(
    "rousselle2012",
    "Rousselle et al. 2012, doi:10.1145/2366145.2366214",
    label="Rousselle et al. 2012",
    place=7,
    minimum_samples=4,
    uses_neighbours=True,
)
def rousselle2012(
    x: Reals, *, damping: float = 0.45, radius: int = 10, patch: int = 3, cancelled: float = 1.0
) -> Reals:
    """Dual-buffer non-local means: average pixels whose patches differ by noise alone.

    With u the mean of one half of the samples and v its squared standard error, pixels p and q
    are ``((u_p - u_q)^2 - a (v_p + min(v_p, v_q))) / (k^2 (v_p + v_q))`` apart, averaged over
    channels and a patch around each. The weight ``exp(-max(0, d))`` is averaged over the patch
    again, and filters the mean of the other half; the estimate is the mean of both filtered halves.

    Left out are what the paper adds for samples of low discrepancy, smoothed variances, and its
    adaptive sampling. Formulas and the cut of small weights are those of the authors' code.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 4. A sample of which any channel is NaN or
        infinite is left out.
    damping
        The strength k, larger than 0.
    radius
        Of the window, in pixels: 10 for 21 x 21.
    patch
        Radius of the patches.
    cancelled
        The share a of the variance that is taken from the distance, 0 or larger.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`; the mean of a channel's good samples
        where a half has less than 2 whole ones.

    Raises
    ------
    InputError
        If `x` is no image, or an option is out of range.

    References
    ----------
    F. Rousselle, C. Knaus and M. Zwicker, "Adaptive rendering with non-local means filtering", ACM
    Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> image[:, 4:] *= 100
    >>> rousselle2012(image)[4, [0, 3, 4, 7], 0].round().tolist()
    [1.0, 1.0, 102.0, 87.0]
    """
    check_positive(damping=damping)
    radius, patch = whole("radius", radius, least=0), whole("patch", patch, least=0)
    samples = reordered(as_pixels(x, minimum=4, image=True))[0]
    _, exponent = np.frexp(np.abs(samples[np.isfinite(samples)]).max(initial=0))
    unit = np.ldexp(1.0, int(exponent))  # a power of two changes no digit
    halves = [_mean_and_error(samples[..., i::2] / unit) for i in (0, 1)]
    known = np.asarray(np.isfinite(halves[0][1] + halves[1][1]).all(axis=-1))
    (one, one_error), (two, two_error) = (
        (np.where(known[..., np.newaxis], part, 0) for part in half) for half in halves
    )
    height, width = known.shape
    edge = (radius, radius)

    def padded(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.pad(image, (edge, edge) + ((0, 0),) * (image.ndim - 2))

    def filtered(values: Floats, guide: Floats, error: Floats) -> Floats:
        """Average an image by weights from the other one with its squared errors."""
        around = [padded(image) for image in (values, guide, error, known)]
        total, weights = values * known[..., np.newaxis], known.astype(np.float64)
        for dy, dx in itertools.product(range(2 * radius + 1), repeat=2):
            if dy == dx == radius:
                continue
            place = slice(dy, dy + height), slice(dx, dx + width)
            its_value, its_guide, its_error, there = (image[place] for image in around)
            noise, both = error + np.minimum(error, its_error), error + its_error
            squared = np.square(guide - its_guide) - cancelled * noise
            # Pixels without noise are the same or nothing.
            distance = np.divide(
                squared, damping**2 * both, out=np.where(squared > 0, np.inf, 0.0), where=both > 0
            ).mean(axis=-1)
            valid = known & there
            distance = np.where(valid, np.minimum(distance, _FAR), 0)
            share = _edge_patch_mean(valid.astype(np.float64), patch)
            apart = _edge_patch_mean(distance, patch) / np.maximum(share, 1e-9)
            weight = _edge_patch_mean(np.exp(-np.maximum(apart, 0)), patch)
            weight = np.where(valid & (weight >= _LEAST_WEIGHT), weight, 0)
            total += weight[..., np.newaxis] * its_value
            weights += weight
        return np.asarray(total / np.maximum(weights, 1e-300)[..., np.newaxis])

    found = (filtered(one, two, two_error) + filtered(two, one, one_error)) / 2 * unit
    return np.where(known[..., np.newaxis], found, np.nan)


def _mean_and_error(x: npt.NDArray[np.floating[Any]]) -> tuple[Floats, Floats]:
    """Return the mean of whole good samples and its squared standard error, NaN of less than 2."""
    kept, good = whole_samples(x)
    n = np.count_nonzero(good, axis=-1)[..., np.newaxis]
    mean = kept.sum(axis=-1, dtype=np.float64) / np.maximum(n, 1)
    apart = np.where(good[..., np.newaxis, :], kept - mean[..., np.newaxis], 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return mean, np.square(apart).sum(axis=-1) / (n * np.where(n > 1, n - 1, np.nan))


def _edge_patch_mean(image: Floats, radius: int) -> Floats:
    return np.asarray(ndimage.uniform_filter(image, 2 * radius + 1, mode="nearest"))
