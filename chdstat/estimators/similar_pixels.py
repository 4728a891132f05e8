"""Shared statistics, ours: patches alike in two passes, and shapes alike without their level.

`shared_patches` averages pixels whose surroundings are statistically alike; on rendered scenes at
32 samples, its error is the smallest of all that are not learned. `shared_shape` learns from alike
pixels only how far a mean may lie above what the other samples of the pixel say, and averages
nothing: it removes fireflies, and leaves noise and edges to a denoiser.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels
from chdstat.errors import InputError
from chdstat.estimators.neighbourhood import (
    check_window,
    patch_mean,
    patch_sum,
    pool,
    quotient,
    with_own,
    with_weight,
)
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats
from chdstat.estimators.similarity import (
    Means,
    ScaledSamples,
    corrected_means,
    not_different,
    root,
    shape_means,
    significance,
    without_largest,
)

__all__ = ["Fireflies", "shared_patches", "shared_shape"]

Fireflies = Literal["limit", "keep"]

_FIRST, _SECOND = 0.3, 0.5
"""How fast weights fall with the distance, in the first and in the second pass."""
_CORRELATED = 3.0
"""Factor on the variances of means that have been averaged once: neighbours share their samples,
and what they share was chosen for being alike."""
_HUE = 0.02
"""Difference between channels, relative to their level, that tells nothing: light takes on the
colour of what is around."""
_ROUNDING = 1e-6
_LIMIT, _ALPHA, _AROUND = 1.75, 0.005, 5
"""Defaults of `shared_shape`."""
_CUT = 7.0
"""Weights below e^-7 are none."""
_FAR = 1e6


@register(
    "shared_patches",
    source="this library, after Sakai et al. 2024, doi:10.1145/3680528.3687591",
    minimum_samples=2,
    uses_neighbours=True,
    joint_channels=True,
)
def shared_patches(
    x: npt.ArrayLike,
    *,
    threshold: float = 1.0,
    radius: int = 5,
    patch: int = 1,
    fireflies: Fireflies = "limit",
) -> npt.NDArray[np.floating[Any]]:
    """Average pixels whose patches are statistically alike, in two passes.

    The distance of two pixels is Welch's statistic, ``d = (m_i - m_j)^2 / (SE_i^2 + SE_j^2)``,
    averaged over the pixels of a patch around each and over statistics: the mean of the samples, of
    their roots, and of the differences between the roots of neighbouring channels. They share with
    weight ``exp(-max(0, d - threshold) / s)``; noise alone gives d = 1. Patches lend all their
    pixels, as in non-local means, except to pixels that differ significantly by the test of
    `sakai2024`. A first pass (s = 0.3) averages the statistics. A second (s = 0.5) compares these
    averages, whose errors are several times smaller, and averages the estimates.

    Test and transform are those of `sakai2024`, patches those of `delbracio2014`. A single pixel
    tells too little: its error may be large for one firefly, or small because none has come yet.
    The second pass is that of Rousselle et al. 2012. Weights, statistics and passes are ours.

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
    check_window(radius, patch=patch, above_zero={"threshold": threshold})
    if fireflies not in ("limit", "keep"):
        message = f"fireflies must be 'limit' or 'keep', got {fireflies!r}"
        raise InputError(message)
    samples = as_pixels(x, minimum=2, image=True)
    image = ScaledSamples.of(samples)
    own = image.mean() if fireflies == "keep" else _limited(image, _LIMIT, _ALPHA, _AROUND)
    window = _Patches(threshold, radius, patch, _members(image))
    means = window.averaged(_statistics(image), image.count)
    sums, _ = window.pool(means, _SECOND, with_weight(own, image.count > 0))
    return with_own(quotient(sums) * image.unit, samples, image.count)


@register(
    "shared_shape",
    source="this library, after Sakai et al. 2024, doi:10.1145/3680528.3687591",
    minimum_samples=2,
    uses_neighbours=True,
    joint_channels=True,
)
def shared_shape(
    x: npt.ArrayLike, *, limit: float = _LIMIT, alpha: float = _ALPHA, radius: int = _AROUND
) -> npt.NDArray[np.floating[Any]]:
    """Mean of the pixel, limited by the shape that its samples share with those of alike pixels.

    ``min(mean_i, limit l_i / average_j(l_j / mean_j))``. The level ``l = p E(sqrt x)^2`` is that of
    the samples but the largest: k of them are above 0, p = k / n, and all pairs of these estimate
    it, ``p (S^2 - sum x) / (k (k - 1))`` with S the sum of their roots. One firefly does not move
    it. How far means lie above levels is learned from the members j, each in its own unit and
    weighted by k: a mean that lies further above than `limit` times that owes it to fireflies.

    Members have a shape that does not differ significantly from that of i, in any channel: Welch's
    test on ``mean(x^(1/4)) / mean(x^(1/2))^(1/2)``, again without the largest sample. No radiance
    of another pixel enters, only the ratio of its level to its mean, so none crosses an edge. The
    bias is to the dark. All of this is about the positive samples; negative ones are added as they
    are.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    limit
        Larger than 0; infinity for the mean. At 32 samples of rendered scenes, 1.75 loses about 1 %
        of the energy and 1.25 twice to three times that.
    alpha
        Level of the two-sided test, between 0 and 1: the smaller, the more is shared.
    radius
        Of the window, in pixels: 5 for 11 x 11.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`, at most the mean of the
        whole samples that are good. Where none is, or a channel has less than 3 above 0, the mean
        of its good samples; NaN where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, has less than 2 samples, or an option is out of range.

    References
    ----------
    H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer, "A statistical approach to Monte Carlo
    denoising", SIGGRAPH Asia Conference Papers, 2024, doi:10.1145/3680528.3687591.

    Examples
    --------
    >>> image = np.random.default_rng(0).gamma(4.0, size=(8, 8, 3, 32))
    >>> image *= np.linspace(1, 100, 8).reshape(8, 1, 1, 1)
    >>> image[3, 3, :, 0] = 1e6
    >>> found = shared_shape(image)
    >>> found[2:5, 3, 0].round().tolist()
    [108.0, 338.0, 205.0]
    """
    check_window(radius, alpha=alpha, above_zero={"limit": limit})
    samples = as_pixels(x, minimum=2, image=True)
    image = ScaledSamples.of(samples)
    found = _limited(image, limit, alpha, radius)
    return with_own(found * image.unit, samples, image.count)


def _limited(image: ScaledSamples, limit: float, alpha: float, radius: int) -> Floats:
    """Return the means, that of the positive samples limited by the shape of what is around."""
    below = image.mean_below_zero()
    mean = image.mean() - below
    level, positive = _level(image)
    known = (level > 0) & (mean > 0)
    depth = np.divide(level, mean, out=np.zeros_like(mean), where=known)
    weight = np.where(known, positive, 0)
    fields = significance(shape_means(image), image.count, alpha)
    values = np.concatenate([weight * depth, weight], axis=-1)
    depths, weights = np.split(pool(not_different, fields, values, radius=radius)[0], 2, axis=-1)
    by_shape = np.divide(level * weights, depths, out=mean.copy(), where=known & (depths > 0))
    return np.minimum(mean, limit * by_shape, out=mean, where=known) + below


def _level(image: ScaledSamples) -> tuple[Floats, Floats]:
    """Return levels and the number k of positive samples, without the largest sample."""

    def work(rows: Floats, _: object, n: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
        kept = np.maximum(without_largest(rows), 0)
        positive = np.count_nonzero(kept, axis=-1).astype(np.float64)
        total = np.sqrt(kept).sum(axis=-1)
        pairs = total**2 - kept.sum(axis=-1)
        # What is left of a single sample, or of one among many darker by far, is rounding.
        pairs[pairs < _ROUNDING * total**2] = 0
        return pairs / (np.maximum(positive - 1, 1) * np.maximum(n, 1)), positive

    level, positive = image.walk(work)
    return level, positive


def _statistics(image: ScaledSamples) -> Means:
    """Return means of samples, of their roots and of the differences of these between channels."""

    def transform(rows: Floats) -> Floats:
        roots = root(rows)
        return np.concatenate([rows, roots, -np.diff(roots, axis=-2)], axis=-2)

    means = corrected_means(image, transform)
    channels = image.samples.shape[2]
    roots = means.value[..., channels : 2 * channels].mean(axis=-1, keepdims=True)
    # Equal samples differ by rounding alone.
    floor = (_ROUNDING * means.value) ** 2
    floor[..., 2 * channels :] = (_HUE * roots) ** 2
    return Means(means.value, means.variance + floor)


def _members(image: ScaledSamples) -> tuple[Floats, Floats]:
    """Return what `sakai2024` compares, at its default level."""
    return significance(corrected_means(image, root), image.count, _ALPHA)


@dataclass(frozen=True)
class _Patches:
    """Weights by the distance of patches, 0 where two pixels differ significantly."""

    threshold: float
    radius: int
    patch: int
    members: tuple[Floats, Floats]

    def averaged(self, means: Means, count: npt.NDArray[np.int64]) -> Means:
        """Return statistics averaged over what is alike, and the variances of the averages."""
        values = with_weight(means.value, count > 0)
        squares = np.nan_to_num(means.variance, posinf=0)
        sums, squared = self.pool(means, _FIRST, values, squares)
        with np.errstate(divide="ignore", invalid="ignore"):
            return Means(quotient(sums), _CORRELATED * squared / sums[..., -1:] ** 2)

    def pool(
        self, means: Means, scale: float, values: Floats, squares: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Add up what lies around, by how alike it is in terms of some statistics."""
        fields = (means.value, means.variance, *self.members)

        def weigh(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
            distance = _distance(here[:2], there[:2])
            apart = patch_mean(np.minimum(distance, _FAR), np.isfinite(distance), self.patch)
            excess = np.maximum(apart - self.threshold, 0) / scale
            weight = np.where(excess < _CUT, np.exp(-np.minimum(excess, _CUT)), 0)
            lent = patch_sum(weight, self.patch) / (2 * self.patch + 1) ** 2
            return lent * not_different(here[2:], there[2:])

        reach = 2 * self.patch
        return pool(weigh, fields, values, squares, radius=self.radius, reach=reach)


def _distance(here: tuple[Floats, ...], there: tuple[Floats, ...]) -> Floats:
    """Return Welch's statistic, squared and averaged over the statistics."""
    (mean, variance), (other, its) = here, there
    with np.errstate(over="ignore", invalid="ignore"):
        apart = (mean - other) ** 2
        both = variance + its
        # Pixels that are black without noise are alike.
        found = np.divide(apart, both, out=np.zeros_like(apart), where=(both > 0) | ~(apart >= 0))
        # A product adds short rows up several times faster than a mean does.
        return np.asarray(found @ np.full(found.shape[-1], 1 / found.shape[-1]))
