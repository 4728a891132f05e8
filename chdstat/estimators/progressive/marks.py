"""Marks: some of the samples that trained a network, by which it knows their image again.

An array has no provenance. A model of another scene is followed only as far as it pays, which is
measured with noise; one of this very image need not be doubted twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.splits import Splits

__all__ = ["Marks"]

_MARKS, _TRIED = 2048, 2**15
_ENOUGH = 0.5
"""Of the marks that are expected among the samples of an image: some pixels may be bad."""
_FEWEST = 4
_SAME = 1e-6
"""Logarithm of a ratio up to which samples are the same, in whatever unit."""


@dataclass(frozen=True)
class Marks:
    """Samples, and the pixels that drew them.

    Attributes
    ----------
    places
        Number of the image, y and x, shape (mark, 3).
    samples
        In units of the image's radiance, shape (mark, channel).
    """

    places: npt.NDArray[np.int64]
    samples: npt.NDArray[np.float32]

    @classmethod
    def none(cls, channels: int) -> Self:
        """Return no marks."""
        return cls(np.zeros((0, 3), np.int64), np.zeros((0, channels), np.float32))

    @classmethod
    def of(cls, material: Material, channels: int, rng: np.random.Generator) -> Self:
        """Draw samples that no other pixel has."""
        if not isinstance(material.splits, Splits):
            return cls.none(channels)
        rows, drawn = material.splits.some(_TRIED, rng)
        _, first, count = np.unique(drawn, axis=0, return_index=True, return_counts=True)
        chosen = rng.permutation(first[(count == 1) & drawn[first].all(axis=1)])[:_MARKS]
        image = np.repeat(np.arange(len(material.parts)), material.parts)[rows[chosen]]
        places = np.column_stack([image, material.pixels[rows[chosen]]])
        return cls(places, drawn[chosen])

    def match(self, x: npt.NDArray[Any], scenes: Sequence[dict[str, Any]]) -> bool:
        """Return whether samples (y, x, channel, sample) are of an image that trained.

        Parameters
        ----------
        x
            The samples, in any order and unit.
        scenes
            Of the provenance: shapes of the images.
        """
        return any(self._match(x, number, scene) for number, scene in enumerate(scenes))

    def _match(self, x: npt.NDArray[Any], number: int, scene: dict[str, Any]) -> bool:
        own = self.places[:, 0] == number
        height, width, channels, spp = scene["samples_shape"]
        if x.ndim != 4 or x.shape[:3] != (height, width, channels) or not own.any():
            return False
        _, ys, xs = self.places[own].T
        drawn, marks = x[ys, xs].mean(axis=1, dtype=np.float64), self.samples[own].mean(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.round(np.log(drawn / marks[:, np.newaxis]) / _SAME)
        # One factor, that of the units, leads from many marks to a sample of their pixel.
        near = np.concatenate([ratio, ratio + 1], axis=1)
        found = np.concatenate([np.unique(row[np.isfinite(row)]) for row in near])
        most = np.unique(found, return_counts=True)[1].max(initial=0)
        expected = own.sum() * min(1.0, x.shape[-1] / spp)
        return bool(most >= max(_ENOUGH * expected, _FEWEST))
