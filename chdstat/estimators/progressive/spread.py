"""Spread: how large the errors of the estimates are, learned from pixels that did not train them.

The samples that an estimate p has not seen are cut in two. Their means t and u are independent and
unbiased, and so ``(p - t)(p - u)`` has the expectation ``(p - y)^2`` whatever the truth y is: this
tells errors without a reference. They are explained by a sum of what may cause them, each with a
weight that is not negative.

The radiance of a pixel is then taken for gamma distributed with the estimate for its mean and that
variance. Where references tell, quantiles are calibrated by split conformal prediction (Lei et al.
2018, doi:10.1080/01621459.2017.1307116).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from scipy import optimize, special

from chdstat.estimators.progressive.lessons import Material, Scenery
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.shapes import AIMS
from chdstat.estimators.progressive.splits import Part, Splits

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Answer, Network

__all__ = ["BALANCES", "CAUSES", "LEVELS", "Spread", "causes_of"]

CAUSES = 6
LEVELS = np.array([0.005, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.995])
"""Probabilities at which quantiles are calibrated."""
BALANCES = np.array([0.0, 0.5, 1.0])
"""Mixtures of the aims that quantiles are calibrated for; between them they are interpolated."""
_DARK = 0.02
"""Radiance, in units of the picture's, below which errors no longer fall with it."""
_DRAWS = 16
"""Splits of each size that errors are learned from."""
_ROWS = 1024

Floats = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Spread:
    """What errors to expect, in units of the picture's radiance.

    Attributes
    ----------
    weights
        Of the causes of squared errors, shape (aim, cause).
    sizes
        Numbers of samples that quantiles were calibrated at, ascending; none without a reference.
    normal
        For each, the normal quantiles to take at `LEVELS`, shape (size, balance, level).
    """

    weights: Floats
    sizes: Floats
    normal: Floats

    def __post_init__(self) -> None:
        expected = (len(AIMS), CAUSES), (len(self.sizes), len(BALANCES), len(LEVELS))
        received = self.weights.shape, self.normal.shape
        if expected != received:
            message = f"weights and normal must have shapes {expected}, got {received}"
            raise ValueError(message)

    @classmethod
    def learn(
        cls,
        network: Network,
        material: Material,
        *,
        pixels: npt.NDArray[np.int64],
        rng: np.random.Generator,
    ) -> Self:
        """Learn from splits of pixels that did not train the network."""
        splits, scenery, lesson = material.splits, material.scenery, material.lesson
        sizes = sorted(set(lesson.sizes))
        trials = [
            _Trial.of(network, splits, splits.draw(pixels, n, _ROWS, rng), scenery, rng)
            for n in sizes
            for _ in range(_DRAWS)
        ]
        weights = np.array([_weights(trials, aim) for aim in range(len(AIMS))])
        if not lesson.reference:
            return cls(weights, np.empty(0), np.empty((0, len(BALANCES), len(LEVELS))))
        by_size = [[trial for trial in trials if trial.size == n] for n in sizes]
        normal = np.array([_calibrate(weights, found) for found in by_size])
        return cls(weights, np.array(sizes, np.float64), normal)

    def variance(self, causes: Floats, balance: float) -> Floats:
        """Return expected squared errors of mixed estimates, from causes (aim, ..., cause)."""
        return _mixed(np.stack([c @ w for c, w in zip(causes, self.weights, strict=True)]), balance)

    def quantile(
        self,
        estimate: Floats,
        variance: Floats,
        count: npt.NDArray[Any],
        *,
        balance: float,
        level: float,
    ) -> Floats:
        """Return a quantile; estimate and variance (row, channel), samples (row,)."""
        z = self._normal(np.maximum(count, 1), balance, level)[:, np.newaxis]
        mean = estimate + _DARK
        root = 1 - variance / (9 * mean**2) + z * np.sqrt(variance) / (3 * mean)
        return np.asarray(np.maximum(mean * np.maximum(root, 0) ** 3 - _DARK, 0))

    def _normal(self, count: npt.NDArray[Any], balance: float, level: float) -> Floats:
        if not len(self.sizes):
            return np.full(len(count), special.ndtri(level))
        places, place = special.ndtri(LEVELS), special.ndtri(level)
        known = [
            np.interp(balance, BALANCES, [np.interp(place, places, z) for z in rows])
            for rows in self.normal
        ]
        return np.asarray(np.interp(np.log2(count), np.log2(self.sizes), known))


def _mixed(of_aims: Floats, balance: float) -> Floats:
    """Return the mixture of what two aims give, shape (aim, ...)."""
    return np.asarray((1 - balance) * of_aims[0] + balance * of_aims[1])


def causes_of(answer: Answer, profile: Profile, aim: int) -> Floats:
    """Return what may cause squared errors, shape (row, channel, cause), float64.

    The square of the estimate, of its distance to the mean, the variance of the mean and what the
    estimate takes over of it, and a constant for the dark.
    """
    estimate, mean, certainty = (
        t.cpu().numpy().astype(np.float64)
        for t in (answer.estimate[:, aim], answer.mean, answer.certainty[:, aim, None])
    )
    noise = _variance_of_mean(profile, mean)
    causes = (
        np.full_like(estimate, _DARK**2),
        estimate**2,
        (estimate - mean) ** 2,
        noise,
        (1 - certainty) ** 2 * noise,
        certainty**2 * mean**2,
    )
    return np.stack(causes, axis=-1)


def _variance_of_mean(profile: Profile, mean: Floats) -> Floats:
    """Return the variance of the mean as far as octaves tell, shape (row, channel)."""
    count = np.maximum(profile.count, 1)[:, np.newaxis].astype(np.float64)
    weight, radiance = profile.bins[..., :1], profile.bins[..., 1:].astype(np.float64)
    squares = radiance**2 / np.where(weight > 0, weight, np.inf)
    return np.asarray(np.maximum(squares.sum(axis=1) / count - mean**2, 0) / count)


@dataclass(frozen=True)
class _Trial:
    """Estimates and what their samples' other halves say of them.

    Attributes
    ----------
    size
        Samples of each estimate.
    estimate, truth
        Shape (aim, row, channel) and (row, channel).
    squared
        Unbiased for the squared error of the estimate, shape (aim, row, channel).
    causes
        Shape (aim, row, channel, cause).
    """

    size: int
    estimate: Floats
    truth: Floats
    squared: Floats
    causes: Floats

    @classmethod
    def of(
        cls,
        network: Network,
        splits: Splits,
        part: Part,
        scenery: Scenery,
        rng: np.random.Generator,
    ) -> Self:
        import torch

        from chdstat.estimators.progressive.training import look

        with torch.inference_mode():
            answer = network(look(part.profile, scenery[part.rows], part.shared, "cpu"))
        estimate = np.moveaxis(answer.estimate.numpy().astype(np.float64), 1, 0)
        first, second = splits.halves(part, rng)
        return cls(
            size=len(part.places),
            estimate=estimate,
            truth=part.target.astype(np.float64),
            squared=(estimate - first) * (estimate - second),
            causes=np.stack([causes_of(answer, part.profile, aim) for aim in range(len(AIMS))]),
        )


def _weights(trials: Sequence[_Trial], aim: int) -> Floats:
    """Return the weights of the causes by least squares, errors relative to the radiance."""
    causes = np.concatenate([t.causes[aim].reshape(-1, CAUSES) for t in trials])
    squared = np.concatenate([t.squared[aim].reshape(-1) for t in trials])
    scale = 1 / causes[:, :4].sum(axis=1)
    # The normal equations: tens of thousands of rows, six weights.
    scaled = causes * scale[:, np.newaxis]
    gram = np.linalg.cholesky(scaled.T @ scaled + 1e-9 * np.eye(CAUSES) * len(scaled))
    weights, _ = optimize.nnls(gram.T, np.linalg.solve(gram, scaled.T @ (squared * scale)))
    weights[0] = max(weights[0], 1e-4)
    return np.asarray(weights)


def _calibrate(weights: Floats, trials: Sequence[_Trial]) -> Floats:
    """Return the normal quantiles of the truth, shape (balance, level).

    The cube root of a gamma variable is near normal (Wilson and Hilferty 1931,
    doi:10.1073/pnas.17.12.684).
    """
    estimates = np.concatenate([t.estimate for t in trials], axis=1)
    causes = np.concatenate([t.causes for t in trials], axis=1)
    truth = np.concatenate([t.truth for t in trials]) + _DARK
    variances = np.stack([c @ w for c, w in zip(causes, weights, strict=True)])
    found = []
    for balance in BALANCES:
        mean = _mixed(estimates, balance) + _DARK
        spread = np.sqrt(_mixed(variances, balance)) / (3 * mean)
        z = (np.cbrt(truth / mean) - 1 + spread**2) / spread
        found.append(np.quantile(z, LEVELS))
    return np.array(found)
