"""Error model: how large the errors of estimates are, from pixels that did not train the network.

The samples that an estimate p has not seen are cut in two. Their means t and u are independent and
unbiased, and so ``(p - t)(p - u)`` has the expectation ``(p - y)^2`` whatever the truth y is: a
`ValidationBatch` measures errors without a reference.

Squared errors are explained by a sum of error terms, each with a weight that is not negative. The
radiance of a pixel is then taken for gamma distributed with the estimate for its mean and that
variance. With references the weights are least squares, and quantiles are calibrated by split
conformal prediction (Lei et al. 2018, doi:10.1080/01621459.2017.1307116), separately for dark and
for bright estimates.

Without a reference the products are so noisy that few pixels cannot tell six weights apart, and an
image whose rare bright samples have not come yet seems to have no errors. So the weights keep the
proportions `USUAL`, and one scale k is measured,

    k = sum w s / sum w v,    w = v / (v + n)^2,

s being the products, v what the usual weights expect, and n the noise of the target: the weights of
a ratio whose terms have the variance ``2 (v + n)^2``. Then the upper end of its one-sided 95 %
confidence interval is taken in place of k, with the standard error of a ratio of sums over pixels
(Cochran 1977, Sampling Techniques, 6.4): an interval that is too wide claims less than one that is
too narrow. The noise of a pixel that has not had its bright samples yet is underestimated, its
weight is too large, and its distance from the target, too: this also errs on the side of width.
Quantiles are normal ones: where errors are mixtures of many sizes, these hold 90 % nearly as often
as they say, whatever the mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from scipy import interpolate, optimize, special

from chdstat.estimators.progressive.dataset import TrainingSet
from chdstat.estimators.progressive.inputs import LEVELS as BRIGHTNESS
from chdstat.estimators.progressive.inputs import LOSSES
from chdstat.estimators.progressive.profile import Profile
from chdstat.estimators.progressive.splits import Minibatch

if TYPE_CHECKING:
    from torch import nn

    from chdstat.estimators.progressive.network import NetworkOutput

__all__ = [
    "BALANCES",
    "BRIGHTNESS",
    "DARK",
    "ERROR_TERMS",
    "LEVELS",
    "USUAL",
    "ErrorModel",
    "ValidationBatch",
    "error_terms_of",
    "ratio",
    "upper_bound",
    "validation_batches",
]

ERROR_TERMS = 6
DARK = 0.02
"""Radiance, in units of the image's, below which errors no longer fall with it."""

Floats = npt.NDArray[np.floating[Any]]


def error_terms_of(output: NetworkOutput, profile: Profile, loss: int) -> Floats:
    """Return the terms of squared errors, shape (row, channel, term), float64.

    A constant for the dark, the square of the estimate, of its distance to the mean, the variance
    of the mean and what the estimate takes over of it, and the square of the mean where the
    estimate does not rest on it.
    """
    estimate, mean, certainty = (
        t.cpu().numpy().astype(np.float64)
        for t in (output.estimate[:, loss], output.mean, output.certainty[:, loss, None])
    )
    noise = profile.variance_of_mean()
    error_terms = (
        np.full_like(estimate, DARK**2),
        estimate**2,
        (estimate - mean) ** 2,
        noise,
        (1 - certainty) ** 2 * noise,
        certainty**2 * mean**2,
    )
    return np.stack(error_terms, axis=-1)


_DRAWS, _TIMES, _SAMPLES = 16, 4, 256
"""Splits of each size, of each pixel on average, and samples of a pixel in all of these, at least:
few samples of a lamp or a firefly are noisy."""
_ROWS = 1024
_CUTS = 4
"""Ways to cut the other samples in two: together they tell their noise better than one does. With a
reference it is small, and one tells enough."""


@dataclass(frozen=True)
class ValidationBatch:
    """Estimates of some pixels, in units of the image's radiance.

    Attributes
    ----------
    size
        Samples of each estimate.
    rows
        Which pixels, shape (row,).
    estimate
        Shape (loss, row, channel).
    mean, target
        Of the samples that were seen and of the others, shape (row, channel).
    noise
        Unbiased for the variance of the target, shape (row, channel).
    error_terms
        Of squared errors, shape (loss, row, channel, term).
    """

    size: int
    rows: npt.NDArray[np.int64]
    estimate: Floats
    mean: Floats
    target: Floats
    noise: Floats
    error_terms: Floats

    @property
    def squared(self) -> Floats:
        """Unbiased for the squared error of the estimate, shape (loss, row, channel)."""
        return np.asarray((self.estimate - self.target) ** 2 - self.noise)

    @classmethod
    def of(
        cls,
        network: nn.Module,
        training_set: TrainingSet,
        part: Minibatch,
        rng: np.random.Generator,
    ) -> Self:
        """Estimate from a part of the samples."""
        import torch

        from chdstat.estimators.progressive.network import encode

        with torch.inference_mode():
            output = network(
                encode(part.profile, training_set.auxiliary[part.rows], part.shared, "cpu")
            )
        times = 1 if training_set.config.reference else _CUTS
        noise = [training_set.splits.halves(part, rng).noise for _ in range(times)]
        return cls(
            size=part.size,
            rows=part.rows,
            estimate=np.moveaxis(output.estimate.numpy().astype(np.float64), 1, 0),
            mean=output.mean.numpy().astype(np.float64),
            target=part.target.astype(np.float64),
            noise=np.mean(noise, axis=0),
            error_terms=np.stack(
                [error_terms_of(output, part.profile, loss) for loss in range(len(LOSSES))]
            ),
        )


def validation_batches(
    network: nn.Module,
    training_set: TrainingSet,
    *,
    pixels: npt.NDArray[np.int64],
    rng: np.random.Generator,
    samples: int = _SAMPLES,
) -> list[ValidationBatch]:
    """Return batches of pixels at all sizes of the training, four or more of each pixel.

    So many `samples` of a pixel are seen at least in all its batches of a size.
    """
    found = []
    for n in sorted(set(training_set.config.sizes)):
        drawn, least = 0, _DRAWS
        while least > 0 or drawn < max(_TIMES, samples / n) * len(pixels):
            part = training_set.splits.draw(pixels, n, _ROWS, rng)
            found.append(ValidationBatch.of(network, training_set, part, rng))
            drawn, least = drawn + len(part.rows), least - 1
    return found


USUAL = np.array([0.03, 0.03, 0.17, 0.05, 0.3, 0.0])
"""Weights of the error terms, up to their scale: about what errors against references have on
simulated and on rendered images, scaled to 1."""
_CONFIDENCE = 0.95
_LEAST = 1e-3
"""Scale that no measurement falls below, so that an interval is never a point."""


def upper_bound(batches: Sequence[ValidationBatch], loss: int) -> Floats:
    """Return weights of error terms under which squared errors are hardly larger than expected."""
    expected = [batch.error_terms[loss] @ USUAL for batch in batches]
    weights = [v / (v + n) ** 2 for v, n in zip(expected, _noise(batches), strict=True)]
    rows = np.concatenate([batch.rows for batch in batches])
    above, below = (
        np.bincount(rows, np.concatenate([(w * x).sum(axis=-1) for w, x in pairs]))
        for pairs in (
            zip(weights, (batch.squared[loss] for batch in batches), strict=True),
            zip(weights, expected, strict=True),
        )
    )
    scale, error = ratio(above, below)
    bound = max(scale, 0.0) + special.ndtri(_CONFIDENCE) * error
    # One pixel alone has no standard error: then what is usual is all that is known.
    return USUAL * max(bound if np.isfinite(bound) else 1.0, _LEAST)


def ratio(above: npt.NDArray[Any], below: npt.NDArray[Any]) -> tuple[float, float]:
    """Return a ratio of sums over pixels and its standard error; inf for fewer than two pixels.

    Parameters
    ----------
    above, below
        One of each a pixel; pixels with neither count for nothing.
    """
    total, pixels = float(below.sum()), int(np.count_nonzero(below))
    if not total > 0 or pixels < 2:
        return 0.0, np.inf
    found = float(above.sum()) / total
    squares = float(np.sum((above - found * below) ** 2))
    return found, float(np.sqrt(squares * pixels / (pixels - 1))) / total


def _noise(batches: Sequence[ValidationBatch]) -> list[Floats]:
    """Return the variances of the targets, each averaged over all batches of a pixel and size."""
    found: dict[int, Floats] = {}
    for size in {batch.size for batch in batches}:
        of_size = [batch for batch in batches if batch.size == size]
        rows = np.concatenate([batch.rows for batch in of_size])
        noise = np.concatenate([batch.noise for batch in of_size])
        count = np.maximum(np.bincount(rows), 1)
        sums = [np.bincount(rows, column) / count for column in noise.T]
        found[size] = np.stack(sums, axis=-1)
    return [found[batch.size][batch.rows] for batch in batches]


LEVELS = np.array([0.005, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.995])
"""Probabilities at which quantiles are calibrated."""
BALANCES = np.array([0.0, 0.5, 1.0])
"""Mixtures of the losses that quantiles are calibrated for; between them they are interpolated."""

_CALIBRATED = (len(BALANCES), len(BRIGHTNESS), len(LEVELS))
_CHANCE = 0.5
"""Standard errors that quantiles are taken farther out: then seven of ten are far enough."""
_FEW = 5
"""Pixels of a brightness that count as much as all others."""


@dataclass(frozen=True)
class ErrorModel:
    """What errors to expect, in units of the image's radiance.

    Attributes
    ----------
    weights
        Of the error terms, shape (loss, term).
    sizes
        Numbers of samples that quantiles were calibrated at, ascending; none without a reference.
    normal
        For each, the normal quantiles to take at `LEVELS` where an estimate is so bright, shape
        (size, balance, brightness, level).
    """

    weights: Floats
    sizes: Floats
    normal: Floats

    def __post_init__(self) -> None:
        expected = (len(LOSSES), ERROR_TERMS), (len(self.sizes), *_CALIBRATED)
        received = self.weights.shape, self.normal.shape
        if expected != received:
            message = f"weights and normal must have shapes {expected}, got {received}"
            raise ValueError(message)

    @classmethod
    def learn(
        cls,
        network: nn.Module,
        training_set: TrainingSet,
        *,
        pixels: npt.NDArray[np.int64],
        rng: np.random.Generator,
    ) -> Self:
        """Learn from splits of pixels that did not train the network."""
        batches = validation_batches(network, training_set, pixels=pixels, rng=rng)
        if not training_set.config.reference:
            weights = np.array([upper_bound(batches, loss) for loss in range(len(LOSSES))])
            return cls(weights, np.empty(0), np.empty((0, *_CALIBRATED)))
        weights = np.array([_weights(batches, loss) for loss in range(len(LOSSES))])
        sizes = sorted({batch.size for batch in batches})
        # Lamps are in all pixels, hardly in a tenth of them.
        all_of_them = np.arange(len(training_set.pixels))
        everywhere = validation_batches(
            network, training_set, pixels=all_of_them, rng=rng, samples=0
        )
        normal = [
            _calibrate(
                weights, *([t for t in part if t.size == n] for part in (batches, everywhere))
            )
            for n in sizes
        ]
        return cls(weights, np.array(sizes, np.float64), np.array(normal))

    def variance(self, error_terms: Floats, balance: float) -> Floats:
        """Return expected squared errors of mixed estimates, from terms (loss, ..., term)."""
        return _mixed(
            np.stack([c @ w for c, w in zip(error_terms, self.weights, strict=True)]), balance
        )

    def quantile(
        self,
        estimate: Floats,
        variance: Floats,
        count: npt.NDArray[Any],
        *,
        balance: float,
        level: float,
    ) -> Floats:
        """Return a quantile; estimate and variance (row, channel), samples (row,).

        Of a negative estimate, which signed samples make, it is that of a normal distribution.
        """
        z = self._normal(np.maximum(count, 1), _near(estimate), balance, level)[:, np.newaxis]
        mean = np.maximum(estimate, 0) + DARK
        root = 1 - variance / (9 * mean**2) + z * np.sqrt(variance) / (3 * mean)
        found = np.maximum(mean * np.maximum(root, 0) ** 3 - DARK, 0)
        return np.where(estimate < 0, estimate + z * np.sqrt(variance), found)

    def _normal(
        self, count: npt.NDArray[Any], near: Floats, balance: float, level: float
    ) -> Floats:
        if not len(self.sizes):
            return np.full(len(count), special.ndtri(level))
        places, place = special.ndtri(LEVELS), special.ndtri(level)
        # Beyond what was calibrated, tails go on as normal ones.
        beyond = place - np.clip(place, places[0], places[-1])
        at_level = interpolate.interp1d(places, self.normal)(place - beyond)
        known = interpolate.interp1d(BALANCES, at_level, axis=1)(balance) @ near.T + beyond
        size = np.interp(np.log2(count), np.log2(self.sizes), np.arange(len(self.sizes)))
        below, rows = np.floor(size).astype(np.int64), np.arange(len(count))
        above = np.minimum(below + 1, len(self.sizes) - 1)
        part = size - below
        return np.asarray((1 - part) * known[below, rows] + part * known[above, rows])


def _mixed(of_aims: Floats, balance: float) -> Floats:
    """Return the mixture of what two losses give, shape (loss, ...)."""
    return np.asarray((1 - balance) * of_aims[0] + balance * of_aims[1])


def _weights(batches: Sequence[ValidationBatch], loss: int) -> Floats:
    """Return the weights of the error terms by least squares, errors relative to the radiance."""
    error_terms = np.concatenate([t.error_terms[loss].reshape(-1, ERROR_TERMS) for t in batches])
    squared = np.concatenate([t.squared[loss].reshape(-1) for t in batches])
    scale = 1 / error_terms[:, :4].sum(axis=1)
    # The normal equations: tens of thousands of rows, six weights.
    scaled = error_terms * scale[:, np.newaxis]
    gram = np.linalg.cholesky(scaled.T @ scaled + 1e-9 * np.eye(ERROR_TERMS) * len(scaled))
    weights, _ = optimize.nnls(gram.T, np.linalg.solve(gram, scaled.T @ (squared * scale)))
    weights[0] = max(weights[0], 1e-4)
    return np.asarray(weights)


def _near(estimate: Floats) -> Floats:
    """Return how near estimates (row, channel) are to each of `BRIGHTNESS`; rows sum to 1."""
    octave = np.log2(np.maximum(estimate.mean(axis=-1), 1e-12))
    return np.stack(
        [np.interp(octave, BRIGHTNESS, level) for level in np.eye(len(BRIGHTNESS))], axis=-1
    )


def _calibrate(
    weights: Floats, batches: Sequence[ValidationBatch], everywhere: Sequence[ValidationBatch]
) -> Floats:
    """Return the normal quantiles of the truth, shape (balance, brightness, level).

    They are those of pixels that did not train. Among all pixels, those as bright may differ from
    the others, and so much is added (as Mondrian conformal prediction tells categories apart: Vovk
    2013, doi:10.1007/s10994-013-5355-6).
    """
    found = []
    for balance in BALANCES:
        held_out = _quantiles(*_normals(weights, batches, balance)[:2])
        normal, share, near = _normals(weights, everywhere, balance)
        usual, counts = _quantiles(normal, share), share @ near
        own = [
            _quantiles(normal, share * weight) if count > 0 else usual
            for weight, count in zip(near.T, counts, strict=True)
        ]
        known = counts / (counts + _FEW)
        found.append(held_out + known[:, np.newaxis] * (np.array(own) - usual))
    return np.array(found)


def _quantiles(normal: Floats, share: Floats) -> Floats:
    """Return quantiles at `LEVELS`, each as far from the middle as chance may have it.

    Of few pixels, too many would else be farther out (Vovk 2013, as above).
    """
    error = _CHANCE * np.sqrt(LEVELS * (1 - LEVELS) / share.sum())
    levels = np.clip(LEVELS + np.sign(LEVELS - 0.5) * error, 0, 1)
    return np.asarray(np.quantile(normal, levels, weights=share, method="inverted_cdf"))


def _normals(
    weights: Floats, batches: Sequence[ValidationBatch], balance: float
) -> tuple[Floats, Floats, Floats]:
    """Return normal places of truths, what share of a pixel each is, and how bright it seems.

    The cube root of a gamma variable is near normal (Wilson and Hilferty 1931,
    doi:10.1073/pnas.17.12.684).
    """
    estimate = _mixed(np.concatenate([t.estimate for t in batches], axis=1), balance)
    error_terms = np.concatenate([t.error_terms for t in batches], axis=1)
    truth = np.concatenate([t.target for t in batches]) + DARK
    rows = np.concatenate([t.rows for t in batches])
    variance = _mixed(np.stack([c @ w for c, w in zip(error_terms, weights, strict=True)]), balance)
    mean = estimate + DARK
    usable = mean >= DARK
    mean = np.where(usable, mean, DARK)
    spread = np.sqrt(variance) / (3 * mean)
    normal = (np.cbrt(truth / mean) - 1 + spread**2) / spread
    share = usable / (np.bincount(rows)[rows] * estimate.shape[-1])[:, np.newaxis]
    near = np.broadcast_to(_near(estimate)[:, np.newaxis], (*estimate.shape, len(BRIGHTNESS)))
    return normal[usable], share[usable], near[usable]
