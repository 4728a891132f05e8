"""Spread: how large the errors of the estimates are, learned from pixels that did not train them.

Squared errors are explained by a sum of what may cause them, each with a weight that is not
negative. The radiance of a pixel is then taken for gamma distributed with the estimate for its mean
and that variance. Where references tell, the weights are least squares, and quantiles are
calibrated by split conformal prediction (Lei et al. 2018, doi:10.1080/01621459.2017.1307116),
separately for dark and for bright estimates.
Without one the weights are upper bounds (`bounds`), and the quantiles normal ones: where errors are
mixtures of many sizes, these hold 90 % nearly as often as they say, whatever the mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from scipy import interpolate, optimize, special

from chdstat.estimators.progressive.bounds import bounded_weights
from chdstat.estimators.progressive.causes import CAUSES, DARK
from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.shapes import AIMS
from chdstat.estimators.progressive.shapes import LEVELS as BRIGHTNESS
from chdstat.estimators.progressive.trials import Trial, trials_of

if TYPE_CHECKING:
    from torch import nn

__all__ = ["BALANCES", "BRIGHTNESS", "LEVELS", "Spread"]

LEVELS = np.array([0.005, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.995])
"""Probabilities at which quantiles are calibrated."""
BALANCES = np.array([0.0, 0.5, 1.0])
"""Mixtures of the aims that quantiles are calibrated for; between them they are interpolated."""

_CALIBRATED = (len(BALANCES), len(BRIGHTNESS), len(LEVELS))
_CHANCE = 0.5
"""Standard errors that quantiles are taken farther out: then seven of ten are far enough."""
_FEW = 5
"""Pixels of a brightness that count as much as all others."""

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
        For each, the normal quantiles to take at `LEVELS` where an estimate is so bright, shape
        (size, balance, brightness, level).
    """

    weights: Floats
    sizes: Floats
    normal: Floats

    def __post_init__(self) -> None:
        expected = (len(AIMS), CAUSES), (len(self.sizes), *_CALIBRATED)
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
            return cls(weights, np.empty(0), np.empty((0, *_CALIBRATED)))
        weights = np.array([_weights(trials, aim) for aim in range(len(AIMS))])
        sizes = sorted({trial.size for trial in trials})
        # Lamps are in all pixels, hardly in a tenth of them.
        all_of_them = np.arange(len(material.pixels))
        everywhere = trials_of(network, material, pixels=all_of_them, rng=rng, samples=0)
        normal = [
            _calibrate(
                weights, *([t for t in part if t.size == n] for part in (trials, everywhere))
            )
            for n in sizes
        ]
        return cls(weights, np.array(sizes, np.float64), np.array(normal))

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


def _near(estimate: Floats) -> Floats:
    """Return how near estimates (row, channel) are to each of `BRIGHTNESS`; rows sum to 1."""
    octave = np.log2(np.maximum(estimate.mean(axis=-1), 1e-12))
    return np.stack(
        [np.interp(octave, BRIGHTNESS, level) for level in np.eye(len(BRIGHTNESS))], axis=-1
    )


def _calibrate(weights: Floats, trials: Sequence[Trial], everywhere: Sequence[Trial]) -> Floats:
    """Return the normal quantiles of the truth, shape (balance, brightness, level).

    They are those of pixels that did not train. Among all pixels, those as bright may differ from
    the others, and so much is added (as Mondrian conformal prediction tells categories apart: Vovk
    2013, doi:10.1007/s10994-013-5355-6).
    """
    found = []
    for balance in BALANCES:
        watching = _quantiles(*_normals(weights, trials, balance)[:2])
        normal, share, near = _normals(weights, everywhere, balance)
        usual, counts = _quantiles(normal, share), share @ near
        own = [
            _quantiles(normal, share * weight) if count > 0 else usual
            for weight, count in zip(near.T, counts, strict=True)
        ]
        known = counts / (counts + _FEW)
        found.append(watching + known[:, np.newaxis] * (np.array(own) - usual))
    return np.array(found)


def _quantiles(normal: Floats, share: Floats) -> Floats:
    """Return quantiles at `LEVELS`, each as far from the middle as chance may have it.

    Of few pixels, too many would else be farther out (Vovk 2013, as above).
    """
    error = _CHANCE * np.sqrt(LEVELS * (1 - LEVELS) / share.sum())
    levels = np.clip(LEVELS + np.sign(LEVELS - 0.5) * error, 0, 1)
    return np.asarray(np.quantile(normal, levels, weights=share, method="inverted_cdf"))


def _normals(
    weights: Floats, trials: Sequence[Trial], balance: float
) -> tuple[Floats, Floats, Floats]:
    """Return normal places of truths, what share of a pixel each is, and how bright it seems.

    The cube root of a gamma variable is near normal (Wilson and Hilferty 1931,
    doi:10.1073/pnas.17.12.684).
    """
    estimate = _mixed(np.concatenate([t.estimate for t in trials], axis=1), balance)
    causes = np.concatenate([t.causes for t in trials], axis=1)
    truth = np.concatenate([t.target for t in trials]) + DARK
    rows = np.concatenate([t.rows for t in trials])
    variance = _mixed(np.stack([c @ w for c, w in zip(causes, weights, strict=True)]), balance)
    mean = estimate + DARK
    usable = mean >= DARK
    mean = np.where(usable, mean, DARK)
    spread = np.sqrt(variance) / (3 * mean)
    normal = (np.cbrt(truth / mean) - 1 + spread**2) / spread
    share = usable / (np.bincount(rows)[rows] * estimate.shape[-1])[:, np.newaxis]
    near = np.broadcast_to(_near(estimate)[:, np.newaxis], (*estimate.shape, len(BRIGHTNESS)))
    return normal[usable], share[usable], near[usable]
