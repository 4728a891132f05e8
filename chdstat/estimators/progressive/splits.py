"""Splits: the samples of a pixel cut in two at random, one part to learn from, one to learn.

The mean of the other samples of a pixel is an unbiased target, however noisy it is (Lehtinen et al.
2018, "Noise2Noise: learning image restoration without clean data"); where there are many more of
them, it is as good as a reference. So the same splits serve both ways of training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.profiles import Profile

__all__ = ["Part", "Splits"]

_SAMPLES = 2**17
"""Samples of a minibatch, at most: of many samples, fewer rows tell as much."""

Array = npt.NDArray[np.float32]
Places = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """A minibatch.

    Attributes
    ----------
    rows
        Which pixels, shape (row,).
    places
        Which of their samples to learn from, shape (n,).
    profile
        Of the samples to learn from.
    shared
        What alike pixels around say from their samples at the same places, shape (row, channel), in
        units of the profile's; 0 channels where nobody asked them.
    target
        Mean of the others, in units of the profile's, shape (row, channel).
    """

    rows: npt.NDArray[np.int64]
    places: npt.NDArray[np.int64]
    profile: Profile
    shared: Array
    target: Array


class Splits:
    """Pixels whose samples are split anew for every minibatch.

    Parameters
    ----------
    samples
        Good samples, shape (pixel, channel, sample).
    unit
        Radiance that all is measured in.
    prepared
        Splits to choose from in place of new ones, because much was computed for them: places, and
        what `Part.shared` needs, shape (pixel, channel), radiance.
    """

    def __init__(
        self, samples: Array, *, unit: float, prepared: Sequence[tuple[Places, Array]] = ()
    ) -> None:
        self._prepared = prepared
        self.unit = unit
        self._samples = (samples / np.float32(unit)).astype(np.float32, copy=False)
        self._flat = self._samples.reshape(-1)
        self._total = self._samples.sum(axis=-1, dtype=np.float64)

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def spp(self) -> int:
        """Samples of a pixel."""
        return int(self._samples.shape[-1])

    @property
    def mean(self) -> npt.NDArray[np.float64]:
        """Mean radiance, in units of `unit`, shape (pixel, channel)."""
        return np.asarray(self._total / self.spp)

    @property
    def variance(self) -> npt.NDArray[np.float64]:
        """Variance of a sample, in squared units of `unit`, shape (pixel, channel)."""
        squares = np.einsum("rcn,rcn->rc", self._samples, self._samples, dtype=np.float64)
        return np.asarray(np.maximum(squares - self._total**2 / self.spp, 0) / max(self.spp - 1, 1))

    def draw(
        self, pixels: npt.NDArray[np.int64], n: int, rows: int, rng: np.random.Generator
    ) -> Part:
        """Draw a minibatch of about `rows` of the given pixels, n samples each to learn from."""
        chosen = rng.choice(pixels, size=max(1, min(rows, _SAMPLES // n)))
        # All rows of a minibatch share the places of their samples: these are exchangeable.
        places, shared = self._places(n, rng)
        seen = self._at(chosen, places)
        return Part(
            rows=chosen,
            places=places,
            profile=Profile.of(seen, unit=1.0),
            shared=shared[chosen] / np.float32(self.unit),
            target=self._rest(chosen, seen),
        )

    def _places(self, n: int, rng: np.random.Generator) -> tuple[Places, Array]:
        if not self._prepared:
            return rng.permutation(self.spp)[:n], np.zeros((len(self), 0), np.float32)
        usable = [split for split in self._prepared if len(split[0]) == n]
        return usable[rng.integers(len(usable))]

    def halves(self, part: Part, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """Return the means of the two halves of the other samples, shape (2, row, channel)."""
        others = rng.permutation(np.setdiff1d(np.arange(self.spp), part.places))
        parts = np.array_split(others, 2)
        return np.stack([self._at(part.rows, p).mean(axis=-1, dtype=np.float64) for p in parts])

    def _at(self, pixels: npt.NDArray[np.int64], places: npt.NDArray[np.int64]) -> Array:
        """Return samples (row, channel, sample)."""
        _, channels, spp = self._samples.shape
        starts = (pixels[:, np.newaxis] * channels + np.arange(channels)) * spp
        return np.asarray(self._flat.take(starts[..., np.newaxis] + places))

    def _rest(self, pixels: npt.NDArray[np.int64], seen: Array) -> Array:
        """Return the mean of the samples that were not seen; rounding leaves none below 0."""
        total = np.maximum(self._total[pixels] - seen.sum(axis=-1, dtype=np.float64), 0)
        return np.asarray(total / (self.spp - seen.shape[-1]), np.float32)
