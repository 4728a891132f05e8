"""Training sets of the progressive estimator, with a reference or from split samples.

An image, or several with a reference, gives pixels with their samples and auxiliary features. With
a reference many samples a pixel are kept, and the mean of those not learned from is the reference.
Without one, pixels of a part of the image are kept, each with splits of its own samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import is_bad
from chdstat.errors import InputError
from chdstat.estimators.neighbourhood import shared_patches
from chdstat.estimators.progressive.auxiliary import BANDS, RADII, Features, describe, pool_around
from chdstat.estimators.progressive.profile import Profile
from chdstat.estimators.progressive.splits import MinibatchSource, SampleSplits
from chdstat.estimators.validation import check_spp, checked_pixels, draw_pixels
from chdstat.samples import Samples

__all__ = [
    "AuxiliaryFeatures",
    "TrainingConfig",
    "TrainingImage",
    "TrainingPixels",
    "TrainingSet",
    "auxiliary_features",
    "chosen_pixels",
    "shared_estimates",
    "with_reference",
    "without_reference",
]

_PIXELS = 8192
"""Of a scene, at most."""
_MOST_PIXELS = 4 * _PIXELS
"""Of all scenes together: more take memory, and tell little."""


@dataclass(frozen=True)
class TrainingImage:
    """An image that trains.

    Attributes
    ----------
    samples
        The image.
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
class TrainingPixels:
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
    def of(cls, scene: TrainingImage, spp: int) -> TrainingPixels:
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
    images: Sequence[Samples], given: Any, *, reference: bool, seed: int
) -> list[npt.NDArray[np.int64] | None]:
    """Return the pixels of each image that train, rows (y, x): those given, or drawn, or all.

    An image draws fewer beside many others, from those that it draws alone.

    Parameters
    ----------
    images
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
        If there are not as many arrays as images, or one is not of pixels of its image.
    """
    if given is None and not reference:
        return [None] * len(images)
    if given is None:
        count = min(_PIXELS, _MOST_PIXELS // len(images))
        return [draw_pixels(image.shape[:2], count, seed=seed) for image in images]
    if len(given) != len(images):
        message = f"pixels must be one array for each of {len(images)} images, got {len(given)}"
        raise InputError(message)
    shapes = (image.shape[:2] for image in images)
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


_LADDER = (4, 8, 16, 16, 32, 32, 64, 64, 128, 256, 512)
"""Numbers of samples to learn from where there is a reference: as people ask for them."""
_MOST_SPP = 2048
_ITERATIONS = 6000
_ITERATIONS_ALONE = 2000
"""Without a reference: more of them learn the noise of the targets."""
_FEWEST = 4
_HALVES = 2
"""Samples of each part of a split, at least: the targets are cut in two."""
_SPLITS = ((0.5, 2), (0.75, 8))
"""Shares of the samples to learn from, and how many splits of each are made for estimates from
similar pixels: the larger share is nearer to all samples, which are estimated from in the end."""
_SPLITS_OF_SIZE = 5
"""Splits of each size that is given, instead."""
_WINDOW = 256
"""Side of the part of a large image that trains: more would take long and tell little."""

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class AuxiliaryFeatures:
    """Features of pixels beside their samples, one row a pixel.

    Attributes
    ----------
    described
        Of the first hit, shape (pixel, number).
    bands, weight
        Of the neighbourhood, shape (pixel, radius, band, 1 + channel) and (pixel, radius).
    """

    described: npt.NDArray[np.float32]
    bands: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]

    @classmethod
    def nothing(cls, pixels: int) -> AuxiliaryFeatures:
        """Return no features."""
        empty = np.zeros((pixels, 0), np.float32)
        return cls(empty, np.zeros((pixels, 0, BANDS, 1), np.float32), empty)

    def __getitem__(self, pixels: npt.NDArray[np.int64] | slice) -> AuxiliaryFeatures:
        """Return that of some pixels."""
        return AuxiliaryFeatures(self.described[pixels], self.bands[pixels], self.weight[pixels])


@dataclass(frozen=True)
class TrainingConfig:
    """Options of a training.

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
class TrainingSet:
    """Pixels that train a network, and how.

    Attributes
    ----------
    splits, auxiliary, config
        For `training.learn`.
    pixels
        The pixels of `splits` in their images, rows (y, x), scene by scene.
    excluded
        Pixels left out for a bad sample.
    parts
        How many of the pixels each scene gave, in order.
    """

    splits: MinibatchSource
    auxiliary: AuxiliaryFeatures
    config: TrainingConfig
    pixels: npt.NDArray[np.int64]
    excluded: int
    parts: Sequence[int]


def with_reference(
    scenes: Sequence[TrainingImage],
    *,
    sizes: Sequence[int] | None,
    iterations: int | None,
) -> TrainingSet:
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
    _check_same("channels", [scene.samples.shape[2] for scene in scenes])
    spp = min(_MOST_SPP, *(scene.samples.spp for scene in scenes))
    # One scene at a time: the samples of all pixels of one are much larger than what is kept.
    read = [TrainingPixels.of(scene, spp) for scene in scenes]
    _check_same("numbers of the first hit", [image.described.shape[1] for image in read])
    config = TrainingConfig(
        sizes=[n for n in wanted if n <= spp // 2],
        reference=True,
        iterations=_ITERATIONS if iterations is None else iterations,
    )
    rows = _joined([image.rows for image in read])
    direct = [image.direct for image in read if image.direct is not None]
    nothing = AuxiliaryFeatures.nothing(len(rows))
    return TrainingSet(
        splits=SampleSplits(rows, unit=1.0, direct=_joined(direct) if direct else None),
        auxiliary=AuxiliaryFeatures(
            np.concatenate([image.described for image in read]), nothing.bands, nothing.weight
        ),
        config=config,
        pixels=np.concatenate([image.pixels for image in read]),
        excluded=sum(image.excluded for image in read),
        parts=[len(image.rows) for image in read],
    )


def _joined(parts: Sequence[Image]) -> Image:
    """Return pixels of several scenes as those of one; what is one already is not copied."""
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _check_same(what: str, found: Sequence[int]) -> None:
    if len(set(found)) > 1:
        message = f"scenes that train together must have the same {what}, got {list(found)}"
        raise InputError(message)


def without_reference(
    scene: TrainingImage,
    *,
    neighbours: bool,
    sizes: Sequence[int] | None,
    iterations: int | None,
    rng: np.random.Generator,
) -> TrainingSet:
    """Return pixels of a scene, each with splits of its own samples.

    Parameters
    ----------
    scene
        Of which a part is read, if it is large.
    neighbours
        Whether similar pixels around are an input; their estimates are computed for every split.
    sizes, iterations, rng
        As for the others.

    Raises
    ------
    InputError
        If there are fewer than 4 samples per pixel, or not at least 2 to learn from and 2 others.
    """
    spp = scene.samples.spp
    if spp < _FEWEST:
        message = f"learning from halves of the samples needs at least {_FEWEST} spp, got {spp}"
        raise InputError(message)
    splits = [(_share_of(spp, share), times) for share, times in _SPLITS]
    if sizes is not None:
        splits = [(n, _SPLITS_OF_SIZE) for n in sizes]
    if not splits or not all(_HALVES <= n <= spp - _HALVES for n, _ in splits):
        message = (
            f"without a reference, sizes must be numbers of samples from {_HALVES} to "
            f"{spp - _HALVES}, got {sizes}"
        )
        raise InputError(message)
    ys, xs = _window(scene, rng)
    part = scene.samples.read(ys, xs)
    shape = part.shape[:2]
    prepared = _prepared(part, splits, rng) if neighbours else []
    config = TrainingConfig(
        sizes=[len(places) for places, _ in prepared] or [n for n, _ in splits],
        reference=False,
        iterations=_ITERATIONS_ALONE if iterations is None else iterations,
    )
    features = scene.features and {k: v[ys, xs] for k, v in scene.features.items()}
    profile = Profile.of(part, unit=scene.unit) if neighbours else None
    rows = part.reshape(-1, *part.shape[2:])
    direct = None if scene.direct is None else scene.direct.read(ys, xs).reshape(rows.shape)
    chosen = np.full(scene.samples.shape[:2], scene.pixels is None)
    if scene.pixels is not None:
        chosen[tuple(scene.pixels.T)] = True
    wanted = chosen[ys, xs].ravel()
    bad = is_bad(rows).any(axis=(1, 2))
    if direct is not None:
        bad |= is_bad(direct).any(axis=(1, 2))
    good = np.flatnonzero(wanted & ~bad)
    corner = np.array([ys.start, xs.start])
    return TrainingSet(
        splits=SampleSplits(
            rows[good],
            unit=scene.unit,
            prepared=[(places, shared[good]) for places, shared in prepared],
            shared=shared_estimates(part)[good] if neighbours else None,
            direct=None if direct is None else direct[good],
        ),
        auxiliary=auxiliary_features(features, shape, profile)[good],
        config=config,
        pixels=np.stack(np.unravel_index(good, shape), axis=-1) + corner,
        excluded=int((wanted & bad).sum()),
        parts=[len(good)],
    )


def auxiliary_features(
    features: Features | None, shape: tuple[int, int], profile: Profile | None = None
) -> AuxiliaryFeatures:
    """Return the auxiliary features of pixels; of the neighbourhood where there is a profile."""
    count = shape[0] * shape[1]
    described = describe(features, shape).reshape(count, -1)
    if profile is None:
        nothing = AuxiliaryFeatures.nothing(count)
        return AuxiliaryFeatures(described, nothing.bands, nothing.weight)
    bands, weight = pool_around(profile, features)
    return AuxiliaryFeatures(
        described, bands.reshape(count, *bands.shape[2:]), weight.reshape(count, len(RADII))
    )


def _share_of(spp: int, share: float) -> int:
    """Return a share of the samples, at least 2, with at least 2 to spare: they are cut in two."""
    return min(max(round(share * spp), _HALVES), spp - _HALVES)


def _prepared(
    image: Image, splits: Sequence[tuple[int, int]], rng: np.random.Generator
) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]]:
    """Return splits of each size, with estimates from similar pixels (pixel, channel)."""
    spp, found = image.shape[-1], []
    for n, times in splits:
        # Of many samples, fewer splits differ enough, and each takes longer.
        for _ in range(times if spp <= 128 else max(1, times // 3)):
            places = rng.permutation(spp)
            found += [places[:n], places[n:]] if 2 * n == spp else [places[:n]]
    return [(places, shared_estimates(image[..., places])) for places in found]


def shared_estimates(image: Image) -> npt.NDArray[np.float32]:
    """Return estimates from similar pixels around (pixel, channel), 0 where there are none."""
    estimates = np.nan_to_num(shared_patches(image), nan=0, posinf=0)
    return np.asarray(estimates.reshape(-1, estimates.shape[-1]), np.float32)


def _window(scene: TrainingImage, rng: np.random.Generator) -> tuple[slice, slice]:
    """Return the part of an image that trains, around one of the chosen pixels."""
    shape = scene.samples.shape[:2]
    most = [max(length - _WINDOW, 0) for length in shape]
    if scene.pixels is None or not len(scene.pixels):
        starts = [int(rng.integers(last + 1)) for last in most]
    else:
        middle = scene.pixels[rng.integers(len(scene.pixels))]
        starts = [int(start) for start in np.clip(middle - _WINDOW // 2, 0, most)]
    ends = (min(start + _WINDOW, length) for start, length in zip(starts, shape, strict=True))
    ys, xs = (slice(start, end) for start, end in zip(starts, ends, strict=True))
    return ys, xs
