"""Buckets: samples of a picture dealt in turn to a few profiles a pixel, to learn from.

The memory does not grow with the samples, and yet they can be cut in two at random: some of the
buckets to learn from, and the mean of the others, which is as unbiased a target as that of other
samples (Lehtinen et al. 2018, "Noise2Noise: learning image restoration without clean data").
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat.estimators.progressive.profiles import OCTAVES, Profile
from chdstat.estimators.progressive.splits import Halves, Part

__all__ = ["BUCKETS", "BucketParts", "Buckets"]

BUCKETS = 8
"""Of a pixel: 3 kB of RGB."""
_BRIGHTEST = 1e15
"""Radiance, in units of the picture's, that can still be squared in single precision."""
_ROUNDING = 2e-6
"""Relative difference of two means below which it is that of their sums in single precision."""

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]


class Buckets:
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
    >>> kept = Buckets(1, 1, unit=1.0, buckets=2)
    >>> kept.add(np.array([[[1.0, 5.0, 3.0]]]))
    >>> kept.sums[..., 0].tolist()
    [[4.0], [5.0]]
    """

    def __init__(
        self, pixels: int, channels: int, *, unit: float, buckets: int = BUCKETS, parts: int = 1
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


class BucketParts:
    """Minibatches from the buckets that hold samples; see `splits.Parts`.

    Parameters
    ----------
    buckets
        The samples so far; what is dealt later does not belong to these parts.
    pixels
        Which of its pixels to take.
    """

    def __init__(self, buckets: Buckets, pixels: Places) -> None:
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
        """Mean radiance, in units of the picture's, shape (pixel, channel)."""
        return np.asarray(self._sums.sum(axis=0) / self.spp)

    @property
    def variance(self) -> Floats:
        r"""Variance of a sample, in squared units of the picture's, shape (pixel, channel).

        That between buckets tells it without bias: the expectation of
        :math:`\sum_b n_b (m_b - m)^2 / (B - 1)`, with means m over n samples, is the variance of
        one sample (the mean square between groups; Fisher 1925, Statistical Methods for Research
        Workers, chapter 7).
        """
        sizes = self._sizes[:, np.newaxis, np.newaxis]
        apart = self._sums / sizes - self.mean
        apart[np.abs(apart) <= _ROUNDING * self.mean] = 0
        return np.asarray((sizes * apart**2).sum(axis=0) / max(len(sizes) - 1, 1))

    def draw(self, pixels: Places, n: int, rows: int, rng: np.random.Generator) -> Part:
        """Draw a minibatch: as many buckets as come nearest to n samples, and one at least."""
        chosen = rng.choice(pixels, size=max(1, rows))
        filled = len(self._sizes)
        order = rng.permutation(filled)
        seen = min(max(round(n * filled / self.spp), 1), filled - 1)
        size = int(self._sizes[order[:seen]].sum())
        return Part(
            rows=chosen,
            places=order[:seen],
            size=size,
            profile=self._profile(chosen, order[:seen], size),
            shared=np.zeros((len(chosen), 0), np.float32),
            target=self._mean(chosen, order[seen:]).astype(np.float32),
        )

    def halves(self, part: Part, rng: np.random.Generator) -> Halves:
        """Return two halves of the other buckets, of which there must be two."""
        others = rng.permutation(np.setdiff1d(np.arange(len(self._sizes)), part.places))
        one, two = np.array_split(others, 2)
        means = [self._mean(part.rows, half) for half in (one, two)]
        return Halves(np.stack(means), (self._samples(one), self._samples(two)))

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
