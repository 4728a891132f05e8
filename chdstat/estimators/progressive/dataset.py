"""Samples of pixels as the progressive estimator takes them: their profiles, and sets that train.

A profile is what a pixel's samples look like, octave by octave of luminance, in constant memory. It
is to the estimator what the cascade is to `chdstat.estimators.zirr2018`: every sample enters the
two octaves next to its luminance, linearly in the logarithm, with its weight and with its radiance
in all channels. Profiles add up, do not depend on the order of the samples, and keep their mean
exactly, as the radiance in all octaves together is that of all samples. Where a renderer says how
much of each sample is direct light, direct and indirect light are counted separately, each in
octaves of its own: the two parts together are still all radiance.

In training, the samples of a pixel are cut in two at random: one part to learn from, one for the
target. The mean of the other samples is an unbiased target, however noisy it is (Lehtinen et al.
2018, "Noise2Noise: learning image restoration without clean data"); where there are many more of
them, it is as good as a reference. So the same splits serve both ways of training.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from chdstat._core.arrays import LUMINANCE, as_pixels, is_bad, spans
from chdstat._core.executor import in_order
from chdstat.errors import InputError
from chdstat.estimators.validation import checked_direct, without

__all__ = ["OCTAVES", "Array", "Floats", "Indices", "Profile", "SampleSplits", "TrainingSet"]

OCTAVES = 24
_LOWEST = -12
"""The first octave stands for luminance up to 2^-12 of the unit, the last for 2^11 and more."""
_TOP = OCTAVES - 1 - 2.0**-10
_SAMPLES_AT_ONCE = 2**16
"""Small enough for all that is made of a block to stay in the cache."""
_FEW = 4
_PARTS = 2
"""Direct and indirect light."""
_ROUNDING = 1e-5
"""Share of a sample by which its direct part may exceed it: sums of single precision."""
_SMALLEST, _LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
"""Radiance that samples can be measured in, in single precision."""

_MOST_SAMPLES = 2**17
"""Samples of a minibatch: of many samples, fewer rows tell as much."""
_EQUAL = 1e-12
"""Part of the squares below which what is left of them is rounding: samples are equal."""
_MARKS, _TRIED = 2048, 2**15
"""Samples that an image is recognised by, at most, and how many are drawn to find them."""

Array = npt.NDArray[np.float32]
Floats = npt.NDArray[np.floating[Any]]
Indices = npt.NDArray[np.int64]


@dataclass
class Profile:
    """Sums over the good samples of pixels.

    Attributes
    ----------
    bins
        Weight of the samples in each octave, then their radiance in each channel in units of
        `unit`; shape (..., octave, 1 + channel). Nulls enter no octave, samples of negative
        luminance the lowest. Of two parts, the octaves of the direct light come first, then those
        of the indirect.
    count
        Good samples, nulls among them, shape (...).
    unit
        Radiance that octaves are counted from: that of the image, so that a brighter image of
        the same scene has the same profiles.
    """

    bins: Floats
    count: npt.NDArray[np.int64]
    unit: float

    @classmethod
    def empty(cls, shape: tuple[int, ...], channels: int, *, unit: float, parts: int = 1) -> Self:
        """Return profiles without a sample, to add others to; float64, for very many samples."""
        bins = np.zeros((*shape, parts * OCTAVES, 1 + channels))
        return cls(bins, np.zeros(shape, np.int64), unit)

    @classmethod
    def of(cls, x: npt.ArrayLike, *, unit: float, direct: npt.ArrayLike | None = None) -> Self:
        """Return the profiles of samples (..., channel, sample).

        A sample of which any channel is NaN or infinite is left out.

        Parameters
        ----------
        x
            Linear radiance, shape (..., channel, sample).
        unit
            Radiance that octaves are counted from.
        direct
            Emission and direct light of each sample, of the same shape: then this part and the
            rest, which is indirect, are counted separately. A sample that is bad in either is left
            out of both. Direct light may exceed a sample only where either is negative.

        Raises
        ------
        InputError
            If `x` has no channels, `unit` is no positive, normal float32, or `direct` is of
            another shape or exceeds the samples.

        Examples
        --------
        >>> one = Profile.of([[1.0, 0.0, 8.0]], unit=1.0)
        >>> one.count.item(), one.bins.sum(axis=0).tolist(), one.mean().tolist()
        (3, [2.0, 9.0], [3.0])

        >>> two = Profile.of([[1.0, 0.0, 8.0]], unit=1.0, direct=[[1.0, 0.0, 2.0]])
        >>> two.parts, two.bins.reshape(2, 24, 2).sum(axis=1).tolist(), two.mean().tolist()
        (2, [[2.0, 3.0], [1.0, 6.0]], [3.0])
        """
        samples = as_pixels(x)
        if not _SMALLEST <= unit <= _LARGEST:
            message = (
                f"unit must be a positive radiance, {_SMALLEST:.1g} to {_LARGEST:.1g}, got {unit}"
            )
            raise InputError(message)
        own = None if direct is None else checked_direct(direct, samples.shape)
        return cls(*_blocks_of(samples, own, np.float32(unit)), unit)

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return self.bins.nbytes + self.count.nbytes

    @property
    def parts(self) -> int:
        """Parts of a sample: 2 where direct and indirect light are counted separately, else 1."""
        return int(self.bins.shape[-2]) // OCTAVES

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.bins.shape[-1]) - 1

    def add(self, other: Profile) -> None:
        """Add the samples of other profiles of the same pixels."""
        self.bins += other.bins
        self.count += other.count

    def mean(self) -> Floats:
        """Return the mean of the good samples, shape (..., channel); NaN where there is none."""
        count = np.where(self.count > 0, self.count, np.nan)[..., np.newaxis]
        return np.asarray(self.bins[..., 1:].sum(axis=-2) * self.unit / count)

    def variance_of_mean(self) -> Floats:
        """Return the variance of the mean as far as octaves tell, shape (..., channel).

        It is in squared units of `unit`. Of parts it is the sum of theirs: profiles do not tell
        how these go together.
        """
        count = np.maximum(self.count, 1)[..., np.newaxis].astype(np.float64)
        weight, radiance = self.bins[..., :1], self.bins[..., 1:].astype(np.float64)
        squares = radiance**2 / np.where(weight > 0, weight, np.inf)
        of_parts = np.stack(np.split(radiance, self.parts, axis=-2)).sum(axis=-2)
        within = ((of_parts / count) ** 2).sum(axis=0)
        return np.asarray(np.maximum(squares.sum(axis=-2) / count - within, 0) / count)

    def reshape(self, *shape: int) -> Self:
        """Return the same profiles with their pixels in another shape."""
        bins = self.bins.reshape(*shape, *self.bins.shape[-2:])
        return type(self)(bins, self.count.reshape(shape), self.unit)

    def __getitem__(self, pixels: Any) -> Self:
        """Return the profiles of some pixels."""
        return type(self)(self.bins[pixels], self.count[pixels], self.unit)


def _blocks_of(
    total: Floats, direct: Floats | None, unit: np.float32
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return bins and counts of samples (..., channel, sample), block by block on all cores."""
    *shape, channels, n = total.shape
    parts = 1 if direct is None else _PARTS
    rows = total.reshape(-1, channels, n)
    own = None if direct is None else direct.reshape(rows.shape)
    bins = np.empty((len(rows), parts * OCTAVES, 1 + channels), np.float32)
    count = np.empty(len(rows), np.int64)

    def enter(here: slice) -> None:
        x = rows[here] if own is None else _separated(rows[here], own[here])
        found, good = _bins_of(x.reshape(-1, channels, n), unit)
        bins[here], count[here] = found.reshape(bins[here].shape), good[::parts]

    blocks = list(spans(len(rows), max(1, _SAMPLES_AT_ONCE // (n * parts))))
    # A few blocks are done before threads have started.
    for _ in map(enter, blocks) if len(blocks) <= _FEW else in_order(enter, blocks):
        pass
    return bins.reshape(*shape, *bins.shape[1:]), count.reshape(shape)


def _separated(total: Floats, direct: Floats) -> Floats:
    """Return direct and indirect light of rows, shape (row, part, channel, sample).

    A sample of which any channel is bad in either is NaN in both.
    """
    bad = np.asarray((is_bad(direct) | is_bad(total)).any(axis=1, keepdims=True))
    lights = np.empty((len(total), _PARTS, *total.shape[1:]), np.result_type(direct, total))
    lights[:, 0] = np.where(bad, np.nan, direct)
    rest = np.where(bad, np.nan, total) - lights[:, 0]
    rounded = (rest < 0) & (total >= 0) & (lights[:, 0] >= 0)
    above = np.asarray(rounded & (rest < -_ROUNDING * lights[:, 0]))
    if above.any():
        row, channel, sample = np.argwhere(above)[0]
        message = (
            "direct light must be part of the samples, but of one it is "
            f"{direct[row, channel, sample]:.6g} and the whole {total[row, channel, sample]:.6g}; "
            "give what was rendered with the same seed"
        )
        raise InputError(message)
    lights[:, 1] = np.where(rounded, 0, rest)
    return lights


def _bins_of(x: Floats, unit: np.float32) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return bins (row, octave, 1 + channel) and good samples of rows (row, channel, sample).

    The bins are the product of a sparse matrix, with the two weights of each sample in its column,
    and of the samples: one loop in C for all channels, on all cores.
    """
    rows, channels, n = x.shape
    bad = is_bad(x).any(axis=1)
    values = np.empty((rows, n, 1 + channels), np.float32)
    # Other channels than three weigh the same.
    weights = LUMINANCE if channels == 3 else np.full(channels, 1 / channels, np.float32)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        for channel in range(channels):
            np.divide(x[:, channel], unit, out=values[..., 1 + channel], casting="same_kind")
        if bad.any():
            values[bad] = 0
        luminance = values[..., 1:] @ weights
    np.not_equal(luminance, 0, out=values[..., 0], casting="unsafe")
    octave = np.clip(luminance, 2.0**_LOWEST, 2.0 ** (_LOWEST + OCTAVES), out=luminance)
    np.log2(octave, out=octave)
    octave -= _LOWEST
    np.minimum(octave, _TOP, out=octave)
    lower = octave.astype(np.int32)
    upper_weight = np.subtract(octave, lower, out=octave)
    lower += np.arange(0, rows * OCTAVES, OCTAVES, dtype=np.int32)[:, np.newaxis]
    matrix = sparse.csc_array(
        (
            np.stack([1 - upper_weight, upper_weight], axis=-1).ravel(),
            np.stack([lower, lower + 1], axis=-1).ravel(),
            np.arange(0, 2 * rows * n + 1, 2, dtype=np.int32),
        ),
        shape=(rows * OCTAVES, rows * n),
        copy=False,
    )
    bins = matrix @ values.reshape(rows * n, -1)
    return bins.reshape(rows, OCTAVES, -1), n - bad.sum(axis=1)


@dataclass(eq=False, kw_only=True)
class TrainingSet(ABC):
    """Pixels that train a network, whose samples are cut in two at random for every minibatch.

    What can be drawn of a pixel are its samples one by one, or batches of them.

    Attributes
    ----------
    sizes
        Numbers of samples to learn from; each minibatch draws one.
    reference
        Whether targets are as good as the truth.
    iterations
        Minibatches to train with.
    auxiliary
        Auxiliary features of the pixels by name, one row a pixel.
    pixels
        The pixels in their images, rows (y, x), scene by scene.
    excluded
        Number of pixels that were left out for a bad sample.
    scenes
        What provenance says of each scene; ``pixels_used`` of it are here.
    counts
        Samples in each of what can be drawn of a pixel: 1, or those of a batch.
    mean, variance
        Mean radiance in the unit of the profiles, and variance of a sample in the square of it,
        shape (pixel, channel).
    """

    sizes: Sequence[int] = ()
    reference: bool = False
    iterations: int = 0
    auxiliary: Mapping[str, Array] = field(default_factory=dict)
    pixels: Indices = field(default_factory=lambda: np.empty((0, 2), np.int64))
    excluded: int = 0
    scenes: Sequence[Mapping[str, Any]] = ()
    counts: Indices = field(init=False)
    mean: npt.NDArray[np.float64] = field(init=False)
    variance: npt.NDArray[np.float64] = field(init=False)

    def __len__(self) -> int:
        return len(self.mean)

    @abstractmethod
    def draw(
        self, pixels: Indices, n: int, rows: int, rng: np.random.Generator
    ) -> tuple[Indices, Indices]:
        """Draw about `rows` of the given pixels, and about n of their samples to learn from.

        All pixels share the places of their samples: these are exchangeable.
        """

    @abstractmethod
    def minibatch(self, rows: Indices, drawn: Indices) -> tuple[Profile, dict[str, Array], Array]:
        """Return what to learn from, and the target, for pixels `rows` and their samples `drawn`.

        Returns
        -------
        profile, auxiliary
            Inputs of the network.
        target
            Mean of the other samples, in the unit of the profiles, shape (row, channel); 0 where
            there are none.
        """

    @abstractmethod
    def mean_of(self, rows: Indices, drawn: Indices) -> npt.NDArray[np.float64]:
        """Return the mean of some samples of some pixels, shape (row, channel)."""

    def halves(
        self, rows: Indices, drawn: Indices, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.float64], tuple[int, int]]:
        """Return the means of two halves of the other samples, at random, and how many each has.

        The means have shape (2, row, channel).
        """
        others = rng.permutation(np.setdiff1d(np.arange(len(self.counts)), drawn))
        one, two = np.array_split(others, 2)
        means = np.stack([self.mean_of(rows, half) for half in (one, two)])
        return means, (int(self.counts[one].sum()), int(self.counts[two].sum()))

    def noise(
        self, rows: Indices, drawn: Indices, rng: np.random.Generator
    ) -> npt.NDArray[np.float64]:
        """Return an unbiased estimate of the variance of the target, shape (row, channel).

        Of halves of a and b samples, with the means t and u, it is ``(t - u)^2 a b / (a + b)^2``.
        """
        means, (a, b) = self.halves(rows, drawn, rng)
        return np.asarray((means[1] - means[0]) ** 2 * (a * b / (a + b) ** 2))

    def marks(self, rng: np.random.Generator) -> tuple[Indices, Array]:
        """Return samples by which the images are recognised, and their pixels.

        Returns
        -------
        pixels : ndarray
            Number of the image, y and x, shape (mark, 3); none where single samples are not kept.
        samples : ndarray
            In units of the image's radiance, shape (mark, channel).
        """
        del rng
        return np.zeros((0, 3), np.int64), np.zeros((0, self.mean.shape[1]), np.float32)


@dataclass(eq=False, kw_only=True)
class SampleSplits(TrainingSet):
    """Pixels whose samples are all kept.

    Attributes
    ----------
    samples
        Good samples, shape (pixel, channel, sample); kept in units of `unit`.
    unit
        Radiance that all is measured in.
    direct
        The direct part of the samples, of their shape, where it is an input.
    prepared
        Splits to choose from in place of new ones, because much was computed for them: samples to
        learn from, and estimates from those of similar pixels, shape (pixel, channel), radiance.
        One of them is of all samples.
    """

    samples: Array
    unit: float
    direct: Array | None = None
    prepared: Sequence[tuple[Indices, Array]] = ()

    def __post_init__(self) -> None:
        scale = np.float32(self.unit)
        self.samples = np.asarray(self.samples / scale, np.float32)
        self._direct = None if self.direct is None else (self.direct / scale).reshape(-1)
        self._total = self.samples.sum(axis=-1, dtype=np.float64)
        self._shared = {drawn.tobytes(): shared for drawn, shared in self.prepared}
        self.spp = self.samples.shape[-1]
        self.counts = np.ones(self.spp, np.int64)
        self.mean = self._total / self.spp
        squares = np.einsum("rcn,rcn->rc", self.samples, self.samples, dtype=np.float64)
        around = squares - self._total**2 / self.spp
        around[around <= _EQUAL * squares] = 0
        self.variance = around / max(self.spp - 1, 1)

    def draw(
        self, pixels: Indices, n: int, rows: int, rng: np.random.Generator
    ) -> tuple[Indices, Indices]:
        """Draw about `rows` of the given pixels, fewer of many samples, and n of their samples."""
        chosen = rng.choice(pixels, size=max(1, min(rows, _MOST_SAMPLES // n)))
        if not self.prepared:
            return chosen, rng.permutation(self.spp)[:n]
        usable = [drawn for drawn, _ in self.prepared if len(drawn) == n]
        return chosen, usable[rng.integers(len(usable))]

    def minibatch(self, rows: Indices, drawn: Indices) -> tuple[Profile, dict[str, Array], Array]:
        """Return what to learn from, and the target; see `TrainingSet.minibatch`."""
        index = self._index(rows, drawn)
        seen = self.samples.reshape(-1).take(index)
        profile = Profile.of(
            seen, unit=1.0, direct=None if self._direct is None else self._direct.take(index)
        )
        auxiliary = {name: array[rows] for name, array in self.auxiliary.items()}
        if self._shared:
            auxiliary["shared"] = self._shared[drawn.tobytes()][rows] / np.float32(self.unit)
        others = without(self._total[rows], seen.sum(axis=-1, dtype=np.float64))
        return profile, auxiliary, np.asarray(others / max(self.spp - len(drawn), 1), np.float32)

    def mean_of(self, rows: Indices, drawn: Indices) -> npt.NDArray[np.float64]:
        """Return the mean of some samples of some pixels, shape (row, channel)."""
        index = self._index(rows, drawn)
        return np.asarray(self.samples.reshape(-1).take(index).mean(-1, np.float64))

    def marks(self, rng: np.random.Generator) -> tuple[Indices, Array]:
        """Draw samples that no other pixel has; see `TrainingSet.marks`."""
        rows, places = rng.integers(len(self), size=_TRIED), rng.integers(self.spp, size=_TRIED)
        drawn = self.samples[rows, :, places]
        _, first, count = np.unique(drawn, axis=0, return_index=True, return_counts=True)
        chosen = rng.permutation(first[(count == 1) & drawn[first].all(axis=1)])[:_MARKS]
        used = [scene["pixels_used"] for scene in self.scenes]
        image = np.repeat(np.arange(len(used)), used)[rows[chosen]]
        return np.column_stack([image, self.pixels[rows[chosen]]]), drawn[chosen]

    def _index(self, rows: Indices, drawn: Indices) -> Indices:
        """Return where the samples are, shape (row, channel, sample)."""
        _, channels, spp = self.samples.shape
        starts = (rows[:, np.newaxis] * channels + np.arange(channels)) * spp
        return np.asarray(starts[..., np.newaxis] + drawn)
