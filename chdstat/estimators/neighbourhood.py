"""Windows: sums over the pixels around, weighted by how alike each of them is.

`pool` walks over the offsets of a window and shifts the image by each, so that all pixels of an
offset are compared at once. A pair of pixels is compared once and counts both ways: what one pixel
takes from another, that one takes from it.

Shared statistics, as published: pixels whose samples are alike average their estimates.

`delbracio2014` compares histograms of the samples, patch by patch; `sakai2024` compares their means
by a test of significance, pixel by pixel. Neither shares across an edge that the samples tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, spans, whole
from chdstat._core.image_scales import exposure_unit
from chdstat.errors import InputError
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats
from chdstat.estimators.similarity import (
    ScaledSamples,
    chi_square,
    corrected_means,
    histograms,
    not_different,
    root,
    significance,
)

__all__ = [
    "Weigh",
    "check_window",
    "delbracio2014",
    "patch_mean",
    "patch_sum",
    "pool",
    "quotient",
    "sakai2024",
    "with_own",
    "with_weight",
]

Weigh = Callable[[tuple[Floats, ...], tuple[Floats, ...]], Floats]
"""Weights (y, x) of pixels, from the fields here and the fields at an offset, each (y, x, ...)."""

_PIXELS = 2**15
"""Pixels compared at once."""


def pool(
    weigh: Weigh,
    fields: tuple[Floats, ...],
    values: Floats,
    squares: Floats | None = None,
    *,
    radius: int,
    reach: int = 0,
) -> tuple[Floats, Floats]:
    """Add up what lies within a window, each pixel by its weight.

    Parameters
    ----------
    weigh
        Weights of pairs; the pixel itself counts with weight 1.
    fields
        What `weigh` compares, each of shape (y, x, ...).
    values, squares
        What is added up, shape (y, x, value): values by the weights, squares by the squared
        weights, as variances of the former are.
    radius
        Pixels up to this far in y and in x belong to the window.
    reach
        How many rows around a pair its weight depends on.

    Returns
    -------
    tuple of ndarray
        Both sums, shape (y, x, value); outside the image there is nothing.
    """
    beside = np.zeros((*values.shape[:2], 0)) if squares is None else squares
    height, width = values.shape[:2]
    sums, squared = np.empty_like(values), np.empty_like(beside)
    halo = radius + reach
    for rows in spans(height, max(halo, _PIXELS // max(width, 1), 1)):
        # Strips with what they depend on around them give what the whole image does.
        strip = slice(max(rows.start - halo, 0), rows.stop + halo)
        found = _pool(weigh, [f[strip] for f in fields], values[strip], beside[strip], radius)
        inner = slice(rows.start - strip.start, rows.stop - strip.start)
        sums[rows], squared[rows] = found[0][inner], found[1][inner]
    return sums, squared


def patch_sum(values: Floats, radius: int) -> Floats:
    """Add up (y, x) over patches of (2 radius + 1)^2 pixels; outside, there is nothing."""
    if radius == 0:
        return values
    height, width = values.shape
    padded = np.pad(values, radius)
    rows = padded[:height].copy()
    for step in range(1, 2 * radius + 1):
        rows += padded[step : step + height]
    total = rows[:, :width].copy()
    for step in range(1, 2 * radius + 1):
        total += rows[:, step : step + width]
    return total


def patch_mean(values: Floats, known: npt.NDArray[np.bool_], radius: int) -> Floats:
    """Average what is known of (y, x) over patches; infinite where nothing is."""
    count = patch_sum(known.astype(values.dtype), radius)
    total = patch_sum(np.where(known, values, 0), radius)
    return np.divide(total, count, out=np.full_like(total, np.inf), where=count > 0)


def with_weight(values: Floats, weight: npt.NDArray[Any]) -> Floats:
    """Return values (y, x, value) times weights (y, x), and these behind; 0 if unknown."""
    weights = weight[..., np.newaxis].astype(np.float64)
    known = (weights > 0) & np.isfinite(values).all(axis=-1, keepdims=True)
    parts = np.where(known, values * weights, 0), np.where(known, weights, 0)
    return np.concatenate(parts, axis=-1)


def quotient(sums: Floats) -> Floats:
    """Return the averages of what `with_weight` has prepared; NaN where nothing has weight."""
    weight = sums[..., -1:]
    return np.divide(
        sums[..., :-1], weight, out=np.full_like(sums[..., :-1], np.nan), where=weight > 0
    )


def with_own(
    estimate: Floats, samples: npt.NDArray[np.floating[Any]], count: npt.NDArray[np.int64]
) -> npt.NDArray[Any]:
    """Put the mean of a channel's own good samples where there is no estimate, or no count."""
    missing = (count == 0) | ~np.isfinite(estimate).all(axis=-1)
    if missing.any():
        estimate[missing] = mean_of_good(samples[missing])
    return estimate.astype(samples.dtype)


def check_window(
    radius: int,
    *,
    patch: int = 0,
    alpha: float = 0.5,
    above_zero: Mapping[str, float] | None = None,
) -> None:
    """Refuse options of a shared estimator that are out of range."""
    whole("radius", radius, least=0)
    whole("patch", patch, least=0)
    if not 0 < alpha < 1:
        message = f"alpha must lie between 0 and 1, got {alpha}"
        raise InputError(message)
    for name, value in (above_zero or {}).items():
        if not value > 0:
            message = f"{name} must be larger than 0, got {value}"
            raise InputError(message)


def _pool(
    weigh: Weigh, fields: list[Floats], values: Floats, squares: Floats, radius: int
) -> tuple[Floats, Floats]:
    sums, squared = values.copy(), squares.copy()
    height, width = values.shape[:2]
    for here, there in _pairs(height, width, radius):
        weight = weigh(tuple(f[here] for f in fields), tuple(f[there] for f in fields))
        weight = weight[..., np.newaxis]
        for target, source in ((here, there), (there, here)):
            sums[target] += weight * values[source]
            squared[target] += weight**2 * squares[source]
    return sums, squared


def _pairs(
    height: int, width: int, radius: int
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Yield, for every offset in one half of the window, the places of both pixels of the pairs."""
    for dy in range(min(radius, height - 1) + 1):
        most = min(radius, width - 1)
        for dx in range(-most if dy else 1, most + 1):
            left, right = (
                slice(max(-dx, 0), width - max(dx, 0)),
                slice(max(dx, 0), width + min(dx, 0)),
            )
            yield (slice(0, height - dy), left), (slice(dy, height), right)


@register(
    "delbracio2014",
    source="Delbracio et al. 2014, doi:10.1145/2532708",
    uses_neighbours=True,
    joint_channels=True,
)
def delbracio2014(
    x: npt.ArrayLike,
    *,
    threshold: float = 1.0,
    radius: int = 6,
    patch: int = 1,
    unit: float | None = None,
) -> npt.NDArray[np.floating[Any]]:
    """Ray histogram fusion: average patches whose samples have alike histograms.

    Pixels i and j share their samples if ``chi^2 = sum (n_j h_i - n_i h_j)^2 / (n_i n_j (h_i +
    h_j)) <= threshold`` per used bin, summed over a patch around each and over the channels. Bins
    are used that hold more than one sample of both. Every patch that is alike lends all its pixels.

    Histogram and distance are those of the code of Bayesian collaborative denoising, a successor.
    The coarse scales of the publication are left out, and the sums over patches that overlap are
    divided once, by all their weights.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    threshold
        Distance up to which patches are alike, larger than 0; 1 is what noise gives.
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
    check_window(radius, patch=patch, above_zero={"threshold": threshold})
    samples = as_pixels(x, image=True)
    image = ScaledSamples.of(samples)
    mean = image.mean()
    found = exposure_unit(mean.mean(axis=-1) * image.unit, unit)
    counts = image.count[..., np.newaxis].astype(np.float64)
    fields = (histograms(image, found), counts)

    def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
        distance, used = chi_square(*here, *there)
        alike = patch_sum(distance, patch) <= threshold * patch_sum(used, patch)
        # A patch lends to each of its pixels what lies at the same place of the other patch.
        return patch_sum(alike.astype(np.float64), patch) / (2 * patch + 1) ** 2

    values = with_weight(mean, image.count)
    sums, _ = pool(weigh, fields, values, radius=radius, reach=2 * patch)
    return with_own(quotient(sums) * image.unit, samples, image.count)


@register(
    "sakai2024",
    source="Sakai et al. 2024, doi:10.1145/3680528.3687591",
    minimum_samples=2,
    uses_neighbours=True,
    joint_channels=True,
)
def sakai2024(
    x: npt.ArrayLike, *, alpha: float = 0.005, radius: int = 5
) -> npt.NDArray[np.floating[Any]]:
    """Statistical denoising: average pixels whose means do not differ significantly.

    Pixels i and j share their samples if, in every channel, ``(m_i - m_j)^2 <= t_i^2 SE_i^2 + t_j^2
    SE_j^2``: Welch's test on the samples after a Box-Cox transform with lambda = 1/2, their means
    corrected for skewness as by Johnson. The estimate is the mean of all their samples.

    Formulas are those of the authors' published code; the root of a negative sample is ours, minus
    that of its size (Bickel and Doksum 1981). Of their denoiser this is the membership of
    pixels; its Gaussian weights in space and in albedo and normals are left out, and its window is
    a square.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    alpha
        Level of the two-sided test, between 0 and 1: the smaller, the more is shared.
    radius
        Of the window, in pixels: 5 for 11 x 11.

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
    [1.0, 1.0, 95.0, 95.0]
    """
    check_window(radius, alpha=alpha)
    samples = as_pixels(x, minimum=2, image=True)
    image = ScaledSamples.of(samples)
    # 2 (sqrt(x) - 1) gives the same test as sqrt(x).
    fields = significance(corrected_means(image, root), image.count, alpha)
    values = with_weight(image.mean(), image.count)
    sums, _ = pool(not_different, fields, values, radius=radius)
    return with_own(quotient(sums) * image.unit, samples, image.count)
