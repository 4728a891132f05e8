"""Shapes: limit a pixel's mean by the shape of the distributions around it.

`shared_shape` learns from similar pixels how far a mean lies above the level of the other samples.
It averages no pixels: it removes fireflies, and leaves noise and edges to a denoiser. It is new
here.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Reals, as_pixels, whole
from chdstat.errors import check_probability
from chdstat.estimators import similarity
from chdstat.estimators.registry import check_positive, register

_ROUNDING, _EQUAL = 1e-6, 1e-13
_LIMIT, _ALPHA = 1.75, 0.005
RADIUS = 5
"""Radius of the window, in pixels."""
_OURS = "this library, after Sakai et al. 2024, doi:10.1145/3680528.3687591"


@register("shared_shape", _OURS, place=7, minimum_samples=2, uses_neighbours=True)
def shared_shape(
    x: Reals, *, limit: float = _LIMIT, alpha: float = _ALPHA, radius: int = RADIUS
) -> Reals:
    """Mean of the pixel, limited by the shape that its samples share with those of similar pixels.

    ``min(mean_i, limit l_i / average_j(l_j / mean_j))``. The level ``l = p E(sqrt x)^2`` is
    computed without the largest sample, so one firefly does not move it: ``p (S^2 - sum x) / (k (k
    - 1))``, where k of the n samples are above 0, p = k / n, and S is the sum of their roots. The
    ratio of level to mean is averaged over the members j, weighted by k. A mean that exceeds its
    level by more than `limit` times the usual ratio is attributed to fireflies.

    The members are the pixels whose shape does not differ significantly from that of i in any
    channel: Welch's test on ``mean(x^(1/4)) / mean(x^(1/2))^(1/2)``, again without the largest
    sample. Only ratios of other pixels enter, not their radiance, so no light crosses an edge. The
    estimate is too dark. All this applies to positive samples; negative samples are added
    unchanged.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). Samples with a NaN or infinite channel are left out.
    limit
        Larger than 0; infinity gives the mean. At 32 samples of rendered scenes, 1.75 loses about 1
        % of the energy, and 1.25 two to three times as much.
    alpha
        Level of the two-sided test, between 0 and 1. A smaller level has more members.
    radius
        Radius of the window, in pixels: 5 for 11 x 11.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`, at most the mean of the
        samples that are good in all channels. Where none is, or a channel has fewer than 3 above 0,
        the mean of the channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, has fewer than 2 samples, or an option is out of range.

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
    return ShapeStatistics.of(PowerSums.of(as_pixels(x, minimum=2))).limited(limit, alpha, radius)


@dataclass
class PowerSums:
    """Sums over the samples of each pixel; means, errors and shapes follow from them.

    Samples are added one after the other, so the sums do not depend on how they are cut into
    batches. Memory does not depend on their number.

    Attributes
    ----------
    good, total, square
        Number of good samples of each channel, their sum and the sum of their squares. These and
        all other fields but `count` and `null` have shape (y, x, channel).
    above, fourth, root, product, positive, below, largest
        Over the samples that are good in all channels: how many are above 0; the sums of the
        positive samples to the powers 1/4, 1/2, 3/4 and 1; the sum of the negative samples; and the
        largest sample (at least 0).
    count, null
        Number of samples that are good in all channels, and of null samples, shape (y, x).
    """

    good: Floats
    total: Floats
    square: Floats
    above: Floats
    fourth: Floats
    root: Floats
    product: Floats
    positive: Floats
    below: Floats
    largest: Floats
    count: Floats
    null: Floats

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> PowerSums:
        """Return the sums of an image (y, x, channel) without samples."""
        sizes = {"count": shape[:2], "null": shape[:2]}
        return cls(**{field.name: np.zeros(sizes.get(field.name, shape)) for field in fields(cls)})

    @classmethod
    def of(cls, x: npt.NDArray[np.floating[Any]]) -> PowerSums:
        """Return sums over samples (y, x, channel, sample)."""
        found = cls.empty(x.shape[:3])
        found.update(x)
        return found

    def update(self, x: npt.NDArray[np.floating[Any]]) -> None:
        """Add samples (y, x, channel, sample)."""
        for i in range(x.shape[-1]):
            sample = x[..., i].astype(np.float64)
            good = np.asarray(np.isfinite(sample))
            sample = np.where(good, sample, 0)
            whole = np.asarray(good.all(axis=-1))
            kept = sample if whole.all() else np.where(whole[..., np.newaxis], sample, 0)
            positive = np.maximum(kept, 0)
            self.good += good
            self.total += sample
            with np.errstate(over="ignore"):  # float64 samples may be of any size
                self.square += sample * sample
            self.above += kept > 0
            for sums, power in zip(self._powers(), _powers(positive), strict=True):
                sums += power
            self.below += np.minimum(kept, 0)
            np.maximum(self.largest, positive, out=self.largest)
            self.count += whole
            self.null += (x[..., i] == 0).all(axis=-1)

    def _powers(self) -> tuple[Floats, ...]:
        return self.fourth, self.root, self.product, self.positive

    def part(self, rows: slice, columns: slice = slice(None)) -> PowerSums:
        """Return the sums of a part of the image; they share its memory."""
        return PowerSums(**{name: sums[rows, columns] for name, sums in vars(self).items()})

    def merged(self, other: PowerSums) -> PowerSums:
        """Return the sums over the samples of both."""
        added = {name: value + getattr(other, name) for name, value in vars(self).items()}
        return PowerSums(**added | {"largest": np.maximum(self.largest, other.largest)})

    def mean(self) -> Floats:
        """Return the mean of each channel's good samples; NaN where there is none."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.total / self.good)

    def error(self) -> Floats:
        """Return the standard error of that mean; for one sample, as large as the mean."""
        n = np.maximum(self.good, 1)
        spread = np.maximum(self.square - self.total**2 / n, 0)
        # The variance of equal samples is rounding.
        spread = np.where(spread > _EQUAL * self.square, spread, 0)
        error = np.sqrt(spread / (n * np.maximum(n - 1, 1)))
        return np.asarray(np.where(n == 1, np.abs(self.total), error))


def _powers(x: Floats) -> tuple[Floats, ...]:
    """Return the fourth root, the root, their product and x itself."""
    root = np.sqrt(x)
    fourth = np.sqrt(root)
    return fourth, root, fourth * root, x


@dataclass(frozen=True)
class ShapeStatistics:
    """Statistics of the samples of each pixel that `shared_shape` needs.

    They do not depend on other pixels, so an image can be measured in parts.

    Attributes
    ----------
    mean, below
        Mean of the samples that are good in all channels, with negative ones as 0, and the mean of
        the negative ones, with others as 0. These and all other fields but `count` have shape (y,
        x, channel).
    level, positive
        Level and number of the positive samples, without the largest.
    shape, error
        ``mean(x^(1/4)) / mean(x^(1/2))^(1/2)`` and its squared standard error, without the largest
        sample.
    count
        Number of samples that are good in all channels, shape (y, x).
    """

    mean: Floats
    below: Floats
    level: Floats
    positive: Floats
    shape: Floats
    error: Floats
    count: npt.NDArray[np.number[Any]]

    @classmethod
    def of(cls, sums: PowerSums) -> ShapeStatistics:
        """Measure the samples of each pixel.

        The shape ``mean(x^(1/4)) / mean(x^(1/2))^(1/2)`` does not depend on the scale. It is 1 for
        equal samples, and smaller the more they differ or are null. Its error follows from the
        delta method.
        """
        count = sums.count[..., np.newaxis]
        below = sums.below / np.maximum(count, 1)
        mean = sums.positive / np.where(count > 0, count, np.nan)
        # The largest sample is left out, so that a firefly does not change the shape.
        fourth, root, product, kept = (
            np.maximum(total - largest, 0)
            for total, largest in zip(sums._powers(), _powers(sums.largest), strict=True)
        )
        positive = np.maximum(sums.above - 1, 0)
        pairs = root**2 - kept
        # For a single sample, or one among many far darker, the difference is rounding.
        pairs[(pairs < _ROUNDING * root**2) | (positive < 2)] = 0
        level = pairs / (np.maximum(positive - 1, 1) * np.maximum(count, 1))
        m = np.maximum(count - 1, 0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            a, b, c, d = (np.where(positive > 0, k, 0) / m for k in (fourth, root, product, kept))
            # var(v) / b - a cov(v, v^2) / b^2 + a^2 var(v^2) / (4 b^3), with a = E v and b = E v^2.
            relative = (b - a * a) / b - a * (c - a * b) / b**2 + a * a * (d - b * b) / (4 * b**3)
            error = np.maximum(relative, 0) / np.where(m > 1, m - 1, np.nan)
            shape = a / np.sqrt(b)
        return cls(mean, below, level, positive, shape, error, sums.count)

    def limited(self, limit: float = _LIMIT, alpha: float = _ALPHA, radius: int = RADIUS) -> Floats:
        """Return the means, with the mean of the positive samples limited by the shapes around.

        NaN where no sample is good in all channels.
        """
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
