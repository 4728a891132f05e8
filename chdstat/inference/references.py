"""References: images to contrast renders with, and how well they are known.

Such an image is a mean, known to the precision of its file. Its noise is known if it comes with an
image of variances, or with a number of samples. What neither shows is how rare its light is. Means
of batches of its samples do, and a render is contrasted with them as with samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from chdstat._core.arrays import Array, Floats, all_good, is_bad, spans, whole
from chdstat._core.display import Shown, percent
from chdstat._core.doors import read_reference
from chdstat.errors import InputError
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import BATCH

_PRECISION = 5.2 * 2.0**-11
"""Largest error of R, G or B over the largest of them, if X, Y and Z of a grey were rounded to half
floats before their conversion: 5.2 is what R adds up of their errors, 3.24 X + 1.54 Y + 0.50 Z."""
_COMPUTED = 1e-5
"""Largest relative error that another compiler or processor may make in a pixel without noise."""
SINGLE = 2.0**-22
"""Relative errors of samples in single precision, and of their sums."""
_SUBNORMAL = 2.0**-25
"""Largest error of half floats that are nearly 0."""
IMAGES = (".exr", ".pfm")
"""Suffixes of files of references."""
BATCHES = 48
"""Batches of a reference."""
OF_TEST = 3
"""A reference has so many times the samples of a test, which thus makes 16 such batches."""
_FEWEST_BATCHES = 8
_MADE = 64
"""Terms that stand for a mean and a variance."""
_GRANTED = 16
"""Samples of a reference that are taken for granted, as a multiple of those of the render."""


@dataclass(frozen=True, repr=False)
class Reference(Shown):
    """An image to contrast a render with, and how well it is known.

    Attributes
    ----------
    mean
        Linear radiance, shape (y, x, channel); NaN or infinite where nothing is known.
    variance
        Variance of one sample, same shape, not of the mean; NaN or None where it is unknown.
        Negative ones, of rounded squares, count as 0. By default, that of the batches.
    spp
        Number of samples of each pixel; None if unknown. With a variance and no number, the mean is
        taken to be as noisy as the render contrasted with it. With a number and no variance,
        its samples are taken to vary as those of the render. With neither, it has no noise but one
        bright sample of at least 16 times as many as those of the render.
    precision
        Largest rounding error of a value over the largest channel of its pixel. The default,
        0.25 %, is that of half floats that were converted from CIE XYZ to R, G and B, as many
        images have been; 0 takes the image as it is.
    name
        What it is called.
    batches
        Means of as many batches of its samples, each of spp / batches, shape (y, x, channel,
        batch); None if they are unknown. NaN where a batch has no good sample.
    bad
        Share of bad samples, which are left out of all means, shape (y, x); None if it is unknown.
    attrs
        Provenance: scene, scene hash, seed, versions and so on.
    limits
        Sentences on what its file does not hold, beside what `cannot_show` says of any reference.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(8, 8, 3, 4096))
    >>> reference = Reference(x.mean(axis=-1), x.var(axis=-1, ddof=1), spp=4096)
    >>> reference.shape, reference.known
    ((8, 8, 3), 'variance')
    """

    mean: Array
    variance: Array | None = None
    spp: int | None = None
    precision: float = _PRECISION
    name: str = field(default="image", kw_only=True)
    batches: Array | None = field(default=None, kw_only=True)
    bad: Array | None = field(default=None, kw_only=True)
    attrs: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    limits: tuple[str, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises
        ------
        InputError
            If the mean is not (y, x, channel), the variance has another shape, or a number is out
            of range.
        """
        mean = np.asarray(self.mean, np.float64)
        if mean.ndim != 3 or 0 in mean.shape:
            message = f"the mean of a reference must have shape (y, x, channel), got {mean.shape}"
            raise InputError(message)
        object.__setattr__(self, "mean", mean)
        if self.variance is not None:
            variance = np.asarray(self.variance, np.float64)
            if variance.shape != mean.shape:
                message = (
                    f"the variance of a reference must have the shape of its mean, {mean.shape}, "
                    f"got {variance.shape}"
                )
                raise InputError(message)
            object.__setattr__(self, "variance", np.maximum(variance, 0))
        if self.spp is not None:
            object.__setattr__(self, "spp", whole("spp", self.spp, least=1))
        if self.bad is not None and np.shape(self.bad) != mean.shape[:2]:
            message = (
                f"the share of bad samples of a reference must have shape {mean.shape[:2]}, got "
                f"{np.shape(self.bad)}"
            )
            raise InputError(message)
        if not 0 <= self.precision < 1:
            message = f"precision must lie between 0 and 1, got {self.precision}"
            raise InputError(message)
        if self.batches is not None:
            object.__setattr__(self, "batches", self._checked_batches(self.batches))
            if self.variance is None:
                object.__setattr__(self, "variance", self._variance_of_batches())

    def _checked_batches(self, given: Array) -> Array:
        batches, shape = np.asarray(given), self.mean.shape
        if batches.shape[:-1] != shape or batches.shape[-1] < _FEWEST_BATCHES:
            message = (
                f"the batches of a reference must have shape {shape} and at least "
                f"{_FEWEST_BATCHES} batches, got {batches.shape}"
            )
            raise InputError(message)
        if self.spp is None or self.spp % batches.shape[-1]:
            message = (
                f"a reference of {batches.shape[-1]} batches of equal size needs spp, a multiple "
                f"of their number, got {self.spp}"
            )
            raise InputError(message)
        return batches

    @np.errstate(invalid="ignore", divide="ignore")
    def _variance_of_batches(self) -> Floats:
        """Return the variance of a sample, from that of the batches; NaN if fewer than 2 are known.

        Their own mean counts here.
        """
        assert self.batches is not None
        assert self.spp is not None
        known = np.isfinite(self.batches)
        squares = (self.batches - mean_of_batches(self.batches)[..., np.newaxis]) ** 2
        freedom = known.sum(axis=-1) - 1.0
        found = squares.sum(axis=-1, where=known) / freedom * (self.spp / known.shape[-1])
        return np.where(freedom > 0, found, np.nan)

    @classmethod
    def of_samples(cls, samples: Any, *, batches: int = BATCHES, name: str = "") -> Reference:
        """Return what a test needs of samples: means of batches, a hundredth of the size.

        Parameters
        ----------
        samples
            `Samples`, the path of a store, or an array (y, x, channel, sample).
        batches
            Number of batches, of consecutive samples. Samples that fill no batch are left out.
        name
            What the reference is called; by default, as the scene.

        Raises
        ------
        InputError
            If there are fewer samples than batches.

        Examples
        --------
        >>> x = np.random.default_rng(1).gamma(2.0, size=(8, 8, 3, 480))
        >>> reference = Reference.of_samples(x)
        >>> reference.batches.shape, reference.spp
        ((8, 8, 3, 48), 480)
        """
        found = samples_of(samples, averages=True)
        whole("batches", batches, least=_FEWEST_BATCHES)
        size = found.spp // batches
        if not size:
            message = f"a reference of {batches} batches needs as many samples, got {found.spp}"
            raise InputError(message)
        means, bad = _means_of_batches(found, batches, size)
        averaged = int(found.attrs.get("averaged", 1))
        return cls(
            mean_of_batches(means),
            spp=batches * size * averaged,
            precision=_COMPUTED,
            name=name or found.name,
            batches=means,
            bad=bad,
            attrs=found.attrs,
        )

    @classmethod
    def read(
        cls,
        mean: str | Path,
        *,
        variance: str | Path | None = None,
        spp: int | None = None,
        precision: float | None = None,
    ) -> Reference:
        """Return the reference in a file, whatever it holds.

        That is what `chdstat.io.write_reference` wrote, or images of other programs, with their
        variances in the same file or in one beside it. `cannot_show` says what they lack.

        Parameters
        ----------
        mean
            EXR or PFM file of the image; or a folder of such files, each of a pass.
        variance
            File of variances of a sample; by default, as ``NAME_var.exr`` beside ``NAME.exr``.
        spp, precision
            As the attributes; by default, as the files say.

        Raises
        ------
        InputError
            If the files differ in size or channels, or have what is given here already.
        StoreError
            If a file is missing or damaged.
        """
        found: Reference = read_reference(mean, variance=variance, spp=spp, precision=precision)
        return found

    @classmethod
    def of(cls, image: Any) -> Reference | None:
        """Return a reference of an image without samples; None if it is something else."""
        if isinstance(image, Reference):
            return image
        if isinstance(image, str | Path):
            known = Path(image).suffix.lower() in IMAGES
            return cls.read(image) if known else None
        if np.ndim(image) == 3 and "sample" not in getattr(image, "dims", ()):
            return cls(image)
        return None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(y, x, channel)."""
        height, width, channels = self.mean.shape
        return height, width, channels

    @property
    def known(self) -> Literal["exact", "spp", "variance", "batches"]:
        """How its noise is known: not at all (as exact), by spp, a variance, or batches."""
        if self.batches is not None:
            return "batches"
        return "variance" if self.variance is not None else "spp" if self.spp else "exact"

    @property
    def cannot_show(self) -> tuple[str, ...]:
        """What no test with this reference can tell, a sentence for each.

        Examples
        --------
        >>> for sentence in Reference(np.ones((4, 4, 3)), spp=4096, precision=0).cannot_show:
        ...     print(sentence)
        Without variances, its samples are taken to vary as those of the render.
        Without batches, it does not show how rare its light is.
        """
        noise = {
            "exact": "Without a variance or a number of samples, it is taken to have no noise but "
            "that of one bright sample.",
            "spp": "Without variances, its samples are taken to vary as those of the render.",
            "variance": "Without a number of samples, it is taken to be as noisy as the render."
            if self.spp is None
            else "",
            "batches": "",
        }
        found = [
            noise[self.known],
            "Without batches, it does not show how rare its light is."
            if self.batches is None
            else "",
            f"It is known to {percent(self.precision)} of a pixel's brightest channel: smaller "
            "differences of single pixels are not told from rounding."
            if self.precision > _COMPUTED
            else "",
        ]
        return (*filter(None, found), *self.limits)

    def to_samples(self, variance: Array | None = None) -> Samples:
        """Return samples of averages with this mean and noise: its batches, or made ones.

        Those are the mean plus and minus one standard deviation, as many of one as of the other,
        with the same signs in all channels.

        Parameters
        ----------
        variance
            Variance of a sample, if the reference has none.

        Raises
        ------
        InputError
            If its noise is unknown.

        Examples
        --------
        >>> image = np.ones((4, 4, 3))
        >>> samples = Reference(image, variance=image, spp=6400).to_samples()
        >>> round(float(samples.read().var(axis=-1)[0, 0, 0]), 6)
        0.01
        """
        batches = self.batches
        if batches is None:
            variance = self.variance if self.variance is not None else variance
            if variance is None or self.spp is None or self.spp < _FEWEST_BATCHES:
                message = (
                    f"{self.name} has no samples, and its noise is unknown: give its variance and "
                    f"spp, {_FEWEST_BATCHES} or more, as a Reference"
                )
                raise InputError(message)
            count = min(self.spp, _MADE)
            signs = np.ones((*self.shape[:2], 1, count))
            signs[..., 1::2] = -1
            signs = np.random.default_rng(0).permuted(signs, axis=-1)
            root = np.sqrt(variance * count / self.spp)[..., np.newaxis]
            batches = self.mean[..., np.newaxis] + root * (signs - signs.mean(axis=-1)[..., None])
        about = {name: self.attrs.get(name) for name in ("scene", "scene_hash")}
        averaged = (self.spp or 0) // batches.shape[-1]
        return Samples.from_array(batches, averaged=averaged, **about)

    @cached_property
    def rounding(self) -> Floats:
        """How far rounding may have moved each mean, shape (y, x, band).

        Luminance comes first if there are R, G and B. Images of half floats have absolute errors
        near 0, too.
        """
        mean = np.where(np.isfinite(self.mean), self.mean, 0)
        size = np.abs(mean).max(axis=-1, keepdims=True)
        with np.errstate(over="ignore"):
            halves = bool(self.precision) and np.array_equal(mean, mean.astype(np.float16))
        found = (self.precision + SINGLE) * size + _SUBNORMAL * halves
        bands = mean.shape[-1] + (mean.shape[-1] == 3)
        return np.asarray(np.broadcast_to(found, (*mean.shape[:2], bands)))

    def outlier(self, excess: Floats, spp: int) -> float:
        """Return by how much its brightest sample may have raised the mean of one pixel.

        If its variances are known, they know that. Otherwise, M samples per pixel have a brightest
        one that is about sqrt(M / spp) times that of `spp`, if variances are just finite. A
        reference without a number is taken to have 16 times as many samples.

        Parameters
        ----------
        excess
            Largest sample of each pixel minus its mean, of a render with so many `spp`.
        """
        if self.variance is not None:
            return 0.0
        largest = float(np.max(excess, initial=0, where=np.isfinite(excess)))
        return largest / math.sqrt(spp * (self.spp or _GRANTED * spp))


@np.errstate(invalid="ignore")
def mean_of_batches(batches: Array) -> Floats:
    """Return the mean of the known batches, (y, x, channel, batch); NaN where there are none."""
    known = np.isfinite(batches)
    return np.asarray(
        batches.sum(axis=-1, where=known, dtype=float) / known.sum(axis=-1, dtype=float)
    )


def sums_of_good(x: Array) -> tuple[Floats, Array | int]:
    """Return sums of the good samples, (y, x, channel), and their number in each pixel, (y, x).

    Examples
    --------
    >>> sums, number = sums_of_good(np.array([[[[1.0, 2.0, np.nan]]]]))
    >>> sums.item(), number.item()
    (3.0, 2)
    """
    if all_good(x):
        return x.sum(axis=-1, dtype=float), x.shape[-1]
    good = np.asarray(~is_bad(x).any(axis=2))
    sums = np.where(good[:, :, np.newaxis], x, 0).sum(axis=-1, dtype=float)
    return sums, good.sum(axis=-1)


def _means_of_batches(samples: Samples, batches: int, size: int) -> tuple[Floats, Floats]:
    """Return means of batches of consecutive samples, and the share of bad ones, (y, x)."""
    total = np.zeros((*samples.shape[:3], batches))
    number = np.zeros((*samples.shape[:2], batches), np.int64)
    for ss in spans(batches * size, BATCH):
        x = samples.read(ss=ss)
        for k in range(ss.start // size, (ss.stop - 1) // size + 1):
            own = slice(max(k * size - ss.start, 0), (k + 1) * size - ss.start)
            sums, good = sums_of_good(x[..., own])
            total[..., k] += sums
            number[..., k] += good
    there = np.minimum(samples.counts, batches * size)
    with np.errstate(invalid="ignore"):
        return total / number[:, :, np.newaxis], 1 - number.sum(axis=-1) / there
