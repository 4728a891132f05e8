"""Inputs of the progressive estimator: profiles of samples, and numbers that describe first hits.

A profile describes a pixel's samples by octaves of luminance, in constant memory, like the cascade
of `chdstat.estimators.zirr2018`. Each sample is split between the two octaves nearest to its
luminance, linearly in the logarithm. An octave holds the sum of the weights and the sum of the
radiance in all channels. Profiles do not depend on the order of the samples, and preserve their
mean exactly.

First hits describe the surface that is visible in a pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse

from chdstat._core.arrays import LUMINANCE, Image, Reals, as_pixels, is_bad, spans
from chdstat._core.work import in_order
from chdstat.errors import InputError
from chdstat.estimators.registry import known_features

__all__ = ["OCTAVES", "Features", "Profile", "describe"]

OCTAVES = 24
_LOWEST = -12
"""The first octave is for luminance up to 2^-12 of the unit, the last for 2^11 and more."""
_TOP = OCTAVES - 1 - 2.0**-10
_SAMPLES_AT_ONCE = 2**16
"""Block size for which all temporary arrays stay in the cache."""
_FEW = 4
_SMALLEST, _LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
"""Range of units in which samples can be measured in single precision."""
_NAMES = ("albedo", "normal", "depth", "position")
_WAVES = 3
"""Octaves of sines and cosines of the position, so that light may vary faster than linearly."""
_DARK = 0.02
"""Lower bound of the albedo in logarithms."""

Features = Mapping[str, npt.NDArray[Any]]


@dataclass
class Profile:
    """Sums over the good samples of pixels.

    Attributes
    ----------
    bins
        Weight of the samples in each octave, then their radiance in each channel in units of
        `unit`; shape (..., octave, 1 + channel). Nulls enter no octave; samples with negative
        luminance enter the lowest.
    count
        Number of good samples, including nulls, shape (...).
    unit
        Radiance at which octave 0 lies: the mean radiance of the image, so that a brighter image of
        the same scene has the same profiles.
    """

    bins: Reals
    count: npt.NDArray[np.int64]
    unit: float

    @classmethod
    def of(cls, x: npt.ArrayLike, *, unit: float) -> Self:
        """Return the profiles of samples (..., channel, sample).

        Samples with a NaN or infinite channel are left out.

        Parameters
        ----------
        x
            Linear radiance, shape (..., channel, sample).
        unit
            Radiance at which octave 0 lies.

        Raises
        ------
        InputError
            If `x` has no channels, or `unit` is not a positive, normal float32.

        Examples
        --------
        >>> one = Profile.of([[1.0, 0.0, 8.0]], unit=1.0)
        >>> one.count.item(), one.bins.sum(axis=0).tolist(), one.mean().tolist()
        (3, [2.0, 9.0], [3.0])
        """
        samples = as_pixels(x)
        if not _SMALLEST <= unit <= _LARGEST:
            message = (
                f"unit must be a positive radiance, {_SMALLEST:.1g} to {_LARGEST:.1g}, got {unit}"
            )
            raise InputError(message)
        return cls(*_blocks_of(samples, np.float32(unit)), unit)

    def mean(self) -> Reals:
        """Return the mean of the good samples, shape (..., channel); NaN where there is none."""
        count = np.where(self.count > 0, self.count, np.nan)[..., np.newaxis]
        return np.asarray(self.bins[..., 1:].sum(axis=-2) * self.unit / count)

    def variance_of_mean(self) -> Reals:
        """Estimate the variance of the mean from the octaves, shape (..., channel).

        It is in squared units of `unit`.
        """
        count = np.maximum(self.count, 1)[..., np.newaxis].astype(np.float64)
        weight, radiance = self.bins[..., :1], self.bins[..., 1:].astype(np.float64)
        squares = radiance**2 / np.where(weight > 0, weight, np.inf)
        within = (radiance.sum(axis=-2) / count) ** 2
        return np.asarray(np.maximum(squares.sum(axis=-2) / count - within, 0) / count)


def _blocks_of(x: Reals, unit: np.float32) -> tuple[Reals, npt.NDArray[np.int64]]:
    """Return bins and counts of samples (..., channel, sample), block by block on all cores."""
    *shape, channels, n = x.shape
    rows = x.reshape(-1, channels, n)
    bins = np.empty((len(rows), OCTAVES, 1 + channels), np.float32)
    count = np.empty(len(rows), np.int64)

    def enter(here: slice) -> None:
        bins[here], count[here] = _bins_of(rows[here], unit)

    blocks = list(spans(len(rows), max(1, _SAMPLES_AT_ONCE // n)))
    # A few blocks are finished before threads have started.
    for _ in map(enter, blocks) if len(blocks) <= _FEW else in_order(enter, blocks):
        pass
    return bins.reshape(*shape, *bins.shape[1:]), count.reshape(shape)


def _bins_of(x: Reals, unit: np.float32) -> tuple[Reals, npt.NDArray[np.int64]]:
    """Return bins (row, octave, 1 + channel) and good samples of rows (row, channel, sample).

    The bins are the product of a sparse matrix, which holds the two weights of each sample in its
    column, and the samples: one loop in C for all channels.
    """
    rows, channels, n = x.shape
    bad = is_bad(x).any(axis=1)
    values = np.empty((rows, n, 1 + channels), np.float32)
    # If there are not three channels, all weigh the same.
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


def describe(features: Features, shape: tuple[int, ...]) -> Image:
    """Return numbers near 1 that describe the first hit of each pixel, shape (y, x, number).

    These are the albedo and its logarithm, the normal, the logarithm of the depth, and the
    position, in units of its spread over the image, with its sines and cosines (Tancik et al. 2020,
    "Fourier features let networks learn high frequency functions in low dimensional domains").

    Parameters
    ----------
    features
        Albedo, normal, depth and position by name, shape (y, x) or (y, x, 3); each may be missing.
    shape
        Height and width.

    Raises
    ------
    InputError
        If a feature has another shape.
    """
    numbers = [np.zeros((*shape, 0))]
    known = known_features(features, shape, _NAMES)
    if "albedo" in known:
        numbers += [known["albedo"], np.log(known["albedo"].clip(min=0) + _DARK)]
    if "normal" in known:
        numbers.append(known["normal"])
    if "depth" in known:
        numbers.append(_standard(np.log(known["depth"].clip(min=1e-6))))
    if "position" in known:
        position = _standard(known["position"])
        waves = [np.pi / 2 * 2**k * position for k in range(_WAVES)]
        numbers += [position, *map(np.sin, waves), *map(np.cos, waves)]
    return np.concatenate(numbers, axis=-1).astype(np.float32)


def _standard(field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Centre and scale a field (y, x, number); clip distant values, as of the sky."""
    flat = field.reshape(-1, field.shape[-1])
    low, high = np.quantile(flat, [0.01, 0.99], axis=0)
    inside = field.clip(low, high)
    return np.asarray((inside - inside.mean(axis=(0, 1))) / (inside.std(axis=(0, 1)) + 1e-6))
