"""Neighbourhood: pixels whose samples are similar share their statistics.

`delbracio2014` compares histograms of the samples, patch by patch. `rousselle2012` compares patches
of means; it filters each half of the samples with weights from the other half, so that a firefly
does not choose its own neighbours. Both preserve edges that the samples show.

`shared_patches` is new here: it averages pixels whose patches are statistically similar, in two
passes. On rendered scenes at 32 samples, it has the smallest error of all estimators without
training.
"""

from __future__ import annotations

import itertools
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Floats, Reals, as_pixels, is_bad, whole
from chdstat._core.image_scales import exposure_unit
from chdstat._core.moments import Moments
from chdstat.errors import check_option
from chdstat.estimators import similarity
from chdstat.estimators.held_out import reordered
from chdstat.estimators.registry import check_positive, register
from chdstat.estimators.shapes import PowerSums, ShapeStatistics

Fireflies = Literal["limit", "keep"]

_FIRST, _SECOND = 0.3, 0.5
"""How fast weights fall with the distance, in the first and in the second pass."""
_CORRELATED = 3.0
"""Factor on the variances of means after the first pass: averages of neighbours contain the same
samples, and these were selected for being similar."""
_HUE = 0.02
"""Difference between channels, relative to their level, that is ignored: light takes on the colour
of surfaces around."""
_ROUNDING = 1e-6
_ALPHA = 0.005
"""Level of the test of means."""
_CUT = 7.0
"""Weights below e^-7 are set to 0."""
_FAR = 1e6
_LEAST_WEIGHT = 0.05
"""Weights of non-local means below this are set to 0 (authors' code)."""
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
    h_j)) <= threshold`` per used bin, summed over the patches around them and over the channels. A
    bin is used if it holds more than one sample of the two together. A similar patch contributes
    all its pixels.

    Histogram and distance follow the code of its successor, Bayesian collaborative denoising. The
    coarse scales of the publication are left out. Overlapping patches are summed, then divided once
    by the sum of all weights.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). Samples with a NaN or infinite channel are left out.
    threshold
        Distance up to which patches are similar, larger than 0; noise alone gives 1.
    radius
        Radius of the search window, in pixels: 6 for 13 x 13.
    patch
        Radius of the patches: 1 for 3 x 3, 0 for single pixels.
    unit
        Radiance that is exposed as 1; None makes the log-average of the image 0.18. Histograms end
        at about 7.5 times this; from 34 times on, samples fall entirely into the last bin.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, or an option is out of range.

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
        # Each pixel of a patch takes the pixel at the same place of the other patch.
        return similarity.window_sum(similar.astype(np.float64), patch) / (2 * patch + 1) ** 2

    window = similarity.Window(weigh, fields, radius, reach=2 * patch)
    return image.radiance(window.average(mean, counts)[0])


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
    averaged over the patches around them and over three statistics: the mean of the samples, of
    their roots, and of the differences between the roots of neighbouring channels. The weight is
    ``exp(-max(0, d - threshold) / s)``; noise alone gives d = 1. A patch contributes all its
    pixels, as in non-local means, but no pixel is averaged with one from which it differs
    significantly (test of `sakai2024`). The first pass (s = 0.3) averages the statistics. The
    second (s = 0.5) compares these averages, which have several times smaller errors, and averages
    the estimates.

    Test and transform are from `sakai2024`, patches from `delbracio2014`, the second pass from
    Rousselle et al. 2012. The weights and the choice of statistics are new here. Patches are
    compared because the error of a single pixel is unreliable: one firefly makes it large, and it
    is too small until the first one comes.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). Samples with a NaN or infinite channel are left out.
    threshold
        Distance up to which patches have full weight, larger than 0. A larger one smooths more.
    radius
        Radius of the search window, in pixels: 5 for 11 x 11.
    patch
        Radius of the patches: 1 for 3 x 3, 0 for single pixels.
    fireflies
        "limit" averages the estimates of `shared_shape`, which loses about 1 % of the energy;
        "keep" averages the means of the pixels.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, has fewer than 2 samples, or an option is out of range.

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
    """Return the means of samples, of roots, and of differences of roots between channels."""

    def transform(rows: Floats) -> Floats:
        roots = similarity.root(rows)
        return np.concatenate([rows, roots, -np.diff(roots, axis=-2)], axis=-2)

    mean, variance = similarity.corrected_means(image, transform)
    channels = image.samples.shape[2]
    roots = mean[..., channels : 2 * channels].mean(axis=-1, keepdims=True)
    # Variances of equal samples are rounding errors.
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
    """Average the known values of (y, x) over patches; infinite where none is known."""
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
    """Dual-buffer non-local means: average pixels whose patches differ only by noise.

    Let u be the mean of one half of the samples and v its squared standard error. The distance d of
    pixels p and q is ``((u_p - u_q)^2 - a (v_p + min(v_p, v_q))) / (k^2 (v_p + v_q))``, averaged
    over channels and patches. The weight ``exp(-max(0, d))``, averaged over the patch, filters the
    mean of the other half. The estimate is the mean of both filtered halves.

    Formulas and the cut of small weights follow the authors' code. The paper's smoothed variances,
    adaptive sampling and treatment of low-discrepancy samples are left out.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 4. Samples with a NaN or infinite channel
        are left out.
    damping
        The strength k, larger than 0.
    radius
        Radius of the window, in pixels: 10 for 21 x 21.
    patch
        Radius of the patches.
    cancelled
        The share a of the variance that is subtracted from the distance, 0 or larger.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`. Pixels with fewer than 2 samples that
        are good in all channels in a half get the mean of each channel's good samples.

    Raises
    ------
    InputError
        If `x` is not an image, or an option is out of range.

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
    samples = reordered(as_pixels(x, minimum=4, image=True))
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
        """Average an image with weights from another image and its squared errors."""
        around = [padded(image) for image in (values, guide, error, known)]
        total, weights = values * known[..., np.newaxis], known.astype(np.float64)
        for dy, dx in itertools.product(range(2 * radius + 1), repeat=2):
            if dy == dx == radius:
                continue
            place = slice(dy, dy + height), slice(dx, dx + width)
            its_value, its_guide, its_error, there = (image[place] for image in around)
            noise, both = error + np.minimum(error, its_error), error + its_error
            squared = np.square(guide - its_guide) - cancelled * noise
            # Pixels without noise are either equal or have no weight.
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
    """Return the mean of whole good samples and its squared error; NaN for fewer than 2."""
    moments = Moments.of(x, np.asarray(~is_bad(x).any(axis=-2, keepdims=True)))
    return moments.mean, np.square(moments.standard_error)


def _edge_patch_mean(image: Floats, radius: int) -> Floats:
    return np.asarray(ndimage.uniform_filter(image, 2 * radius + 1, mode="nearest"))
