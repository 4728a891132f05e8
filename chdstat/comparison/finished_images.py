"""Errors of images: how far finished renders of a view are from the truth.

Of the truth, a reference tells: another render with its samples, whose noise is subtracted by the
judge (`chdstat.comparison.judges`), or an image, which counts as the truth. `image_errors` measures
the mean squared error, the relative one, and FLIP, with intervals over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Floats, spans
from chdstat._core.display import Card, Tabled, number, with_interval
from chdstat._core.resampling import Blocks, Interval, mean_of
from chdstat._core.work import finished
from chdstat.comparison.judges import PARTS, Judge, PartialSums
from chdstat.comparison.judging import Units
from chdstat.comparison.metrics import HAS_FLIP, errors_of, exposures, flip, measures_of, moved
from chdstat.errors import InputError
from chdstat.inference.references import Reference
from chdstat.samples import ImageLike, Samples, samples_of

_ERRORS = {"mse": "MSE", "relmse": "relMSE", "flip": "FLIP"}
_ENDS = ("value", "low", "high")
_SAME = 1e-6
"""Relative difference up to which an image is an exact reference, up to rounding."""
_TILE, _REACH = 64, 12
"""Edge of the tiles of FLIP, and more pixels than its filters reach at 67 pixels per degree."""
_WIDEST = 1e3
"""Upper ends of so many times the error say nothing: all of it lies in a few pixels."""
_BLOCKS = 8
"""Blocks along each side of the image, as for estimators."""


@dataclass(frozen=True)
class Truth:
    """What a reference tells of the truth: its judge, and means of each half of its samples.

    Attributes
    ----------
    judge
        Of the whole image.
    halves
        Shape (2, y, x, channel).
    """

    judge: Judge
    halves: Array

    @classmethod
    def of(cls, name: str, sums: PartialSums) -> Truth:
        """Return that of sums over samples.

        Raises
        ------
        InputError
            If no pixel has a good sample in each of the four parts.
        """
        found = sums.judge()
        if not np.isfinite(found.mean).any():
            message = f"the reference of {name} has no pixel with {PARTS} good samples"
            raise InputError(message)
        return cls(found, sums.halves)

    @classmethod
    def of_parts(cls, parts: Array) -> Truth:
        """Return that of means of equally many samples, shape (4, y, x, channel)."""
        known = np.isfinite(parts).all(axis=(0, -1))
        scene_mean = parts[:, known].mean(axis=(0, 1)) if known.any() else np.ones(parts.shape[-1])
        error = parts.std(axis=0, ddof=1) / np.sqrt(PARTS)
        halves = np.stack([parts[k::2].mean(axis=0) for k in range(2)])
        return cls(Judge.of_image(parts, error, scene_mean), halves)


@dataclass(frozen=True, repr=False)
class ImageErrors(Tabled):
    """Errors of images against one reference, averaged over its channels.

    Attributes
    ----------
    reference
        Name of the reference.
    errors
        By the name of an image, and by "mse", "relmse" and "flip": values with 95 % intervals; NaN
        where the reference cannot tell.
    noise
        What became of the noise of the reference.
    exposures
        Least and largest exposure of FLIP, in stops.
    why
        By the name of an image, why nothing is told of it.
    """

    reference: str
    errors: Mapping[str, Mapping[str, Interval[float]]]
    noise: str
    exposures: tuple[float, float]
    why: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each image; ``_low`` and ``_high`` are the ends of intervals."""
        ends = {"": "value", "_low": "low", "_high": "high"}
        return [
            {"image": name}
            | {f"{k}{end}": getattr(of[k], part) for k in of for end, part in ends.items()}
            for name, of in self.errors.items()
        ]

    @property
    def shown(self) -> list[dict[str, str]]:
        """The table as text."""
        return [
            {"image": name, **{_ERRORS[k]: _in_words(found) for k, found in of.items()}}
            for name, of in self.errors.items()
        ]

    @property
    def notes(self) -> list[str]:
        """What is to be known of the numbers, in phrases."""
        found = [self.noise, "95 % intervals over blocks of the image"]
        low, high = self.exposures
        found.append(
            f"FLIP as displayed in sRGB at exposures from {low:+.1f} to {high:+.1f} stops, "
            "67 pixels per degree".replace("-", "−")
            if HAS_FLIP
            else "FLIP is not measured; pip install 'chdstat[flip]' adds it"
        )
        return [*found, *(f"{name}: {text}" for name, text in self.why.items())]

    def _card(self) -> Card:
        facts = {f"{i + 1}": text for i, text in enumerate(self.notes)}
        return Card(f"Errors against {self.reference}", facts, self.shown)


def _in_words(found: Interval[float]) -> str:
    """Return an error with its interval; of one that may be 0, with the upper end."""
    if not np.isfinite(found.value):
        return "cannot tell"
    if found.low <= 0 < found.high:
        if found.value <= 0:
            return f"< {number(found.high)}"
        known = found.high < _WIDEST * found.value
        most = f"< {number(found.high)}" if known else "upper end unknown"
        return f"{number(found.value)} ({most})"
    return with_interval(found.value, found.low, found.high)


def image_errors(
    images: Mapping[str, ImageLike | npt.ArrayLike],
    reference: ImageLike | Reference | npt.ArrayLike,
) -> ImageErrors:
    r"""Measure how far images are from the truth: MSE, relMSE and FLIP, with intervals.

    Against samples, the error is that against their expected value: their own noise is subtracted,
    since the products of differences to means of disjoint samples hold none. So the errors of two
    renders against each other differ: each is that of the render, not of both. FLIP is no such
    product; against means of half of the samples it is larger, and is extrapolated to no noise, as
    relMSE is (:doc:`/understand/judging`). Where it moves by more than a fifth, nothing is told.

    An image counts as the truth: its noise stays in the errors.

    Parameters
    ----------
    images
        By name: arrays (y, x, channel), EXR files, `Samples`, or stores, of which the mean counts.
    reference
        A store or `Samples` that share no samples or random numbers with the images; or an image,
        with batches if it is a `Reference` that has them.

    Returns
    -------
    ImageErrors
        A table, and what is to be known of it.

    Raises
    ------
    InputError
        If sizes differ, or no pixel of the reference is known.
    StoreError
        If a file is missing or damaged.

    References
    ----------
    Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild, "FLIP: A Difference
    Evaluator for Alternating Images", 2020, doi:10.1145/3406183; for linear radiance: Andersson,
    Nilsson, Shirley and Akenine-Möller 2021, doi:10.2312/egs.20211015.

    Examples
    --------
    >>> x = np.random.default_rng(1).exponential(size=(2, 32, 32, 3, 64))
    >>> found = image_errors({"mean of 64": x[0].mean(axis=-1)}, x[1])
    >>> error = found.errors["mean of 64"]["mse"]
    >>> error.low < 1 / 64 < error.high
    True
    """
    return finished(measuring_errors(images, reference))


def measuring_errors(
    images: Mapping[str, ImageLike | npt.ArrayLike],
    reference: ImageLike | Reference | npt.ArrayLike,
    *,
    name: str = "",
    means: Mapping[str, Array] | None = None,
) -> Generator[tuple[str, float], None, ImageErrors]:
    """Return what `image_errors` does, in steps.

    Yields what is being done, and the share that is done. `name` is that of the reference, `means`
    are those of samples whose mean is known.
    """
    truth, noise, known_name, samples = yield from _truth_of(reference)
    judge = truth.judge
    known = np.asarray(np.isfinite(judge.mean).all(axis=-1))
    if not known.any():
        message = "the reference has no pixel that is a number in every channel"
        raise InputError(message)
    stops = exposures(np.nan_to_num(judge.mean))
    errors, why = {}, {}
    for i, (of, given) in enumerate(images.items()):
        yield "measuring errors", (1 + i / len(images)) / 2
        own = None if Reference.of(given) else samples_of(given, averages=True, dependent=True)
        if samples is not None and own is not None and own.shares_numbers_with(samples):
            why[of] = "it has the random numbers of the reference; render it with another seed"
            errors[of] = {k: Interval.unknown() for k in _ERRORS if k != "flip" or HAS_FLIP}
            continue
        found = (means or {}).get(of)
        mean = (yield from _mean_of(given if own is None else own)) if found is None else found
        if mean.shape != judge.mean.shape:
            message = (
                f"{of} must have the shape of the reference, {judge.mean.shape}, got {mean.shape}"
            )
            raise InputError(message)
        errors[of] = yield from _errors(mean, truth, known, stops)
    return ImageErrors(name or known_name, errors, noise, stops, why)


def _truth_of(
    given: Any,
) -> Generator[tuple[str, float], None, tuple[Truth, str, str, Samples | None]]:
    """Return what a reference tells, what becomes of its noise, its name and its samples."""
    image = Reference.of(given)
    if image is not None and image.batches is None:
        parts = np.broadcast_to(image.mean, (PARTS, *image.shape))
        noise = f"{image.name} counts as the truth: its noise stays in the errors"
        return Truth.of_parts(parts), noise, image.name, None
    if image is not None and image.batches is not None:
        parts = np.stack([image.batches[..., k::PARTS].mean(axis=-1) for k in range(PARTS)])
        return Truth.of_parts(parts), f"the noise of {image.name} is subtracted", image.name, None
    samples = samples_of(given, averages=True)
    sums = yield from PartialSums.adding(samples)
    noise = f"the noise of the reference, a mean of {samples.spp} samples, is subtracted"
    return Truth.of(samples.name, sums), noise, samples.name, samples


def _mean_of(given: Any) -> Generator[tuple[str, float], None, Floats]:
    if isinstance(given, Samples):
        sums = yield from PartialSums.adding(given)
        return sums.mean
    image = Reference.of(given)
    assert image is not None
    return image.mean


def _errors(
    mean: Array, truth: Truth, known: npt.NDArray[np.bool_], stops: tuple[float, float]
) -> Generator[tuple[str, float], None, dict[str, Interval[float]]]:
    """Return the errors of an image; a pixel that is no number in it is left out."""
    where = known & np.isfinite(mean).all(axis=-1)
    if not where.any():
        return {k: Interval.unknown() for k in _ERRORS if k != "flip" or HAS_FLIP}
    units = Units.of(where)
    at, image = truth.judge[units.ys, units.xs], units(mean)
    found = errors_of(image, image, at, scene_mean=at.mean.mean(axis=0))
    sums = np.repeat(units.sum(found)[:, :, np.newaxis], 2, axis=2)
    measures = measures_of(sums, seed=0)
    same = bool((np.abs(image - at.mean) <= _SAME * np.abs(at.mean)).all())
    errors = {
        k: Interval(0.0, 0.0, 0.0)
        if same and not at.error.any()
        else Interval(*(float(getattr(measures[k], end)[0, -1]) for end in _ENDS))
        for k in ("mse", "relmse")
    }
    if HAS_FLIP:
        errors["flip"] = yield from _flip(mean, truth, where, stops)
    return errors


def _flip(
    mean: Array, truth: Truth, where: npt.NDArray[np.bool_], stops: tuple[float, float]
) -> Generator[tuple[str, float], None, Interval[float]]:
    """Return FLIP, extrapolated from references of half of the samples; NaN if that decides it."""
    image = np.where(where[..., np.newaxis], mean, 0).astype(np.float64)
    references = [np.nan_to_num(x) for x in (truth.judge.mean, *truth.halves)]
    found = [np.zeros(where.shape)] * len(references)
    for i, reference in enumerate(references):
        for share, found[i] in flip_in_tiles(image, reference, stops):
            yield "measuring FLIP", (i + share) / len(references)
    whole, half = found[0][where], np.mean(found[1:], axis=0)[where]
    if not whole.any():
        return Interval(0.0, 0.0, 0.0)
    if moved(whole.mean(), half.mean()):
        return Interval.unknown()
    blocks = Blocks.grid(*where.shape, across=_BLOCKS)[where.ravel()]
    return mean_of(2 * whole - half, blocks)


def flip_in_tiles(
    image: Array, reference: Array, stops: tuple[float, float]
) -> Iterator[tuple[float, Floats]]:
    """Yield the share of the tiles that are done, and FLIP so far, shape (y, x).

    The evaluator lets no other thread run: of a whole image, a page that is open would stand still.
    """
    height, width = reference.shape[:2]
    found = np.zeros((height, width))
    tiles = list(product(spans(height, _TILE), spans(width, _TILE)))
    for i, tile in enumerate(tiles):
        wide = tuple(slice(max(0, s.start - _REACH), s.stop + _REACH) for s in tile)
        inner = tuple(
            slice(s.start - w.start, s.stop - w.start) for s, w in zip(tile, wide, strict=True)
        )
        found[tile] = flip(image[wide], reference[wide], stops=stops)[inner]
        yield (i + 1) / len(tiles), found
