"""Profile: what a pixel's samples look like, octave by octave of luminance, in constant memory.

A profile is to our estimator what the cascade is to `chdstat.estimators.zirr2018`: every sample
enters the two octaves next to its luminance, linearly in the logarithm, with its weight and with
its radiance in all channels. Profiles add up, do not depend on the order of the samples, and keep
their mean exactly, as the radiance in all octaves together is that of all samples.

Where a renderer says how much of each sample is direct light, direct and indirect light are counted
apart, each in octaves of its own; together they are still all radiance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from chdstat._core.arrays import LUMINANCE, as_pixels, as_samples, is_bad, spans
from chdstat._core.executor import in_order
from chdstat.errors import InputError

__all__ = ["OCTAVES", "ConstantPixels", "Profile"]

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

Floats = npt.NDArray[np.floating[Any]]


@dataclass
class Profile:
    """Sums over the good samples of pixels.

    Attributes
    ----------
    bins
        Weight of the samples in each octave, then their radiance in each channel in units of
        `unit`; shape (..., octave, 1 + channel). Nulls enter no octave, samples of negative
        luminance the lowest. Of parts, the octaves of
        the direct light come first, then those of the indirect.
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
        """Return profiles without a sample, to be updated; float64, for very many samples."""
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
            rest, which is indirect, are counted apart. A sample that is bad in either is left out
            of both. Direct light may exceed a sample only where either is negative.

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
        samples = _checked(x, unit)
        scale = np.float32(unit)
        if direct is None:
            return cls(*_profiles((samples,), lambda rows: _profile(rows, scale)), unit)
        part = as_samples(direct, name="direct")
        if part.shape != samples.shape:
            message = f"direct must have the shape of x, {samples.shape}, got {part.shape}"
            raise InputError(message)
        found = _profiles((samples, part), lambda x, own: _profile_of_parts(x, own, scale))
        return cls(*found, unit)

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return self.bins.nbytes + self.count.nbytes

    @property
    def parts(self) -> int:
        """How many parts of the samples are counted apart."""
        return int(self.bins.shape[-2]) // OCTAVES

    @property
    def channels(self) -> int:
        """How many channels there are."""
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


@dataclass
class ConstantPixels:
    """Which pixels have seen nothing but equal samples, as lamps have.

    Attributes
    ----------
    first
        The first sample, shape (..., channel).
    same
        Whether all others are equal to it and good, shape (...).
    lit
        Whether any sample of the image is not 0.
    count
        Samples so far.
    """

    first: npt.NDArray[Any]
    same: npt.NDArray[np.bool_]
    lit: bool = False
    count: int = 0

    @classmethod
    def of(cls, samples: npt.NDArray[Any]) -> ConstantPixels:
        """Start from samples, shape (..., channel, sample), of which there is at least one."""
        first = samples[..., 0].copy()
        good = np.asarray(np.isfinite(first).all(axis=-1))
        found = cls(first, good)
        found.add(samples)
        return found

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return self.first.nbytes + self.same.nbytes

    def add(self, samples: npt.NDArray[Any]) -> None:
        """Add samples of the same pixels."""
        # The last one tells nearly all pixels apart from these; only the others are read.
        last = (samples[..., -1] == self.first).all(axis=-1)
        self.same[~last] = False
        same = self.same
        same[same] = (samples[same] == self.first[same][..., np.newaxis]).all(axis=(-2, -1))
        # Of nearly all images one sample a pixel is enough to tell.
        self.lit = self.lit or bool(samples[..., 0].any() or samples.any())
        self.count += samples.shape[-1]


def _checked(x: npt.ArrayLike, unit: float) -> Floats:
    samples = as_pixels(x)
    if not _SMALLEST <= unit <= _LARGEST:
        message = f"unit must be a positive radiance, {_SMALLEST:.1g} to {_LARGEST:.1g}, got {unit}"
        raise InputError(message)
    return samples


def _profiles(
    arrays: Sequence[Floats], measure: Callable[..., tuple[Floats, npt.NDArray[np.int64]]]
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return bins and counts of samples (..., channel, sample), block by block on all cores.

    `measure` takes rows of each of the arrays, of which there is one for each part.
    """
    *shape, channels, n = arrays[0].shape
    flat = [array.reshape(-1, channels, n) for array in arrays]
    rows, parts = len(flat[0]), len(flat)
    bins = np.empty((rows, parts * OCTAVES, 1 + channels), np.float32)
    count = np.empty(rows, np.int64)

    def enter(here: slice) -> None:
        bins[here], count[here] = measure(*(array[here] for array in flat))

    blocks = list(spans(rows, max(1, _SAMPLES_AT_ONCE // (n * parts))))
    # A few blocks are done before threads have started.
    for _ in map(enter, blocks) if len(blocks) <= _FEW else in_order(enter, blocks):
        pass
    return bins.reshape(*shape, *bins.shape[1:]), count.reshape(shape)


def _profile_of_parts(
    total: Floats, direct: Floats, unit: np.float32
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return bins (row, part * octave, 1 + channel) and good samples of rows."""
    rows, channels, n = total.shape
    bad = np.asarray((is_bad(direct) | is_bad(total)).any(axis=1, keepdims=True))
    apart = np.empty((rows, _PARTS, channels, n), np.result_type(direct, total))
    apart[:, 0] = np.where(bad, np.nan, direct)
    rest = np.where(bad, np.nan, total) - apart[:, 0]
    rounded = (rest < 0) & (total >= 0) & (apart[:, 0] >= 0)
    above = np.asarray(rounded & (rest < -_ROUNDING * apart[:, 0]))
    if above.any():
        row, channel, sample = np.argwhere(above)[0]
        message = (
            "direct light must be part of the samples, but of one it is "
            f"{direct[row, channel, sample]:.6g} and the whole {total[row, channel, sample]:.6g}; "
            "give what was rendered with the same seed"
        )
        raise InputError(message)
    apart[:, 1] = np.where(rounded, 0, rest)
    bins, count = _profile(apart.reshape(-1, channels, n), unit)
    return bins.reshape(rows, _PARTS * OCTAVES, -1), count[::_PARTS]


def _profile(x: Floats, unit: np.float32) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return bins (row, octave, 1 + channel) and good samples of rows (row, channel, sample).

    The bins are the product of a sparse matrix, with the two weights of each sample in its column,
    and of the samples: one loop in C for all channels, on all cores.
    """
    rows, channels, n = x.shape
    bad = is_bad(x).any(axis=1)
    values = np.empty((rows, n, 1 + channels), np.float32)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        for channel in range(channels):
            np.divide(x[:, channel], unit, out=values[..., 1 + channel], casting="same_kind")
        if bad.any():
            values[bad] = 0
        luminance = _luminance(values[..., 1:])
    np.not_equal(luminance, 0, out=values[..., 0], casting="unsafe")
    place = np.clip(luminance, 2.0**_LOWEST, 2.0 ** (_LOWEST + OCTAVES), out=luminance)
    np.log2(place, out=place)
    place -= _LOWEST
    np.minimum(place, _TOP, out=place)
    octave = place.astype(np.int32)
    upper = np.subtract(place, octave, out=place)
    octave += np.arange(0, rows * OCTAVES, OCTAVES, dtype=np.int32)[:, np.newaxis]
    matrix = sparse.csc_array(
        (
            np.stack([1 - upper, upper], axis=-1).ravel(),
            np.stack([octave, octave + 1], axis=-1).ravel(),
            np.arange(0, 2 * rows * n + 1, 2, dtype=np.int32),
        ),
        shape=(rows * OCTAVES, rows * n),
        copy=False,
    )
    bins = matrix @ values.reshape(rows * n, -1)
    return bins.reshape(rows, OCTAVES, -1), n - bad.sum(axis=1)


def _luminance(values: Floats) -> Floats:
    """Return the luminance of RGB, shape (..., channel), or the mean of other channels."""
    channels = values.shape[-1]
    weights = LUMINANCE if channels == 3 else np.full(channels, 1 / channels, np.float32)
    return np.asarray(values @ weights)
