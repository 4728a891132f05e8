"""Shapes: how far a mean may lie above what the other samples of its pixel say.

`shared_shape` learns that from similar pixels and averages nothing: it removes fireflies, and
leaves noise and edges to a denoiser. It is new here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, whole
from chdstat.estimators import similarity
from chdstat.estimators.registry import (
    Array,
    Floats,
    check_positive,
    check_probability,
    mean_of_good,
    register,
)

__all__ = ["ShapeStatistics", "shared_shape"]

_ROUNDING = 1e-6
_LIMIT, _ALPHA, _AROUND = 1.75, 0.005, 5
_OURS = "this library, after Sakai et al. 2024, doi:10.1145/3680528.3687591"


@register("shared_shape", _OURS, place=7, minimum_samples=2, uses_neighbours=True)
def shared_shape(
    x: Array, *, limit: float = _LIMIT, alpha: float = _ALPHA, radius: int = _AROUND
) -> Array:
    """Mean of the pixel, limited by the shape that its samples share with those of similar pixels.

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
    whole("radius", radius, least=0)
    check_probability(alpha=alpha)
    check_positive(limit=limit)
    image = similarity.ScaledSamples.of(as_pixels(x, minimum=2))
    measured = ShapeStatistics.of(image)
    return measured.or_mean(measured.limited(limit, alpha, radius))


@dataclass(frozen=True)
class ShapeStatistics:
    """What `shared_shape` has to know of the samples of each pixel, and nothing of its neighbours.

    So a part of an image at a time is enough.

    Attributes
    ----------
    good_mean
        Mean of each channel's good samples, shape (y, x, channel) as all but `count`.
    mean, below
        Mean of the samples whose channels are all good, 0 for negative ones, and what these add.
    level, positive
        Levels, and numbers of positive samples, without the largest sample.
    shape, error
        Of `similarity.shape_means`, and its squared standard error.
    count
        Number of samples whose channels are all good, shape (y, x).
    """

    good_mean: Floats
    mean: Floats
    below: Floats
    level: Floats
    positive: Floats
    shape: Floats
    error: Floats
    count: npt.NDArray[np.number[Any]]

    @classmethod
    def of(cls, image: similarity.ScaledSamples) -> ShapeStatistics:
        """Measure the samples of each pixel."""
        below = np.minimum(image.samples, 0).sum(axis=-1, dtype=np.float64)
        below /= np.maximum(image.count, 1)[..., np.newaxis]
        mean, (level, positive) = image.mean() * image.unit - below, _level(image)
        shape, error = similarity.shape_means(image)
        return cls(
            mean_of_good(image.given),
            mean,
            below,
            level * image.unit,
            positive,
            shape,
            error,
            image.count,
        )

    def limited(
        self, limit: float = _LIMIT, alpha: float = _ALPHA, radius: int = _AROUND
    ) -> Floats:
        """Return the means, that of the positive samples limited by the shape of what is around."""
        level, mean = self.level, self.mean.copy()
        known = (level > 0) & (mean > 0)
        depth = np.divide(level, mean, out=np.zeros_like(mean), where=known)
        weight = np.where(known, self.positive, 0)
        fields = similarity.significance((self.shape, self.error), self.count, alpha)
        around, _ = similarity.Window(similarity.not_different, fields, radius).average(
            depth, weight
        )
        by_shape = np.divide(level, around, out=mean.copy(), where=known & (around > 0))
        return np.asarray(np.minimum(mean, limit * by_shape, out=mean, where=known) + self.below)

    def or_mean(self, found: Floats) -> Floats:
        """Return estimates, or the mean of a channel's good samples where there is none."""
        missing = (self.count == 0) | ~np.isfinite(found).all(axis=-1)
        return np.asarray(np.where(missing[..., np.newaxis], self.good_mean, found))


def _level(image: similarity.ScaledSamples) -> tuple[Floats, ...]:
    """Return levels and the number k of positive samples, without the largest sample."""

    def work(rows: Floats, _: object, n: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
        kept = np.maximum(similarity.without_largest(rows), 0)
        positive = np.count_nonzero(kept, axis=-1).astype(np.float64)
        total = np.sqrt(kept).sum(axis=-1)
        pairs = total**2 - kept.sum(axis=-1)
        # What is left of a single sample, or of one among many darker by far, is rounding.
        pairs[pairs < _ROUNDING * total**2] = 0
        return pairs / (np.maximum(positive - 1, 1) * np.maximum(n, 1)), positive

    return image.walk(work)
