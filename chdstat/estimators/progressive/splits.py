"""Splits of the samples of a pixel in two at random: one part to learn from, one for the target.

The mean of the other samples of a pixel is an unbiased target, however noisy it is (Lehtinen et al.
2018, "Noise2Noise: learning image restoration without clean data"); where there are many more of
them, it is as good as a reference. So the same splits serve both ways of training.

`SampleSplits` keeps the samples. `BatchProfiles` deals those that stream in to a few profiles a
pixel, in memory that does not grow, and `BatchSplits` cuts these in two at random.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.profile import OCTAVES, Profile
from chdstat.estimators.validation import without

__all__ = [
    "BATCHES",
    "BatchProfiles",
    "BatchSplits",
    "HeldOutHalves",
    "Minibatch",
    "MinibatchSource",
    "SampleSplits",
]

_SAMPLES = 2**17
"""Samples of a minibatch, at most: of many samples, fewer rows tell as much."""
_ROUNDING = 1e-12
"""Part of the squares below which what is left of them is rounding: samples are equal."""

Array = npt.NDArray[np.float32]
Places = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Minibatch:
    """A minibatch.

    Attributes
    ----------
    rows
        Which pixels, shape (row,).
    places
        Which of their samples to learn from, or which of the buckets that these were dealt to.
    size
        How many samples of each pixel that is.
    profile
        Of the samples to learn from.
    shared
        Estimates from similar pixels around, of their samples at the same places, shape (row,
        channel), in units of the profile's; 0 channels without neighbours.
    target
        Mean of the others, in units of the profile's, shape (row, channel).
    """

    rows: npt.NDArray[np.int64]
    places: npt.NDArray[np.int64]
    size: int
    profile: Profile
    shared: Array
    target: Array


class MinibatchSource(Protocol):
    """What minibatches are drawn from: pixels whose samples can be cut in two at random."""

    def __len__(self) -> int:
        """Return the number of pixels."""

    @property
    def parts(self) -> int:
        """Parts of a sample that profiles hold apart: 2 for direct and indirect light."""

    @property
    def mean(self) -> npt.NDArray[np.float64]:
        """Mean radiance, in the unit of the profiles, shape (pixel, channel)."""

    @property
    def variance(self) -> npt.NDArray[np.float64]:
        """Variance of a sample, in the squared unit of the profiles, shape (pixel, channel)."""

    def draw(
        self, pixels: npt.NDArray[np.int64], n: int, rows: int, rng: np.random.Generator
    ) -> Minibatch:
        """Draw a minibatch of about `rows` of the given pixels, n samples each to learn from."""

    def halves(self, part: Minibatch, rng: np.random.Generator) -> HeldOutHalves:
        """Return the two halves of the other samples, at random."""

    def whole(self, pixels: npt.NDArray[np.int64]) -> tuple[Profile, Array]:
        """Return the profiles of all samples of some pixels, and `Minibatch.shared` of these."""


@dataclass(frozen=True)
class HeldOutHalves:
    """The samples that were not seen, in two halves.

    Attributes
    ----------
    means
        Shape (2, row, channel).
    sizes
        Samples of each.
    """

    means: npt.NDArray[np.float64]
    sizes: tuple[int, int]

    @property
    def noise(self) -> npt.NDArray[np.float64]:
        """Unbiased for the variance of the mean of both together, shape (row, channel).

        Of a and b samples, that is ``(t - u)^2 a b / (a + b)^2``.

        Examples
        --------
        >>> HeldOutHalves(np.array([[[1.0]], [[3.0]]]), (2, 2)).noise.item()
        1.0
        """
        a, b = self.sizes
        return np.asarray(np.diff(self.means, axis=0)[0] ** 2 * (a * b / (a + b) ** 2))


class SampleSplits:
    """Pixels whose samples are split anew for every minibatch.

    Parameters
    ----------
    samples
        Good samples, shape (pixel, channel, sample).
    unit
        Radiance that all is measured in.
    prepared
        Splits to choose from in place of new ones, because much was computed for them: places, and
        what `Minibatch.shared` needs, shape (pixel, channel), radiance.
    shared
        The same of all samples; None without neighbours.
    direct
        The direct part of the samples, of their shape: then profiles hold it apart.
    """

    def __init__(
        self,
        samples: Array,
        *,
        unit: float,
        prepared: Sequence[tuple[Places, Array]] = (),
        shared: Array | None = None,
        direct: Array | None = None,
    ) -> None:
        self._prepared = prepared
        self._shared = np.zeros((len(samples), 0), np.float32) if shared is None else shared
        self.unit = unit
        self._samples = _in_unit(samples, unit)
        self._flat = self._samples.reshape(-1)
        self._direct = None if direct is None else _in_unit(direct, unit).reshape(-1)
        self._total = self._samples.sum(axis=-1, dtype=np.float64)

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def parts(self) -> int:
        """Parts of a sample that profiles hold apart."""
        return 1 if self._direct is None else 2

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
        around = squares - self._total**2 / self.spp
        around[around <= _ROUNDING * squares] = 0
        return np.asarray(around / max(self.spp - 1, 1))

    def draw(
        self, pixels: npt.NDArray[np.int64], n: int, rows: int, rng: np.random.Generator
    ) -> Minibatch:
        """Draw a minibatch of about `rows` of the given pixels, n samples each to learn from."""
        chosen = rng.choice(pixels, size=max(1, min(rows, _SAMPLES // n)))
        # All rows of a minibatch share the places of their samples: these are exchangeable.
        places, shared = self._places(n, rng)
        seen = self._flat.take(self._index(chosen, places))
        return Minibatch(
            rows=chosen,
            places=places,
            size=n,
            profile=self._profile(seen, chosen, places),
            shared=shared[chosen] / np.float32(self.unit),
            target=self._rest(chosen, seen),
        )

    def _places(self, n: int, rng: np.random.Generator) -> tuple[Places, Array]:
        if not self._prepared:
            return rng.permutation(self.spp)[:n], self._shared
        usable = [split for split in self._prepared if len(split[0]) == n]
        return usable[rng.integers(len(usable))]

    def some(self, count: int, rng: np.random.Generator) -> tuple[Places, Array]:
        """Draw pixels, and a sample of each, shape (draw, channel)."""
        rows, places = rng.integers(len(self), size=count), rng.integers(self.spp, size=count)
        return rows, self._samples[rows, :, places]

    def halves(self, part: Minibatch, rng: np.random.Generator) -> HeldOutHalves:
        """Return the two halves of the other samples, at random."""
        others = rng.permutation(np.setdiff1d(np.arange(self.spp), part.places))
        parts = np.array_split(others, 2)
        means = [self._flat.take(self._index(part.rows, p)).mean(-1, np.float64) for p in parts]
        return HeldOutHalves(np.stack(means), (len(parts[0]), len(parts[1])))

    def whole(self, pixels: Places) -> tuple[Profile, Array]:
        """Return the profiles of all samples of some pixels, and `Minibatch.shared` of these."""
        profile = self._profile(self._samples[pixels], pixels, np.arange(self.spp))
        return profile, self._shared[pixels] / np.float32(self.unit)

    def _profile(self, seen: Array, pixels: Places, places: Places) -> Profile:
        direct = None
        if self._direct is not None:
            direct = self._direct.take(self._index(pixels, places))
        return Profile.of(seen, unit=1.0, direct=direct)

    def _index(self, pixels: Places, places: Places) -> Places:
        """Return where the samples are, shape (row, channel, sample)."""
        _, channels, spp = self._samples.shape
        starts = (pixels[:, np.newaxis] * channels + np.arange(channels)) * spp
        return np.asarray(starts[..., np.newaxis] + places)

    def _rest(self, pixels: npt.NDArray[np.int64], seen: Array) -> Array:
        """Return the mean of the samples that were not seen."""
        total = without(self._total[pixels], seen.sum(axis=-1, dtype=np.float64))
        return np.asarray(total / (self.spp - seen.shape[-1]), np.float32)


def _in_unit(samples: Array, unit: float) -> Array:
    return (samples / np.float32(unit)).astype(np.float32, copy=False)


BATCHES = 8
"""Of a pixel: 3 kB of RGB."""
_BRIGHTEST = 1e15
"""Radiance, in units of the image's, that can still be squared in single precision."""
_ROUNDING_OF_SUMS = 2e-6
"""Relative difference of two means below which it is that of their sums in single precision."""

Floats = npt.NDArray[np.float64]


class BatchProfiles:
    """Samples of some pixels, the k-th of each in the bucket k modulo their number.

    Parameters
    ----------
    pixels, channels
        How many there are.
    unit
        Radiance that all is measured in.
    buckets
        How many a pixel has.
    parts
        2 where direct and indirect light are counted apart, else 1.

    Examples
    --------
    >>> kept = BatchProfiles(1, 1, unit=1.0, buckets=2)
    >>> kept.add(np.array([[[1.0, 5.0, 3.0]]]))
    >>> kept.sums[..., 0].tolist()
    [[4.0], [5.0]]
    """

    def __init__(
        self, pixels: int, channels: int, *, unit: float, buckets: int = BATCHES, parts: int = 1
    ) -> None:
        self.unit = unit
        self.dealt = 0
        self.bins = np.zeros((buckets, pixels, parts * OCTAVES, 1 + channels), np.float32)
        self.sums = np.zeros((buckets, pixels, channels))
        self.count = np.zeros((buckets, pixels), np.int64)

    @property
    def channels(self) -> int:
        """How many channels there are."""
        return int(self.sums.shape[-1])

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return self.bins.nbytes + self.sums.nbytes + self.count.nbytes

    @property
    def sizes(self) -> Places:
        """Samples dealt to each bucket, bad ones among them, shape (bucket,)."""
        return (self.dealt + np.arange(len(self.bins))[::-1]) // len(self.bins)

    def add(
        self, x: npt.NDArray[np.float32], direct: npt.NDArray[np.float32] | None = None
    ) -> None:
        """Deal more samples, shape (pixel, channel, sample), going on where it stopped.

        Of parts, `direct` is the direct part of the samples.
        """
        step = len(self.bins)
        for first in range(min(x.shape[-1], step)):
            bucket = (self.dealt + first) % step
            own = None if direct is None else direct[..., first::step]
            part = Profile.of(x[..., first::step], unit=self.unit, direct=own)
            self.bins[bucket] += part.bins
            self.sums[bucket] += part.bins[..., 1:].sum(axis=-2, dtype=np.float64)
            self.count[bucket] += part.count
        self.dealt += x.shape[-1]

    def usable(self) -> Places:
        """Return the pixels that have no bad sample, and none too bright to be squared."""
        whole = (self.count == self.sizes[:, np.newaxis]).all(axis=0)
        return np.flatnonzero(whole & (self.sums < _BRIGHTEST).all(axis=(0, 2)))


class BatchSplits:
    """Minibatches from the buckets that hold samples; see `splits.MinibatchSource`.

    Parameters
    ----------
    buckets
        The samples so far; what is dealt later does not belong to these parts.
    pixels
        Which of its pixels to take.
    """

    def __init__(self, buckets: BatchProfiles, pixels: Places) -> None:
        self._bins = buckets.bins
        self._pixels = pixels
        self._sizes = buckets.sizes[buckets.sizes > 0]
        self._sums = buckets.sums[: len(self._sizes), pixels]

    def __len__(self) -> int:
        return len(self._pixels)

    @property
    def parts(self) -> int:
        """Parts of a sample that profiles hold apart."""
        return int(self._bins.shape[-2]) // OCTAVES

    @property
    def spp(self) -> int:
        """Samples of a pixel."""
        return int(self._sizes.sum())

    @property
    def sizes(self) -> list[int]:
        """About how many samples 1, 2, 3 and so on buckets hold, all but the last two of them."""
        filled = len(self._sizes)
        return [round(k * self.spp / filled) for k in range(1, filled - 1)]

    @property
    def mean(self) -> Floats:
        """Mean radiance, in units of the image's, shape (pixel, channel)."""
        return np.asarray(self._sums.sum(axis=0) / self.spp)

    @property
    def variance(self) -> Floats:
        r"""Variance of a sample, in squared units of the image's, shape (pixel, channel).

        That between buckets tells it without bias: the expectation of
        :math:`\sum_b n_b (m_b - m)^2 / (B - 1)`, with means m over n samples, is the variance of
        one sample (the mean square between groups; Fisher 1925, Statistical Methods for Research
        Workers, chapter 7).
        """
        sizes = self._sizes[:, np.newaxis, np.newaxis]
        apart = self._sums / sizes - self.mean
        apart[np.abs(apart) <= _ROUNDING_OF_SUMS * self.mean] = 0
        return np.asarray((sizes * apart**2).sum(axis=0) / max(len(sizes) - 1, 1))

    def draw(self, pixels: Places, n: int, rows: int, rng: np.random.Generator) -> Minibatch:
        """Draw a minibatch: as many buckets as come nearest to n samples, and one at least."""
        chosen = rng.choice(pixels, size=max(1, rows))
        filled = len(self._sizes)
        order = rng.permutation(filled)
        seen = min(max(round(n * filled / self.spp), 1), filled - 1)
        size = int(self._sizes[order[:seen]].sum())
        return Minibatch(
            rows=chosen,
            places=order[:seen],
            size=size,
            profile=self._profile(chosen, order[:seen], size),
            shared=np.zeros((len(chosen), 0), np.float32),
            target=self._mean(chosen, order[seen:]).astype(np.float32),
        )

    def halves(self, part: Minibatch, rng: np.random.Generator) -> HeldOutHalves:
        """Return two halves of the other buckets, of which there must be two."""
        others = rng.permutation(np.setdiff1d(np.arange(len(self._sizes)), part.places))
        one, two = np.array_split(others, 2)
        means = [self._mean(part.rows, half) for half in (one, two)]
        return HeldOutHalves(np.stack(means), (self._samples(one), self._samples(two)))

    def whole(self, pixels: Places) -> tuple[Profile, npt.NDArray[np.float32]]:
        """Return the profiles of all samples of some pixels."""
        profile = self._profile(pixels, np.arange(len(self._sizes)), self.spp)
        return profile, np.zeros((len(pixels), 0), np.float32)

    def _profile(self, rows: Places, places: Places, size: int) -> Profile:
        here = self._pixels[rows]
        bins = self._bins[places[0]].take(here, axis=0)
        for place in places[1:]:
            bins += self._bins[place].take(here, axis=0)
        return Profile(bins, np.full(len(rows), size), 1.0)

    def _mean(self, rows: Places, places: Places) -> Floats:
        total = sum(self._sums[place].take(rows, axis=0) for place in places)
        return np.asarray(total / self._samples(places))

    def _samples(self, places: Places) -> int:
        return int(self._sizes[places].sum())
