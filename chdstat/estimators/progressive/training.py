"""Training of the progressive estimator: from images to what was learned.

With a reference many samples are kept of some pixels of each image, and the mean of those not
learned from is the reference. Without one, pixels of a part of the image are kept, with all their
samples. A tenth of the pixels is held out, to validate, to measure how far it pays to follow the
network, and to fit its error model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, is_bad
from chdstat._core.image_scales import mean_radiance
from chdstat._core.progress import track
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import Indices, Profile, SampleSplits, TrainingSet
from chdstat.estimators.progressive.error_model import ErrorModel
from chdstat.estimators.progressive.inputs import InputConfig, shared_estimates, some_rows
from chdstat.estimators.progressive.shrinkage import measure_shrinkage
from chdstat.estimators.training import Trained, provenance_of, scene_record
from chdstat.estimators.validation import check_spp, direct_of
from chdstat.samples import Samples

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = [
    "FEWEST",
    "ITERATIONS_ALONE",
    "VALIDATION",
    "Learned",
    "finished",
    "train_network",
    "with_reference",
    "without_reference",
]

_LADDER = (4, 8, 16, 16, 32, 32, 64, 64, 128, 256, 512)
"""Numbers of samples to learn from where there is a reference: as people ask for them."""
_MOST_SPP = 2048
_ITERATIONS = 6000
ITERATIONS_ALONE = 2000
"""Without a reference: more of them learn the noise of the targets."""
FEWEST = 4
"""Samples to learn from, or to measure trust with: two halves, one of them cut in two."""
_HALVES = 2
"""Samples of each part of a split, at least: the targets are cut in two."""
_SPLITS = ((0.5, 2), (0.75, 8))
"""Shares of the samples to learn from, and how many splits of each are made for estimates from
similar pixels: the larger share is nearer to all samples, which are estimated from in the end."""
_SPLITS_OF_SIZE = 5
"""Splits of each size that is given, instead."""
_WINDOW = 256
"""Side of the part of a large image that trains: more would take long and tell little."""
VALIDATION = 0.1
"""Share of the pixels held out for validation, to measure how large the errors are."""
_ALONE, _MOST_VALIDATION = 512, 0.25
"""Without a reference that takes at least so many, up to this share: what they measure is noisy."""
_ENOUGH, _MARKS = 0.5, 4
"""Of the marks that are expected among the samples of an image: some pixels may be bad."""
_SAME = 1e-6
"""Logarithm of a ratio up to which samples are the same, in whatever unit."""

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Learned(Trained):
    """What the training of a progressive estimator leaves behind.

    Attributes
    ----------
    network, error_model
        What estimates, and what knows how large its errors are.
    unit
        Mean radiance of the image that it was trained on.
    marks
        Some of the samples that trained it, and their pixels, as of `TrainingSet.marks`: an array
        has no provenance, and by them its image is recognised.
    """

    network: Network
    error_model: ErrorModel
    unit: float
    marks: tuple[Indices, Array]

    def __post_init__(self) -> None:
        used = sum(int(scene["pixels_used"]) for scene in self.provenance["scenes"])
        if self.train_pixels.shape != (used, 2):
            message = f"its scenes have {used} pixels, got {self.train_pixels.shape}"
            raise ValueError(message)

    def pixels_of(self, shape: tuple[int, int]) -> Indices:
        """Return the pixels that trained in any image of a shape, rows (y, x)."""
        scenes = self.provenance["scenes"]
        ends = np.cumsum([scene["pixels_used"] for scene in scenes])
        found = [
            pixels
            for pixels, scene in zip(np.split(self.train_pixels, ends[:-1]), scenes, strict=True)
            if tuple(scene["samples_shape"][:2]) == tuple(shape)
        ]
        return np.unique(np.concatenate(found or [np.empty((0, 2), np.int64)]), axis=0)

    def recognises(self, x: npt.NDArray[Any]) -> bool:
        """Return whether samples (y, x, channel, sample), in any order and unit, trained it."""
        pixels, samples = self.marks
        for number, scene in enumerate(self.provenance["scenes"]):
            own, (*shape, spp) = pixels[:, 0] == number, scene["samples_shape"]
            if x.ndim != 4 or list(x.shape[:3]) != shape or not own.any():
                continue
            _, ys, xs = pixels[own].T
            drawn = x[ys, xs].mean(axis=1, dtype=np.float64)
            known = samples[own].mean(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.round(np.log(drawn / known[:, np.newaxis]) / _SAME)
            # One factor, that of the units, leads from many marks to a sample of their pixel.
            near = np.concatenate([ratio, ratio + 1], axis=1)
            found = np.concatenate([np.unique(row[np.isfinite(row)]) for row in near])
            most = np.unique(found, return_counts=True)[1].max(initial=0)
            expected = own.sum() * min(1.0, x.shape[-1] / spp)
            if most >= max(_ENOUGH * expected, _MARKS):
                return True
        return False


def with_reference(
    images: Sequence[Samples],
    pixels: Sequence[Indices],
    inputs: InputConfig,
    *,
    sizes: Sequence[int] | None,
) -> SampleSplits:
    """Return pixels with all their samples: the means of those not learned from are references.

    Each scene is measured in its own unit, so that none counts for being bright. All have as many
    samples as the one with the fewest.

    Raises
    ------
    InputError
        If there are too few samples per pixel for a size and an equally large reference, a size
        is less than 1, the scenes differ in channels or features, or an input is missing.
    """
    features = [inputs.features_of(image) for image in images]
    lights = [(image, direct_of(image)) if inputs.direct else (image,) for image in images]
    wanted = _LADDER if sizes is None else tuple(sizes)
    if not wanted or min(wanted) < 1:
        message = f"sizes must be one or more numbers of samples from 1, got {wanted}"
        raise InputError(message)
    for image in images:
        check_spp(image, min(wanted) if sizes is None else max(wanted))
    _check_same("channels", [image.shape[2] for image in images])
    spp = min(_MOST_SPP, *(image.spp for image in images))
    found, kept, auxiliary, scenes = [], [], [], []
    # One scene at a time: the samples of all pixels of one are much larger than what is kept.
    for image, own, parts, known in zip(images, pixels, lights, features, strict=True):
        unit = mean_radiance(image)
        rows = [_samples_of(part, own, spp) for part in parts]
        good = ~np.any([is_bad(part).any(axis=(1, 2)) for part in rows], axis=0)
        kept.append(own[good])
        found.append([part if good.all() else part[good] for part in rows])
        for part in found[-1]:
            part /= np.float32(unit)
        every = inputs.auxiliary(known, image.shape[:2])
        auxiliary.append(some_rows(every, np.ravel_multi_index(tuple(kept[-1].T), image.shape[:2])))
        scenes.append(
            scene_record(image.name, image.attrs, image.shape, unit=unit, pixels_used=len(kept[-1]))
        )
    if inputs.features:
        _check_same("numbers of the first hit", [one["described"].shape[1] for one in auxiliary])
    samples, *direct = (_joined(parts) for parts in zip(*found, strict=True))
    return SampleSplits(
        samples=samples,
        unit=1.0,
        direct=direct[0] if direct else None,
        sizes=[n for n in wanted if n <= spp // 2],
        reference=True,
        iterations=_ITERATIONS,
        auxiliary={name: _joined([one[name] for one in auxiliary]) for name in auxiliary[0]},
        pixels=np.concatenate(kept),
        excluded=sum(map(len, pixels)) - sum(map(len, kept)),
        scenes=scenes,
    )


def without_reference(
    image: Samples,
    pixels: Indices | None,
    inputs: InputConfig,
    *,
    sizes: Sequence[int] | None,
    rng: np.random.Generator,
) -> SampleSplits:
    """Return pixels of an image, of a part of it if it is large, to split their own samples.

    Parameters
    ----------
    image, pixels
        The image, and which of its pixels train, rows (y, x); None for all.
    inputs
        Where neighbours are an input, estimates from similar pixels are computed for every split.
    sizes
        As for `Progressive.train`.
    rng
        Draws the part of the image, and the splits.

    Raises
    ------
    InputError
        If there are fewer than 4 samples per pixel, not at least 2 to learn from and 2 others, or
        an input is missing.
    """
    known, spp = inputs.features_of(image), image.spp
    unit = mean_radiance(image)
    lights = (image, direct_of(image)) if inputs.direct else (image,)
    if spp < FEWEST:
        message = f"learning from halves of the samples needs at least {FEWEST} spp, got {spp}"
        raise InputError(message)
    splits = [
        (min(max(round(share * spp), _HALVES), spp - _HALVES), times) for share, times in _SPLITS
    ]
    if sizes is not None:
        splits = [(n, _SPLITS_OF_SIZE) for n in sizes]
    if not splits or not all(_HALVES <= n <= spp - _HALVES for n, _ in splits):
        message = (
            f"without a reference, sizes must be numbers of samples from {_HALVES} to "
            f"{spp - _HALVES}, got {sizes}"
        )
        raise InputError(message)
    ys, xs = _window(image.shape[:2], pixels, rng)
    part = image.read(ys, xs)
    shape = part.shape[:2]
    prepared = _prepared(part, splits, rng) if inputs.neighbours else []
    rows = [light.read(ys, xs).reshape(-1, *part.shape[2:]) for light in lights]
    chosen = np.full(image.shape[:2], pixels is None)
    if pixels is not None:
        chosen[tuple(pixels.T)] = True
    wanted = chosen[ys, xs].ravel()
    bad = np.any([is_bad(light).any(axis=(1, 2)) for light in rows], axis=0)
    good = np.flatnonzero(wanted & ~bad)
    own = None if known is None else {name: field[ys, xs] for name, field in known.items()}
    profile = Profile.of(part, unit=unit) if inputs.neighbours else None
    every = inputs.auxiliary(own, shape, profile=profile)
    record = scene_record(image.name, image.attrs, image.shape, unit=unit, pixels_used=len(good))
    return SampleSplits(
        samples=rows[0][good],
        unit=unit,
        direct=rows[1][good] if inputs.direct else None,
        prepared=[(drawn, shared[good]) for drawn, shared in prepared],
        sizes=[len(drawn) for drawn, _ in prepared if len(drawn) < spp] or [n for n, _ in splits],
        iterations=ITERATIONS_ALONE,
        auxiliary=some_rows(every, good),
        pixels=np.stack(np.unravel_index(good, shape), axis=-1) + np.array([ys.start, xs.start]),
        excluded=int((wanted & bad).sum()),
        scenes=[record],
    )


def _samples_of(image: Samples, pixels: Indices, spp: int) -> Array:
    """Return samples (pixel, channel, sample) of some pixels of an image."""
    rows = np.empty((len(pixels), image.shape[2], spp), np.float32)
    place = np.full(image.shape[:2], -1)
    place[tuple(pixels.T)] = np.arange(len(pixels))
    for ys, xs, ss, block in image.blocks():
        kept = block[..., : max(spp - ss.start, 0)]
        here = place[ys, xs]
        if kept.shape[-1]:
            rows[here[here >= 0], :, ss.start : ss.start + kept.shape[-1]] = kept[here >= 0]
    return rows


def _joined(arrays: Sequence[Array]) -> Array:
    """Return pixels of several scenes as those of one; one array alone is not copied."""
    return np.concatenate(arrays) if len(arrays) > 1 else arrays[0]


def _check_same(what: str, found: Sequence[int]) -> None:
    if len(set(found)) > 1:
        message = f"scenes that train together must have the same {what}, got {list(found)}"
        raise InputError(message)


def _prepared(
    image: npt.NDArray[Any], splits: Sequence[tuple[int, int]], rng: np.random.Generator
) -> list[tuple[Indices, Array]]:
    """Return splits of each size and all samples, with estimates from similar pixels."""
    spp = image.shape[-1]
    found = []
    for n, times in splits:
        # Of many samples, fewer splits differ enough, and each takes longer.
        for _ in range(times if spp <= 128 else max(1, times // 3)):
            places = rng.permutation(spp)
            found += [places[:n], places[n:]] if 2 * n == spp else [places[:n]]
    found.append(np.arange(spp))
    return [(drawn, shared_estimates(image[..., drawn])) for drawn in found]


def _window(
    shape: tuple[int, int], pixels: Indices | None, rng: np.random.Generator
) -> tuple[slice, slice]:
    """Return the part of an image that trains, around one of the chosen pixels."""
    most = [max(length - _WINDOW, 0) for length in shape]
    if pixels is None or not len(pixels):
        starts = [int(rng.integers(last + 1)) for last in most]
    else:
        middle = pixels[rng.integers(len(pixels))]
        starts = np.clip(middle - _WINDOW // 2, 0, most).tolist()
    ys, xs = (slice(a, min(a + _WINDOW, length)) for a, length in zip(starts, shape, strict=True))
    return ys, xs


def train_network(
    training_set: SampleSplits, inputs: InputConfig, *, seed: int, progress: bool | None
) -> Learned:
    """Train a new network; pixels held out for validation tell how large its errors are.

    Raises
    ------
    InputError
        If there are too few pixels.
    """
    from chdstat.estimators.progressive.network import learn, new_network

    count = len(training_set)
    if count < 2:
        message = (
            f"training needs at least 2 pixels without a bad sample, got {count}; give a larger "
            "image"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    order = rng.permutation(count)
    held_out = max(1, round(count * VALIDATION))
    if not training_set.reference:
        held_out = max(held_out, min(_ALONE, round(count * _MOST_VALIDATION)))
    validation, train = np.split(order, [held_out])
    network = new_network(training_set, inputs, seed=seed)
    with track("training", training_set.iterations, unit="it", show=progress) as advance:
        history = learn(network, training_set, train, validation, rng=rng, advance=advance)
    return finished(network, training_set, inputs, validation, history, rng=rng, seed=seed)


def finished(
    network: Network,
    training_set: TrainingSet,
    inputs: InputConfig,
    validation: Indices,
    history: npt.NDArray[np.float64],
    *,
    rng: np.random.Generator,
    seed: int,
    **facts: Any,
) -> Learned:
    """Measure how far to follow a trained network and how large its errors are.

    The network is not shrunk yet; the pixels of `validation` did not train it, and `rng` draws
    splits of them. Provenance also holds the `facts`.
    """
    network.shrinkage = measure_shrinkage(network, training_set, validation, rng)
    scenes = training_set.scenes
    shape = scenes[0]["samples_shape"]
    provenance = provenance_of(
        ", ".join(scene["scene"] for scene in scenes),
        scenes[0]["samples"],
        shape,
        scenes=list(scenes),
        reference=training_set.reference,
        inputs=list(inputs.names),
        seed=seed,
        pixels_used=len(training_set.pixels),
        pixels_excluded=training_set.excluded,
        sizes=sorted(set(training_set.sizes)),
        iterations=training_set.iterations,
        trust=float(network.shrinkage[1].mean()),
    )
    return Learned(
        network=network,
        error_model=ErrorModel.learn(network, training_set, pixels=validation, rng=rng),
        unit=float(np.exp(np.mean([np.log(scene["unit"]) for scene in scenes]))),
        marks=training_set.marks(generator(seed).spawn(2)[1]),
        history=history,
        train_pixels=training_set.pixels,
        train_shape=(shape[0], shape[1]),
        provenance=provenance | facts,
    )
