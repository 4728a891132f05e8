"""Training of the progressive estimator, from images.

Training keeps many samples of some pixels of each image. Every minibatch splits the samples of a
pixel at random: one part is the input, and the mean of the other part is the target. A tenth of the
pixels is held out for validation and for the error model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, Indices, generator, is_bad, whole
from chdstat._core.image_scales import mean_radiance
from chdstat._core.work import cores, in_order, track
from chdstat.errors import InputError
from chdstat.estimators.held_out import check_spp, checked_pixels, draw_pixels, without
from chdstat.estimators.progressive.errors import FLOOR, ErrorModel, reference_shares, validate
from chdstat.estimators.progressive.inputs import Profile, describe
from chdstat.estimators.training import Trained, descend, provenance_of, scene_record, threads
from chdstat.samples import Samples

if TYPE_CHECKING:
    import torch

    from chdstat.estimators.progressive.network import Network, Output

__all__ = [
    "PIXELS",
    "Learned",
    "TrainingSet",
    "learn",
    "train_network",
    "weighted_losses",
]

_LADDER = (4, 8, 16, 16, 32, 32, 64, 64, 128, 256, 512)
"""Numbers of samples to learn from, as often as users ask for them."""
_MOST_SPP = 2048
PIXELS = 8192
"""Most pixels of one image if several train together."""
_MOST_PIXELS = 4 * PIXELS
"""Most pixels of all images together: more take memory and hardly help."""
_ITERATIONS = 6000
_VALIDATION = 0.1
"""Share of the pixels that are held out for validation and for the error model."""
_ENOUGH, _MARKS_NEEDED = 0.5, 4
"""An image is recognised if it contains this share of the expected marks (some pixels may be bad),
and at least so many."""
_SAME = 1e-6
"""Difference of logarithms up to which samples are the same, in any unit."""
_MOST_SAMPLES = 2**17
"""Most samples of a minibatch: the more samples a row has, the fewer rows are needed."""
_EQUAL = 1e-12
"""Share of the squares below which a variance is rounding: the samples are equal."""
_MARKS, _TRIED = 2048, 2**15
"""Most samples by which an image is recognised, and how many are drawn to find them."""
_DARKEST = 1e-3
"""Lower bound of a channel's mean radiance, in units of the image's: relative errors of a black
channel would outweigh all others."""
_POWERS = (0.0, 1.0)
"""Powers of the squared radiance by which the loss of each output is divided: MSE and relMSE."""
_MINIBATCH = 1024
_LEARNING_RATE = 2e-3
"""Learning rate at the start; it falls as a cosine to 0."""
_RECORDS, _APART = 40, 10
"""Most records of a training, and fewest iterations between two: a record takes as long as a
few."""
_VALIDATION_ROWS = 4096
_LARGEST_GRADIENT = 10.0
"""Norm to which gradients are limited, so that no firefly undoes many steps."""
_KEEP = 0.995
"""Share of the averaged weights that is kept at each step (averaging: Polyak and Juditsky 1992).
The targets are noisy, and so is each step."""
_AVERAGED = 0.1
"""Largest share of the steps that the average covers, so that short trainings forget their
start."""


@dataclass(frozen=True, kw_only=True)
class Learned(Trained):
    """A trained progressive estimator.

    Attributes
    ----------
    network, error_model
        The network, and the model of its errors.
    unit
        Mean radiance of the training image.
    marks
        Some of the training samples and their pixels, from `TrainingSet.marks`. They recognise an
        image that is given as an array, without provenance.
    """

    network: Network
    error_model: ErrorModel
    unit: float
    marks: tuple[Indices, Image]

    def pixels_of(self, shape: tuple[int, int]) -> Indices:
        """Return the training pixels of all images of a shape, rows (y, x)."""
        scenes = self.provenance["scenes"]
        ends = np.cumsum([scene["pixels_used"] for scene in scenes])
        found = [
            pixels
            for pixels, scene in zip(np.split(self.train_pixels, ends[:-1]), scenes, strict=True)
            if tuple(scene["samples_shape"][:2]) == tuple(shape)
        ]
        return np.unique(np.concatenate(found or [np.empty((0, 2), np.int64)]), axis=0)

    def recognises(self, x: npt.NDArray[Any]) -> bool:
        """Return whether samples (y, x, channel, sample), in any order or unit, trained it."""
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
            # For a training image, one factor (the unit) maps many marks to samples of their
            # pixels.
            near = np.concatenate([ratio, ratio + 1], axis=1)
            found = np.concatenate([np.unique(row[np.isfinite(row)]) for row in near])
            most = np.unique(found, return_counts=True)[1].max(initial=0)
            expected = own.sum() * min(1.0, x.shape[-1] / spp)
            if most >= max(_ENOUGH * expected, _MARKS_NEEDED):
                return True
        return False


@dataclass(eq=False, kw_only=True)
class TrainingSet:
    """Training pixels, with all their samples.

    Attributes
    ----------
    samples
        Good samples in units of their image's mean radiance, shape (pixel, channel, sample).
    described
        Numbers that describe the first hit, shape (pixel, number); None without features.
    sizes
        Numbers of samples to learn from; each minibatch draws one.
    iterations
        Number of minibatches.
    pixels
        Positions of the pixels in their images, rows (y, x), scene by scene.
    excluded
        Number of pixels that were left out for a bad sample.
    scenes
        Provenance of each scene; ``pixels_used`` is the number of its pixels here.
    mean, variance
        Mean of all samples of a pixel, and variance of one, shape (pixel, channel).
    """

    samples: Image
    described: Image | None = None
    sizes: Sequence[int] = ()
    iterations: int = _ITERATIONS
    pixels: Indices = field(default_factory=lambda: np.empty((0, 2), np.int64))
    excluded: int = 0
    scenes: Sequence[Mapping[str, Any]] = ()

    def __post_init__(self) -> None:
        self.spp = self.samples.shape[-1]
        self._total = self.samples.sum(axis=-1, dtype=np.float64)
        self.mean = self._total / self.spp
        squares = np.einsum("rcn,rcn->rc", self.samples, self.samples, dtype=np.float64)
        around = squares - self._total**2 / self.spp
        around[around <= _EQUAL * squares] = 0
        self.variance = around / max(self.spp - 1, 1)

    @classmethod
    def of(
        cls,
        images: Sequence[Samples],
        *,
        pixels: Sequence[npt.ArrayLike] | None,
        with_features: bool,
        sizes: Sequence[int] | None,
        iterations: int | None,
        seed: int,
    ) -> TrainingSet:
        """Return pixels of several images with all their samples, each image in its own unit.

        So bright images count no more than dark ones. All pixels get as many samples as the image
        with the fewest has.

        Raises
        ------
        InputError
            As for `Progressive.train`.
        """
        wanted = _LADDER if sizes is None else tuple(sizes)
        iterations = whole("iterations", _ITERATIONS if iterations is None else iterations, least=1)
        if not images:
            message = "training needs at least one image, got none"
            raise InputError(message)
        if not wanted or min(wanted) < 1:
            message = f"sizes must be one or more numbers of samples from 1, got {wanted}"
            raise InputError(message)
        if with_features and not all(image.features for image in images):
            message = "this image has no first-hit features; render it, or leave with_features out"
            raise InputError(message)
        _check_same("channels", [image.shape[2] for image in images])
        least = min(wanted) if sizes is None else max(wanted)
        for image in images:
            check_spp(image, least)
        spp = min(_MOST_SPP, *(image.fewest for image in images))
        found: list[tuple[Any, ...]] = []
        scenes, excluded = [], 0
        # One scene at a time: all samples of a scene take much more memory than what is kept.
        for image, own in zip(images, training_pixels(images, pixels, seed=seed), strict=True):
            shape, unit = image.shape[:2], mean_radiance(image)
            rows = _rows_of(image, own, spp)
            good = ~is_bad(rows).any(axis=(1, 2))
            rows = rows if good.all() else rows[good]
            rows /= np.float32(unit)
            place = tuple(own[good].T)
            first_hit = describe(image.features, shape)[place] if with_features else None
            found.append((rows, first_hit, own[good]))
            excluded += int((~good).sum())
            facts = {"unit": unit, "pixels_used": len(rows)}
            scenes.append(scene_record(image.name, image.attrs, image.shape, **facts))
        if with_features:
            _check_same("numbers of the first hit", [one[1].shape[1] for one in found])
        samples, described, kept = map(_joined, zip(*found, strict=True))
        return cls(
            samples=samples,
            described=described,
            sizes=[n for n in wanted if n <= spp // 2],
            iterations=iterations,
            pixels=kept,
            excluded=excluded,
            scenes=scenes,
        )

    def __len__(self) -> int:
        return len(self.samples)

    def draw(
        self, pixels: Indices, n: int, rows: int, rng: np.random.Generator
    ) -> tuple[Indices, Indices]:
        """Draw about `rows` of the given pixels (fewer if n is large), and n of their samples.

        The drawn sample indices are the same for all pixels: samples are exchangeable.
        """
        chosen = rng.choice(pixels, size=max(1, min(rows, _MOST_SAMPLES // n)))
        return chosen, rng.permutation(self.spp)[:n]

    def minibatch(self, rows: Indices, drawn: Indices) -> tuple[Profile, Image | None, Image]:
        """Return inputs and target for the pixels `rows`; `drawn` are the samples of the inputs.

        Returns
        -------
        profile, described
            Inputs of the network.
        target
            Mean of the other samples, shape (row, channel); 0 if there are none.
        """
        seen = self._take(rows, drawn)
        described = None if self.described is None else self.described[rows]
        others = without(self._total[rows], seen.sum(axis=-1, dtype=np.float64))
        target = others / max(self.spp - len(drawn), 1)
        return Profile.of(seen, unit=1.0), described, np.asarray(target, np.float32)

    def noise(
        self, rows: Indices, drawn: Indices, rng: np.random.Generator
    ) -> npt.NDArray[np.float64]:
        """Return an unbiased estimate of the variance of the target, shape (row, channel).

        The target is split into parts of a and b samples with the means t and u. The estimate is
        ``(t - u)^2 a b / (a + b)^2``.
        """
        others = rng.permutation(np.setdiff1d(np.arange(self.spp), drawn))
        one, two = np.array_split(others, 2)
        means = [self._take(rows, half).mean(-1, np.float64) for half in (one, two)]
        a, b = len(one), len(two)
        return np.asarray((means[1] - means[0]) ** 2 * (a * b / (a + b) ** 2))

    def marks(self, rng: np.random.Generator) -> tuple[Indices, Image]:
        """Draw samples that occur in one pixel only; they recognise the images.

        Returns
        -------
        pixels : ndarray
            Index of the image, y and x, shape (mark, 3).
        samples : ndarray
            The samples, in units of the image's radiance, shape (mark, channel).
        """
        # Without replacement: in a small image all are tried.
        tried = np.unique(rng.integers(len(self) * self.spp, size=_TRIED))
        rows, places = np.divmod(tried, self.spp)
        drawn = self.samples[rows, :, places]
        _, first, count = np.unique(drawn, axis=0, return_index=True, return_counts=True)
        chosen = rng.permutation(first[(count == 1) & drawn[first].all(axis=1)])[:_MARKS]
        used = [scene["pixels_used"] for scene in self.scenes]
        image = np.repeat(np.arange(len(used)), used)[rows[chosen]]
        return np.column_stack([image, self.pixels[rows[chosen]]]), drawn[chosen]

    def _take(self, rows: Indices, drawn: Indices) -> Image:
        """Return some samples of some pixels, shape (row, channel, sample)."""
        _, channels, spp = self.samples.shape
        starts = (rows[:, np.newaxis] * channels + np.arange(channels)) * spp
        return np.asarray(self.samples.reshape(-1).take(starts[..., np.newaxis] + drawn))


def training_pixels(
    images: Sequence[Samples], given: Sequence[npt.ArrayLike] | None, *, seed: int
) -> list[Indices]:
    """Return the training pixels of several images that train together, rows (y, x).

    With many images, each contributes fewer pixels: a part of those that it would contribute alone.

    Raises
    ------
    InputError
        If there are not as many arrays as images, or an array holds pixels outside its image.
    """
    if given is None:
        count = min(PIXELS, _MOST_PIXELS // len(images))
        return [draw_pixels(image.shape[:2], count, seed=seed) for image in images]
    if len(given) != len(images):
        message = f"pixels must be one array for each of {len(images)} images, got {len(given)}"
        raise InputError(message)
    shapes = (image.shape[:2] for image in images)
    return [checked_pixels(one, shape) for one, shape in zip(given, shapes, strict=True)]


def _rows_of(image: Samples, pixels: Indices, spp: int) -> Image:
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


def _joined(arrays: Sequence[Any]) -> Any:
    """Concatenate the pixels of several scenes; a single array is not copied."""
    return np.concatenate(arrays) if len(arrays) > 1 and arrays[0] is not None else arrays[0]


def _check_same(what: str, found: Sequence[int]) -> None:
    if len(set(found)) > 1:
        message = f"scenes that train together must have the same {what}, got {list(found)}"
        raise InputError(message)


def train_network(training_set: TrainingSet, *, seed: int, progress: bool | None) -> Learned:
    """Train a new network, and measure how far to follow it and how large its errors are.

    Raises
    ------
    InputError
        If there are too few pixels.
    """
    import torch

    from chdstat.estimators.progressive.network import Network

    count = len(training_set)
    if count < 2:
        message = (
            f"training needs at least 2 pixels without a bad sample, got {count}; give a larger "
            "image, or one without bad samples"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    validation, train = np.split(rng.permutation(count), [max(1, round(count * _VALIDATION))])
    described = training_set.described
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        channels = training_set.samples.shape[1]
        network = Network(channels, 0 if described is None else described.shape[1])
    with track("training", training_set.iterations, unit="it", show=progress) as advance:
        history = learn(network, training_set, train, validation, rng=rng, advance=advance)
    # Rare lamps and fireflies are hardly found in a tenth of the pixels.
    everywhere = validate(network, training_set, pixels=np.arange(count), rng=rng)
    network.shrinkage = reference_shares(everywhere)
    scenes = training_set.scenes
    shape = scenes[0]["samples_shape"]
    return Learned(
        network=network,
        error_model=ErrorModel.learn(network, training_set, pixels=validation, rng=rng),
        unit=float(np.exp(np.mean([np.log(scene["unit"]) for scene in scenes]))),
        marks=training_set.marks(generator(seed).spawn(2)[1]),
        history=history,
        train_pixels=training_set.pixels,
        train_shape=(shape[0], shape[1]),
        provenance=provenance_of(
            ", ".join(scene["scene"] for scene in scenes),
            scenes[0]["samples"],
            shape,
            scenes=list(scenes),
            with_features=described is not None,
            seed=seed,
            pixels_used=len(training_set.pixels),
            pixels_excluded=training_set.excluded,
            sizes=sorted(set(training_set.sizes)),
            iterations=training_set.iterations,
        ),
    )


def learn(
    network: Network,
    training_set: TrainingSet,
    train: Indices,
    validation: Indices,
    *,
    rng: np.random.Generator,
    advance: Callable[[float], None],
) -> npt.NDArray[np.float64]:
    """Train a network in place.

    Parameters
    ----------
    network
        Afterwards it holds the average of its weights over the last steps, on the GPU if torch
        finds one.
    training_set
        The training pixels.
    train, validation
        Indices of the pixels for training and for validation.
    rng
        Draws minibatches.
    advance
        Called after every iteration.

    Returns
    -------
    ndarray
        Rows of `History`; the baseline is the loss of the sample mean.
    """
    import torch
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    iterations = training_set.iterations
    network.to("cuda" if torch.cuda.is_available() else "cpu").train()
    keep = min(_KEEP, max(0.0, 1 - 1 / (_AVERAGED * iterations)))
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(keep))  # type: ignore[no-untyped-call]
    losses_of = weighted_losses(training_set, network.answer.weight.device)

    def drawn(pixels: Indices, n: int, rows: int, own: np.random.Generator) -> tuple[Any, ...]:
        return (*training_set.minibatch(*training_set.draw(pixels, n, rows, own)), n)

    def losses(
        model: torch.nn.Module, minibatch: tuple[Any, ...]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        profile, described, target, size = minibatch
        return losses_of(model(profile, described), target, size)

    # All records use the same splits, at the middle number of samples.
    middle = sorted(training_set.sizes)[len(training_set.sizes) // 2]
    held_out = drawn(validation, middle, _VALIDATION_ROWS, rng)
    own, sizes = rng.spawn(1)[0], rng.choice(training_set.sizes, iterations).tolist()
    # Each minibatch is drawn while the previous one trains; one worker keeps their order.
    minibatches = in_order(lambda n: drawn(train, n, _MINIBATCH, own), sizes, workers=1)
    history = []
    with threads(max(1, cores() - 1)):
        for iteration, seen in descend(
            list(network.parameters()),
            (losses(network, minibatch) for minibatch in minibatches),
            iterations=iterations,
            every=max(_APART, iterations // _RECORDS),
            learning_rate=_LEARNING_RATE,
            annealed=True,
            largest_gradient=_LARGEST_GRADIENT,
            after_step=lambda: average.update_parameters(network),
            advance=advance,
        ):
            with torch.inference_mode():
                outside, of_mean = map(float, losses(average.module, held_out))
            fit, baseline = np.mean([[float(loss) for loss in pair] for pair in seen], axis=0)
            history.append((iteration, fit, outside, baseline, of_mean))
    network.load_state_dict(average.module.state_dict())
    network.eval()
    return np.array(history)


def weighted_losses(
    training_set: TrainingSet, place: torch.device
) -> Callable[[Output, Image, int], tuple[torch.Tensor, torch.Tensor]]:
    """Return the loss of a network, in units of the average loss of the mean of as many samples.

    It takes the output of the network, the target (row, channel), and the number of input samples.
    It returns the summed loss of both estimates, and the loss of the mean.
    """
    import torch

    mean, variance = training_set.mean, training_set.variance
    floor = FLOOR * np.maximum(mean.mean(axis=0), _DARKEST) ** 2
    scales = np.array([(variance / (mean**2 + floor) ** power).mean() for power in _POWERS])
    scales = np.where(scales > 0, scales, 1.0)
    dark = torch.from_numpy(floor.astype(np.float32)).to(place)

    def losses_of(output: Output, target: Image, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        estimate, of_samples, _ = output
        wanted = torch.from_numpy(target).to(place)
        weight = torch.stack(
            [
                size / scale / (wanted**2 + dark) ** power
                for power, scale in zip(_POWERS, scales, strict=True)
            ],
            dim=1,
        )
        errors = estimate - wanted[:, None], (of_samples - wanted)[:, None]
        loss, baseline = ((weight * error**2).mean() for error in errors)
        return loss, baseline

    return losses_of
