"""Posteriors over atoms: from the weights of atoms to estimates, spreads and quantiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from chdstat._positive import Floats
from chdstat.estimators._atoms import Atoms

__all__ = ["Losses", "Posterior"]

_EPSILON = 0.01
"""Share of the squared scene mean in relMSE."""


@dataclass(frozen=True)
class Posterior:
    """What samples say of their pixel's radiance, under a prior.

    Attributes
    ----------
    mean
        The estimate that minimises the expected loss, shape (..., channel), in radiance; NaN where
        no whole sample is good.
    sd
        Standard deviation of the radiance under the posterior, shape (..., channel).
    quantiles
        Radiances that the posterior puts the given shares below, shape (..., channel, share).
    effective_atoms
        ``1 / sum p_j^2`` of the posterior probabilities, shape (...): below about 3 there are too
        few pixels like this one for the mean to be trusted.
    log_evidence
        Logarithm of the probability of the batch under the prior, shape (...): the higher its mean
        over pixels that the prior does not contain, the better the prior.
    """

    mean: Floats
    sd: Floats
    quantiles: Floats
    effective_atoms: Floats
    log_evidence: Floats

    @classmethod
    def of(cls, rows: Floats, shape: tuple[int, ...], *, unit: float) -> Self:
        """Take apart what `Losses.read` found, for batches and channels of some shape."""
        *lead, channels = shape
        effective, evidence, mean, sd, quantiles = np.split(
            rows, np.cumsum([1, 1, channels, channels]), axis=-1
        )
        return cls(
            mean.reshape(shape) * unit,
            sd.reshape(shape) * unit,
            quantiles.reshape(*shape, quantiles.shape[-1] // channels) * unit,
            effective.reshape(lead),
            evidence.reshape(lead),
        )


@dataclass(frozen=True)
class Losses:
    """What posterior probabilities are multiplied with.

    Attributes
    ----------
    radiance
        y, shape (atom, channel).
    factors
        Columns v y, v, y, y^2 of all channels, shape (atom, 4 channel).
    order
        Atoms by radiance, shape (atom, channel).
    """

    radiance: Floats
    factors: Floats
    order: npt.NDArray[np.int64]

    @classmethod
    def of(cls, atoms: Atoms, scene_mean: Floats, relative: float) -> Self:
        y = atoms.radiance
        floor = np.where(scene_mean > 0, _EPSILON * scene_mean**2, 1.0)
        v = (y**2 + floor) ** -relative
        return cls(y, np.concatenate([v * y, v, y, y**2], axis=-1), np.argsort(y, axis=0))

    @staticmethod
    def empty(rows: int, channels: int, shares: Floats) -> Floats:
        """Return what `read` returns for rows without a good sample: NaN."""
        return np.full((rows, 2 + channels * (2 + len(shares))), np.nan)

    def read(self, weights: npt.NDArray[np.float32], top: Floats, shares: Floats) -> Floats:
        """Return effective atoms, evidence, mean, sd and quantiles in columns, for each row."""
        w = weights.astype(np.float64)
        total = w.sum(axis=-1, keepdims=True)
        total[total == 0] = np.nan
        over, under, first, second = np.split(w @ self.factors / total, 4, axis=-1)
        sd = np.sqrt(np.maximum(second - first**2, 0))
        effective = total[:, 0] ** 2 / np.vecdot(w, w)
        evidence = np.log(total[:, 0]) + top
        columns = [effective[:, np.newaxis], evidence[:, np.newaxis], over / under, sd]
        if len(shares):
            columns += [self._quantiles(w, total, c, shares) for c in range(first.shape[-1])]
        return np.concatenate(columns, axis=-1)

    def _quantiles(self, w: Floats, total: Floats, channel: int, shares: Floats) -> Floats:
        order = self.order[:, channel]
        below = np.cumsum(w[:, order], axis=-1)
        rank = np.stack([(below < q * total).sum(axis=-1) for q in shares], axis=-1)
        found = self.radiance[order[np.minimum(rank, len(order) - 1)], channel]
        return np.where(np.isnan(total), np.nan, found)
