"""Spread: how large the errors of the estimates are, learned from pixels that did not train them.

Squared errors are explained by a sum of what may cause them, each with a weight that is not
negative. The radiance of a pixel is then taken for gamma distributed with the estimate for its mean
and that variance. Where references tell, the weights are least squares, and quantiles are
calibrated by split conformal prediction (Lei et al. 2018, doi:10.1080/01621459.2017.1307116).
Without one the weights are upper bounds (`bounds`), and the quantiles normal ones: where errors are
mixtures of many sizes, these hold 90 % nearly as often as they say, whatever the mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from scipy import optimize, special

from chdstat.estimators.progressive.bounds import bounded_weights
from chdstat.estimators.progressive.causes import CAUSES, DARK
from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.shapes import AIMS
from chdstat.estimators.progressive.trials import Trial, trials_of

if TYPE_CHECKING:
    from torch import nn

__all__ = ["BALANCES", "LEVELS", "Spread"]

LEVELS = np.array([0.005, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.995])
"""Probabilities at which quantiles are calibrated."""
BALANCES = np.array([0.0, 0.5, 1.0])
"""Mixtures of the aims that quantiles are calibrated for; between them they are interpolated."""

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
        network: nn.Module,
        material: Material,
        *,
        pixels: npt.NDArray[np.int64],
        rng: np.random.Generator,
    ) -> Self:
        """Learn from splits of pixels that did not train the network."""
        trials = trials_of(network, material, pixels=pixels, rng=rng)
        if not material.lesson.reference:
            weights = np.array([bounded_weights(trials, aim) for aim in range(len(AIMS))])
            return cls(weights, np.empty(0), np.empty((0, len(BALANCES), len(LEVELS))))
        weights = np.array([_weights(trials, aim) for aim in range(len(AIMS))])
        sizes = sorted({trial.size for trial in trials})
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
        """Return a quantile; estimate and variance (row, channel), samples (row,).

        Of a negative estimate, which signed samples make, it is that of a normal distribution.
        """
        z = self._normal(np.maximum(count, 1), balance, level)[:, np.newaxis]
        mean = np.maximum(estimate, 0) + DARK
        root = 1 - variance / (9 * mean**2) + z * np.sqrt(variance) / (3 * mean)
        found = np.maximum(mean * np.maximum(root, 0) ** 3 - DARK, 0)
        return np.where(estimate < 0, estimate + z * np.sqrt(variance), found)

    def _normal(self, count: npt.NDArray[Any], balance: float, level: float) -> Floats:
        if not len(self.sizes):
            return np.full(len(count), special.ndtri(level))
        places, place = special.ndtri(LEVELS), special.ndtri(level)
        # Beyond what was calibrated, tails go on as normal ones.
        beyond = place - np.clip(place, places[0], places[-1])
        known = [
            np.interp(balance, BALANCES, [np.interp(place, places, z) for z in rows]) + beyond
            for rows in self.normal
        ]
        return np.asarray(np.interp(np.log2(count), np.log2(self.sizes), known))


def _mixed(of_aims: Floats, balance: float) -> Floats:
    """Return the mixture of what two aims give, shape (aim, ...)."""
    return np.asarray((1 - balance) * of_aims[0] + balance * of_aims[1])


def _weights(trials: Sequence[Trial], aim: int) -> Floats:
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


def _calibrate(weights: Floats, trials: Sequence[Trial]) -> Floats:
    """Return the normal quantiles of the truth, shape (balance, level).

    The cube root of a gamma variable is near normal (Wilson and Hilferty 1931,
    doi:10.1073/pnas.17.12.684).
    """
    estimates = np.concatenate([t.estimate for t in trials], axis=1)
    causes = np.concatenate([t.causes for t in trials], axis=1)
    truth = np.concatenate([t.target for t in trials]) + DARK
    variances = np.stack([c @ w for c, w in zip(causes, weights, strict=True)])
    found = []
    for balance in BALANCES:
        mean = _mixed(estimates, balance) + DARK
        spread = np.sqrt(_mixed(variances, balance)) / (3 * mean)
        z = (np.cbrt(truth / mean) - 1 + spread**2) / spread
        found.append(np.quantile(z[mean >= DARK], LEVELS))
    return np.array(found)
