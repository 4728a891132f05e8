"""Statistical denoising: pixels are averaged unless a test of significance tells them apart.

`sakai2024` (StatMC) tests the means of transformed samples, pixel by pixel. `sakai2025` (StatER),
its successor, tests two transforms together, with variances that are averaged themselves over
pixels whose variances do not differ, and without the variance that comes from where in its pixel a
sample fell. Both weight pixels by their distance and their first-hit features.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Reals, as_pixels, whole
from chdstat._core.moments import Moments
from chdstat.errors import InputError, check_option, check_probability
from chdstat.estimators import similarity
from chdstat.estimators.registry import check_positive, known_features, register

Variances = Literal["averaged", "own"]

_GUIDES = {"albedo": 0.02, "normal": 0.1}
"""Standard deviations of the guiding features (authors' code)."""
_Z = 2.80703
"""Two-sided quantile of the test of variances, for a level of 0.005 (authors' code)."""


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
    SE_j^2``: Welch's test on the samples after a Box-Cox transform with lambda = 1/2, with means
    corrected for skewness after Johnson. The weight is ``exp(-d^2 / 2)``, where d^2 is the sum of
    the squared differences of position, albedo and shading normal, in units of `spread` pixels,
    0.02 and 0.1.

    Formulas and settings follow the authors' published code, StatMC, except that it repeats the
    border of the image, leaves out the pixels 20 to the right and 20 below, and gives pixels the
    same weight whatever their number of samples. The root of a negative sample x is ``-sqrt(-x)``
    (Bickel and Doksum 1981).

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). Samples with a NaN or infinite channel are left out.
    features
        First-hit features of the image, as in `Samples.features`; ``albedo`` and ``normal``, each
        of shape (y, x, 3), are used if present.
    alpha
        Level of the two-sided test, between 0 and 1. A smaller level averages more pixels.
    radius
        Radius of the round window, in pixels.
    spread
        Standard deviation of the Gaussian weights in the window, in pixels, larger than 0.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, has fewer than 2 samples, a feature has another size, or an option
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
    check_probability(alpha=alpha)
    image = similarity.ScaledSamples.of(as_pixels(x, minimum=2))
    around = _joint(image, features, radius, spread)
    # 2 (sqrt(x) - 1) gives the same test as sqrt(x).
    tested = similarity.significance(similarity.corrected_means(image), image.count, alpha)
    return image.radiance(around(tested).average(image.mean(), image.count[..., np.newaxis])[0])


@register(
    "sakai2025",
    "Sakai et al. 2025, https://www.cg.tuwien.ac.at/StatER",
    label="Sakai et al. 2025",
    place=7,
    minimum_samples=3,
    uses_neighbours=True,
    uses_features=True,
    uses_film=True,
)
def sakai2025(
    x: Reals,
    *,
    features: Mapping[str, npt.NDArray[Any]] | None = None,
    film: npt.NDArray[Any] | None = None,
    alpha: float = 0.005,
    radius: int = 20,
    spread: float = 10.0,
    transforms: Sequence[float] = (1.0, 0.25),
    variances: Variances = "averaged",
) -> Reals:
    """Statistical error reduction: `sakai2024` of two transforms, with variances of neighbours.

    Pixels share their samples if no channel of the samples, nor of their Box-Cox transform with
    lambda = 1/4, differs in Welch's test. Its squared standard errors are ``v / n``, where v is the
    variance averaged over pixels whose variances do not differ: ``(l_i - l_j)^2 <= z^2 (e_i^2 +
    e_j^2)`` in every channel, with Bonett's logarithm ``l = ln(c s^2)`` of the variance and its
    squared error ``e^2 = c^2 (k - (n - 3) / n) / (n - 1)``, for ``c = n / (n - z)`` and the
    kurtosis ``k = n m_4 / m_2^2``. Weights of the pixels around are those of `sakai2024`, in both
    averages.

    With `film`, the variance that is a linear function of where in its pixel a sample fell is
    subtracted before variances are averaged: ``12 (c_x^2 + c_y^2)``, with the covariances c of the
    transformed samples and the place, whose variance is 1/12 in x and y.

    The authors' published code, StatER, holds what is summed, all settings, and what is handed to
    its kernel on the graphics card, which could not be read. These are our choices where it decides
    alone: both transforms must agree (one alone would go on averaging pixels of different radiance,
    however many samples there are); t has ``2 n - 2`` degrees of freedom, as in `sakai2024`;
    corrected variances are averaged with the weights of uncorrected ones; kurtosis is not trimmed
    (sums of powers cannot be), and mean absolute deviations, which are handed over, are not used;
    pixels without variance share none. Covariances are exact, where its running sums are too small
    (by 16 % from 16 samples). Its adaptive sampling, by the averaged variances, is left out.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 3. Samples with a NaN or infinite channel
        are left out.
    features
        First-hit features of the image, as in `Samples.features`; ``albedo`` and ``normal``, each
        of shape (y, x, 3), are used if present.
    film
        Where in its pixel each sample fell, as in `Samples.film`, shape (y, x, 2, sample), from 0
        to 1. Without it, variances are not corrected.
    alpha
        Level of the two-sided test of means, between 0 and 1. A smaller level averages more pixels.
    radius
        Radius of the round window, in pixels.
    spread
        Standard deviation of the Gaussian weights in the window, in pixels, larger than 0.
    transforms
        Exponents lambda of the transforms that must agree, each larger than 0; 1 for the samples
        themselves.
    variances
        "averaged" averages them over pixels of like variance; "own" takes each pixel's own.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, has fewer than 3 samples, features or film have another size, or an
        option is out of range.

    References
    ----------
    H. Sakai, C. Freude, M. Wimmer and D. Hahn, "Statistical error reduction for Monte Carlo
    rendering", SIGGRAPH Asia, 2025, https://www.cg.tuwien.ac.at/StatER; its images:
    doi:10.48436/kny07-dvd93.
    D. G. Bonett, "Approximate confidence interval for standard deviation of nonnormal
    distributions", Computational Statistics & Data Analysis 50(3), 2006,
    doi:10.1016/j.csda.2004.10.003.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> image[:, 4:] *= 100
    >>> sakai2025(image)[4, [0, 3, 4, 7], 0].round(1).tolist()
    [1.0, 1.0, 95.1, 94.9]
    """
    check_probability(alpha=alpha)
    check_option("variances", variances, get_args(Variances))
    check_positive(**{f"transforms[{i}]": power for i, power in enumerate(transforms)})
    samples = as_pixels(x, minimum=3)
    if film is not None and np.shape(film) != (*samples.shape[:2], 2, samples.shape[-1]):
        expected = (*samples.shape[:2], 2, samples.shape[-1])
        message = f"film must have shape {expected}, got {np.shape(film)}"
        raise InputError(message)
    image = similarity.ScaledSamples.of(samples)
    around, count = _joint(image, features, radius, spread), image.count[..., np.newaxis]
    means, errors = [], []
    for power in transforms:
        found, variance = _moments(image, partial(similarity.root, power=power), film)
        if variances == "averaged":
            variance = around(_of_variances(found)).average(variance, count)[0]
        means.append(found.mean)
        errors.append(variance / np.maximum(count, 1))
    both = np.concatenate(means, axis=-1), np.concatenate(errors, axis=-1)
    tested = similarity.significance(both, image.count, alpha)
    return image.radiance(around(tested).average(image.mean(), count)[0])


def _joint(
    image: similarity.ScaledSamples,
    features: Mapping[str, npt.NDArray[Any]] | None,
    radius: int,
    spread: float,
) -> Callable[[similarity.Means], similarity.Window]:
    """Return what makes a window: of pixels near in place and features that no test tells apart.

    The test is of means, and of the squares of t SE.
    """
    whole("radius", radius, least=0)
    check_positive(spread=spread)
    place = np.moveaxis(np.indices(image.count.shape, dtype=np.float64), 0, -1)
    known = known_features(features or {}, image.count.shape, tuple(_GUIDES))
    images = [known[name] / unit for name, unit in _GUIDES.items() if name in known]
    guides = np.concatenate([place[..., :0], *images], axis=-1)

    def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
        far = np.square(here[0][0, 0] - there[0][0, 0]).sum()  # all pairs are as far
        if far > radius**2:
            return np.zeros(here[0].shape[:2])
        unlike = np.square(here[1] - there[1]).sum(axis=-1)
        weight = np.exp(-far / (2 * spread**2) - unlike / 2)
        return np.asarray(weight * similarity.not_different(here[2:], there[2:]))

    return lambda tested: similarity.Window(weigh, (place, guides, *tested), radius)


def _moments(
    image: similarity.ScaledSamples,
    transform: Callable[[Floats], Floats],
    film: npt.NDArray[Any] | None,
) -> tuple[Moments, Floats]:
    """Return moments of transformed samples, and their variance without what places explain.

    Positions in a pixel are uniform: covariances c with them explain 12 (c_x^2 + c_y^2).
    """

    def work(
        rows: Floats, good: npt.NDArray[np.bool_], _: object, *places: npt.NDArray[Any]
    ) -> tuple[Floats, ...]:
        y = transform(rows)
        found = Moments.of(y, good)
        variance = found.variance
        for where in places:
            off = np.nan_to_num(where - 0.5) * good
            with np.errstate(invalid="ignore", divide="ignore"):
                covariance = (y - found.mean[..., np.newaxis]) @ np.swapaxes(off, -1, -2)
                explained = 12 * np.square(covariance).sum(axis=-1) / (found.count - 1) ** 2
            variance = np.maximum(variance - explained, 0)
        return *vars(found).values(), variance

    *fields, variance = image.walk(work, *(() if film is None else (film,)))
    return Moments(*fields), variance


def _of_variances(found: Moments) -> similarity.Means:
    """Return the logarithms of variances, and the squares of z times their standard errors.

    Bonett 2006, with the kurtosis about the mean.
    """
    n = found.count
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(n > _Z, n / (n - _Z), np.nan)
        error = factor**2 * (found.kurtosis + 3 - (n - 3) / n) / (n - 1)
        return np.log(factor * found.variance), _Z**2 * error
