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
from chdstat.estimators.heldout import check_spp
from chdstat.estimators.progressive.first_hit import describe
from chdstat.estimators.progressive.pictures import Lot, Scene
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.splits import Parts, Splits
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
        The pixels of `splits` in their pictures, rows (y, x), scene by scene.
    excluded
        Pixels left out for a bad sample.
    parts
        How many of the pixels each scene gave, in order.
    """

    splits: Parts
    scenery: Scenery
    lesson: Lesson
    pixels: npt.NDArray[np.int64]
    excluded: int
    parts: Sequence[int]


def with_reference(
    scenes: Sequence[Scene],
    *,
    sizes: Sequence[int] | None,
    iterations: int | None,
) -> Material:
    """Return pixels with all their samples: the means of those not learned from are references.

    Each scene is measured in its own unit, so that none counts for being bright. All have as many
    samples as the one with the fewest.

    Raises
    ------
    InputError
        If there are too few samples per pixel for a size and an equally large reference, a size
        is less than 1, or the scenes differ in channels or features.
    """
    wanted = _LADDER if sizes is None else tuple(sizes)
    if not wanted or min(wanted) < 1:
        message = f"sizes must be one or more numbers of samples from 1, got {wanted}"
        raise InputError(message)
    for scene in scenes:
        check_spp(scene.samples, min(wanted) if sizes is None else max(wanted))
    _check_alike("channels", [scene.samples.shape[2] for scene in scenes])
    spp = min(_MOST_SPP, *(scene.samples.spp for scene in scenes))
    # One scene at a time: the samples of all pixels of one are much larger than what is kept.
    lots = [Lot.of(scene, spp) for scene in scenes]
    _check_alike("numbers of the first hit", [lot.described.shape[1] for lot in lots])
    lesson = Lesson(
        sizes=[n for n in wanted if n <= spp // 2],
        reference=True,
        iterations=_ITERATIONS if iterations is None else iterations,
    )
    rows = _joined([lot.rows for lot in lots])
    direct = [lot.direct for lot in lots if lot.direct is not None]
    nothing = Scenery.nothing(len(rows))
    return Material(
        splits=Splits(rows, unit=1.0, direct=_joined(direct) if direct else None),
        scenery=Scenery(
            np.concatenate([lot.described for lot in lots]), nothing.bands, nothing.weight
        ),
        lesson=lesson,
        pixels=np.concatenate([lot.pixels for lot in lots]),
        excluded=sum(lot.excluded for lot in lots),
        parts=[len(lot.rows) for lot in lots],
    )


def _joined(parts: Sequence[Picture]) -> Picture:
    """Return pixels of several scenes as those of one; what is one already is not copied."""
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _check_alike(what: str, found: Sequence[int]) -> None:
    if len(set(found)) > 1:
        message = f"scenes that train together must have the same {what}, got {list(found)}"
        raise InputError(message)


def without_reference(
    picture: Samples,
    *,
    features: Features | None,
    neighbours: bool,
    unit: float,
    iterations: int | None,
    rng: np.random.Generator,
    direct: Samples | None = None,
) -> Material:
    """Return a picture's pixels, each with splits of its own samples.

    Parameters
    ----------
    picture
        Of which a part is read, if it is large.
    features
        First-hit features of the picture, or none.
    neighbours
        Whether alike pixels around are asked; their answers are computed for every split.
    unit, iterations, rng
        As for the others.
    direct
        The direct part of the samples, where it is looked at. Surroundings are of the whole.

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
    part = picture.read(ys, xs)
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
    first = None if direct is None else direct.read(ys, xs).reshape(rows.shape)
    bad = is_bad(rows).any(axis=(1, 2))
    if first is not None:
        bad |= is_bad(first).any(axis=(1, 2))
    good = np.flatnonzero(~bad)
    splits = Splits(
        rows[good],
        unit=unit,
        prepared=[(places, shared[good]) for places, shared in prepared],
        direct=None if first is None else first[good],
    )
    corner = np.array([ys.start, xs.start])
    return Material(
        splits=splits,
        scenery=scenery_of(features, shape, profile)[good],
        lesson=lesson,
        pixels=np.stack(np.unravel_index(good, shape), axis=-1) + corner,
        excluded=len(rows) - len(good),
        parts=[len(good)],
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
    """Return a share of the samples, at least 2, with at least 2 to spare: they are cut in two."""
    return min(max(round(share * spp), 2), spp - 2)


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


def _window(shape: tuple[int, ...], rng: np.random.Generator) -> tuple[slice, slice]:
    """Return the part of a picture that trains."""
    starts = [int(rng.integers(max(length - _WINDOW, 0) + 1)) for length in shape[:2]]
    ends = (min(start + _WINDOW, length) for start, length in zip(starts, shape, strict=False))
    ys, xs = (slice(start, end) for start, end in zip(starts, ends, strict=True))
    return ys, xs
