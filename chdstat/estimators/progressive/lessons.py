"""Lessons: what of a picture trains, with a reference or without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import is_bad
from chdstat.errors import InputError
from chdstat.estimators.alike import shared_patches
from chdstat.estimators.heldout import check_spp, draw_pixels
from chdstat.estimators.progressive.first_hit import describe
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.splits import Splits
from chdstat.estimators.progressive.surroundings import BANDS, RADII, surround
from chdstat.samples import Samples

__all__ = [
    "Lesson",
    "Material",
    "Scenery",
    "ask",
    "scenery_of",
    "with_reference",
    "without_reference",
]

_PIXELS = 8192
_LADDER = (4, 8, 16, 16, 32, 32, 64, 64, 128, 256, 512)
"""Numbers of samples to learn from where there is a reference: as people ask for them."""
_MOST_SPP = 2048
_ITERATIONS = 6000
_ITERATIONS_ALONE = 2000
"""Without a reference: more of them learn the noise of the targets."""
_FEWEST = 4
_SPLITS = ((0.5, 2), (0.75, 8))
"""Shares of the samples to learn from, and how many splits of each are made where alike pixels are
asked: the larger share is the nearer to all samples, which are what the estimate is for."""
_WINDOW = 256
"""Side of the part of a large picture that trains: more would take long and tell little."""

Features = Mapping[str, npt.NDArray[Any]]
Picture = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Scenery:
    """What is known of each pixel beside its samples, one row a pixel.

    Attributes
    ----------
    described
        Of the first hit, shape (pixel, number).
    bands, weight
        Of the surroundings, shape (pixel, radius, band, 1 + channel) and (pixel, radius).
    """

    described: npt.NDArray[np.float32]
    bands: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]

    @classmethod
    def nothing(cls, pixels: int) -> Scenery:
        """Return that nothing is known."""
        empty = np.zeros((pixels, 0), np.float32)
        return cls(empty, np.zeros((pixels, 0, BANDS, 1), np.float32), empty)

    def __getitem__(self, pixels: npt.NDArray[np.int64] | slice) -> Scenery:
        """Return that of some pixels."""
        return Scenery(self.described[pixels], self.bands[pixels], self.weight[pixels])


@dataclass(frozen=True)
class Lesson:
    """How to train.

    Attributes
    ----------
    sizes
        Numbers of samples to learn from; each minibatch draws one.
    reference
        Whether targets are as good as the truth.
    iterations, minibatch, learning_rate
        The step size falls as a cosine from its start to 0.
    """

    sizes: Sequence[int]
    reference: bool
    iterations: int
    minibatch: int = 1024
    learning_rate: float = 2e-3


@dataclass(frozen=True)
class Material:
    """What a network is trained with.

    Attributes
    ----------
    splits, scenery, lesson
        For `training.learn`.
    pixels
        The pixels of `splits` in the picture, rows (y, x).
    excluded
        Pixels left out for a bad sample.
    """

    splits: Splits
    scenery: Scenery
    lesson: Lesson
    pixels: npt.NDArray[np.int64]
    excluded: int


def with_reference(
    samples: Samples,
    pixels: npt.NDArray[np.int64] | None,
    *,
    features: Features | None,
    unit: float,
    sizes: Sequence[int] | None,
    iterations: int | None,
    seed: int,
) -> Material:
    """Return pixels with all their samples: the means of those not learned from are references.

    Raises
    ------
    InputError
        If there are too few samples per pixel for a size and an equally large reference, or a size
        is less than 1.
    """
    wanted = _LADDER if sizes is None else tuple(sizes)
    if not wanted or min(wanted) < 1:
        message = f"sizes must be one or more numbers of samples from 1, got {wanted}"
        raise InputError(message)
    check_spp(samples, min(wanted) if sizes is None else max(wanted))
    chosen = draw_pixels(samples.shape[:2], _PIXELS, seed=seed) if pixels is None else pixels
    rows, good = _rows(samples, chosen)
    spp = rows.shape[-1]
    lesson = Lesson(
        sizes=[n for n in wanted if n <= spp // 2],
        reference=True,
        iterations=_ITERATIONS if iterations is None else iterations,
    )
    splits = Splits(rows[good], unit=unit)
    return Material(
        splits=splits,
        scenery=scenery_of(features, samples.shape[:2])[_flat(chosen[good], samples.shape[1])],
        lesson=lesson,
        pixels=chosen[good],
        excluded=int((~good).sum()),
    )


def without_reference(
    picture: Picture,
    *,
    features: Features | None,
    neighbours: bool,
    unit: float,
    iterations: int | None,
    rng: np.random.Generator,
) -> Material:
    """Return a picture's pixels, each with splits of its own samples.

    Parameters
    ----------
    picture
        Samples, shape (y, x, channel, sample).
    features
        First-hit features of the picture, or none.
    neighbours
        Whether alike pixels around are asked; their answers are computed for every split.
    unit, iterations, rng
        As for the others.

    Raises
    ------
    InputError
        If there are fewer than 4 samples per pixel, or too few pixels without a bad sample.
    """
    spp = picture.shape[-1]
    if spp < _FEWEST:
        message = f"learning from halves of the samples needs at least {_FEWEST} spp, got {spp}"
        raise InputError(message)
    ys, xs = _window(picture.shape[:2], rng)
    part = picture[ys, xs]
    shape = part.shape[:2]
    features = None if features is None else {k: v[ys, xs] for k, v in features.items()}
    prepared = _prepared(part, rng) if neighbours else []
    sizes = [len(places) for places, _ in prepared] or [
        _share_of(spp, share) for share, _ in _SPLITS
    ]
    lesson = Lesson(
        sizes=sizes,
        reference=False,
        iterations=_ITERATIONS_ALONE if iterations is None else iterations,
    )
    profile = Profile.of(part, unit=unit) if neighbours else None
    rows = part.reshape(-1, *part.shape[2:])
    good = np.flatnonzero(~is_bad(rows).any(axis=(1, 2)))
    splits = Splits(
        rows[good], unit=unit, prepared=[(places, shared[good]) for places, shared in prepared]
    )
    corner = np.array([ys.start, xs.start])
    return Material(
        splits=splits,
        scenery=scenery_of(features, shape, profile)[good],
        lesson=lesson,
        pixels=np.stack(np.unravel_index(good, shape), axis=-1) + corner,
        excluded=len(rows) - len(good),
    )


def scenery_of(
    features: Features | None, shape: tuple[int, int], profile: Profile | None = None
) -> Scenery:
    """Return what is known of each pixel beside its samples; of its surroundings with a profile."""
    count = shape[0] * shape[1]
    described = describe(features, shape).reshape(count, -1)
    if profile is None:
        nothing = Scenery.nothing(count)
        return Scenery(described, nothing.bands, nothing.weight)
    bands, weight = surround(profile, features)
    return Scenery(
        described, bands.reshape(count, *bands.shape[2:]), weight.reshape(count, len(RADII))
    )


def _share_of(spp: int, share: float) -> int:
    """Return a share of the samples, at least 2, with at least 1 to spare."""
    return min(max(round(share * spp), 2), spp - 1)


def _prepared(
    picture: Picture, rng: np.random.Generator
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]]:
    """Return splits with what alike pixels say in each, shape (pixel, channel)."""
    spp, found = picture.shape[-1], []
    for share, times in _SPLITS:
        # Of many samples, fewer splits differ enough, and each takes longer.
        for _ in range(times if spp <= 128 else max(1, times // 3)):
            places = rng.permutation(spp)
            n = _share_of(spp, share)
            found += [places[:n], places[n:]] if 2 * n == spp else [places[:n]]
    return [(places, ask(picture[..., places])) for places in found]


def ask(picture: Picture) -> npt.NDArray[np.float32]:
    """Return what alike pixels around say, shape (pixel, channel); 0 where there are none."""
    answers = np.nan_to_num(shared_patches(picture), nan=0, posinf=0)
    return np.asarray(answers.reshape(-1, answers.shape[-1]), np.float32)


def _rows(
    samples: Samples, pixels: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return samples (pixel, channel, sample), and which pixels have no bad one."""
    *_, channels, spp = samples.shape
    rows = np.empty((len(pixels), channels, min(spp, _MOST_SPP)), np.float32)
    place = np.full(samples.shape[:2], -1)
    place[tuple(pixels.T)] = np.arange(len(pixels))
    for ys, xs, ss, block in samples.blocks():
        kept = block[..., : max(rows.shape[-1] - ss.start, 0)]
        here = place[ys, xs]
        if kept.shape[-1]:
            rows[here[here >= 0], :, ss.start : ss.start + kept.shape[-1]] = kept[here >= 0]
    return rows, np.asarray(~is_bad(rows).any(axis=(1, 2)))


def _flat(pixels: npt.NDArray[np.int64], width: int) -> npt.NDArray[np.int64]:
    return np.asarray(pixels[:, 0] * width + pixels[:, 1])


def _window(shape: tuple[int, ...], rng: np.random.Generator) -> tuple[slice, slice]:
    """Return the part of a picture that trains."""
    starts = [int(rng.integers(max(length - _WINDOW, 0) + 1)) for length in shape[:2]]
    ends = (min(start + _WINDOW, length) for start, length in zip(starts, shape, strict=False))
    ys, xs = (slice(start, end) for start, end in zip(starts, ends, strict=True))
    return ys, xs
