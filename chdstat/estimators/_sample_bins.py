"""Bins of whole samples: how bright a sample is, finely, and what colour it has, coarsely.

A sample falls into two bins. The first tells its luminance and is one of many narrow ones, nulls
apart. The second tells its chromaticity within a coarse range of luminance. With f(sample) =
f(luminance) f(chromaticity | luminance), the log-likelihood of a batch under a distribution is the
scalar product of the batch's counts and the logarithms of that distribution's probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import LUMINANCE, is_bad, spans
from chdstat._positive import Floats

__all__ = ["SampleBins"]

_LOW, _CELLS, _CELL, _FINE = -10.0, 12, 1.5, 15
"""Natural logarithm of the darkest luminance told apart, in the unit; coarse cells of luminance,
their width in nepers, and narrow bins in each. What lies beyond is counted in the last ones."""
_EDGES = np.array([-1.0, -0.4, -0.1, 0.1, 0.4, 1.0])
"""Between bins of log(red / green) and of log(blue / green)."""
_CHUNK = 2**15
"""Samples worked on at once."""


@dataclass(frozen=True)
class SampleBins:
    """Where the bins are.

    Attributes
    ----------
    unit
        Luminance that the bins are relative to, in radiance.
    channels
        1 or 3; a single channel has no chromaticity.
    """

    unit: float
    channels: int

    @property
    def narrow(self) -> int:
        """Bins of luminance: the first for nulls, the others ascending."""
        return 1 + _CELLS * _FINE

    @property
    def hues(self) -> int:
        """Bins of chromaticity in each cell of luminance; 0 where there is no chromaticity."""
        return 0 if self.channels == 1 else (len(_EDGES) + 1) ** 2

    @property
    def size(self) -> int:
        """Bins in all: those of luminance, then those of chromaticity, cell by cell."""
        return self.narrow + _CELLS * self.hues

    @property
    def luminance_edges(self) -> Floats:
        """Edges of the bins of luminance above 0, from 0 to infinity, in radiance."""
        inner = _LOW + _CELL / _FINE * np.arange(1, _CELLS * _FINE)
        with np.errstate(over="ignore", under="ignore"):
            return np.concatenate([[0.0], self.unit * np.exp(inner), [np.inf]])

    def counts(self, x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
        """Count samples (row, channel, sample) per bin; those with a bad channel are left out.

        Returns
        -------
        ndarray
            Shape (row, bin).
        """
        found = np.zeros((len(x), self.size), np.float32)
        for part in spans(len(x), max(1, _CHUNK // max(x.shape[-1], 1))):
            found[part] = self._count(x[part])
        return found

    def by_cell(self, table: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the chromaticity part of a table (..., bin) as (..., cell, hue)."""
        return table[..., self.narrow :].reshape(*table.shape[:-1], _CELLS, self.hues)

    def _count(self, x: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
        bad = np.asarray(is_bad(x).any(axis=-2))
        radiance = np.where(bad[:, np.newaxis], 0.0, x.astype(np.float64))
        weights = LUMINANCE.astype(np.float64) if self.channels == 3 else np.ones(1)
        luminance = weights @ radiance
        lit = np.asarray(luminance > 0)
        with np.errstate(divide="ignore"):
            nepers = np.where(lit, np.log(luminance) - np.log(self.unit), _LOW) - _LOW
        narrow = np.clip(nepers * (_FINE / _CELL), 0, _CELLS * _FINE - 1).astype(np.int64)
        found = self._tally(np.where(lit, 1 + narrow, 0), ~bad)
        if self.hues:
            cell = narrow // _FINE
            found += self._tally(self.narrow + cell * self.hues + _hue(radiance), lit)
        return found

    def _tally(
        self, bins: npt.NDArray[np.int64], use: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.float32]:
        flat = bins + self.size * np.arange(len(bins))[:, np.newaxis]
        found = np.bincount(flat[use], minlength=len(bins) * self.size)
        return found.reshape(len(bins), self.size).astype(np.float32)


def _hue(radiance: Floats) -> npt.NDArray[np.int64]:
    """Return the bin of chromaticity of samples (row, 3, sample), shape (row, sample)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log(radiance)
        # Two channels that are both black are as bright as each other.
        red, blue = (np.nan_to_num(log[:, c] - log[:, 1], posinf=9, neginf=-9) for c in (0, 2))
    across = np.searchsorted(_EDGES, np.stack([red, blue]), side="right")
    return np.asarray(across[0] * (len(_EDGES) + 1) + across[1])
