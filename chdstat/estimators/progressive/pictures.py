"""Pictures: which pixels of one or several scenes train, with their samples and descriptions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import is_bad
from chdstat.errors import InputError
from chdstat.estimators.heldout import checked_pixels, draw_pixels
from chdstat.estimators.progressive.first_hit import Features, describe
from chdstat.samples import Samples

__all__ = ["Lot", "Scene", "chosen_pixels"]

_PIXELS = 8192
"""Of a scene, at most."""
_MOST_PIXELS = 4 * _PIXELS
"""Of all scenes together: more take memory, and tell little."""


@dataclass(frozen=True)
class Scene:
    """A picture that trains.

    Attributes
    ----------
    samples
        The picture.
    features
        Its first-hit features, where they are looked at.
    unit
        Its mean radiance.
    pixels
        Which of its pixels train, rows (y, x); None for all.
    direct
        The direct part of the samples, where it is looked at.
    """

    samples: Samples
    features: Features | None
    unit: float
    pixels: npt.NDArray[np.int64] | None
    direct: Samples | None = None


@dataclass(frozen=True)
class Lot:
    """The good pixels of a scene.

    Attributes
    ----------
    rows
        Samples in units of the scene's mean radiance, shape (pixel, channel, sample).
    described
        Of the first hit, shape (pixel, number).
    pixels
        Where they are, rows (y, x).
    excluded
        Pixels left out for a bad sample.
    direct
        The direct part of the samples, of the shape and in the unit of `rows`; None where it is not
        looked at.
    """

    rows: npt.NDArray[np.float32]
    described: npt.NDArray[np.float32]
    pixels: npt.NDArray[np.int64]
    excluded: int
    direct: npt.NDArray[np.float32] | None

    @classmethod
    def of(cls, scene: Scene, spp: int) -> Lot:
        """Read that many samples of each pixel."""
        shape = scene.samples.shape[:2]
        pixels = np.argwhere(np.ones(shape, bool)) if scene.pixels is None else scene.pixels
        every, good = _rows(scene.samples, pixels, spp)
        first = None
        if scene.direct is not None:
            first, also = _rows(scene.direct, pixels, spp)
            good &= also
        rows, pixels = _in_unit(every, good, scene.unit), pixels[good]
        direct = None if first is None else _in_unit(first, good, scene.unit)
        described = describe(scene.features, shape)[tuple(pixels.T)]
        return cls(rows, described, pixels, int((~good).sum()), direct)


def chosen_pixels(
    pictures: Sequence[Samples], given: Any, *, reference: bool, seed: int
) -> list[npt.NDArray[np.int64] | None]:
    """Return the pixels of each picture that train, rows (y, x): those given, or drawn, or all.

    A picture draws fewer beside many others, from those that it draws alone.

    Parameters
    ----------
    pictures
        All that train together.
    given
        An array for each, or None.
    reference
        Whether there is one: then pixels are drawn where none are given.
    seed
        Where the draw starts.

    Raises
    ------
    InputError
        If there are not as many arrays as pictures, or one is not of pixels of its picture.
    """
    if given is None and not reference:
        return [None] * len(pictures)
    if given is None:
        count = min(_PIXELS, _MOST_PIXELS // len(pictures))
        return [draw_pixels(picture.shape[:2], count, seed=seed) for picture in pictures]
    if len(given) != len(pictures):
        message = f"pixels must be one array for each of {len(pictures)} pictures, got {len(given)}"
        raise InputError(message)
    shapes = (picture.shape[:2] for picture in pictures)
    return [checked_pixels(one, shape) for one, shape in zip(given, shapes, strict=True)]


def _in_unit(
    rows: npt.NDArray[np.float32], good: npt.NDArray[np.bool_], unit: float
) -> npt.NDArray[np.float32]:
    """Return good rows in another unit; the array is overwritten."""
    kept = rows if good.all() else rows[good]
    kept /= np.float32(unit)
    return kept


def _rows(
    samples: Samples, pixels: npt.NDArray[np.int64], spp: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return samples (pixel, channel, sample), and which pixels have no bad one."""
    rows = np.empty((len(pixels), samples.shape[2], spp), np.float32)
    place = np.full(samples.shape[:2], -1)
    place[tuple(pixels.T)] = np.arange(len(pixels))
    for ys, xs, ss, block in samples.blocks():
        kept = block[..., : max(rows.shape[-1] - ss.start, 0)]
        here = place[ys, xs]
        if kept.shape[-1]:
            rows[here[here >= 0], :, ss.start : ss.start + kept.shape[-1]] = kept[here >= 0]
    return rows, np.asarray(~is_bad(rows).any(axis=(1, 2)))
