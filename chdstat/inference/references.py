"""References: images with which a render is compared, and what they do not say.

An image of another program has no samples. It is a mean, known to the precision of its file; its
noise is known if there is an image of variances, or a number of samples. What it never shows is how
rare its light is: a pixel whose samples are all null may have missed light that comes in one of
1000 samples. `unseen_variance` bounds how much the samples of a pixel may vary beyond what they
show, so that such a pixel is no evidence, whatever the unit of radiance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from chdstat._core.arrays import LUMINANCE, Array, Floats, Mask, whole
from chdstat._core.display import Shown
from chdstat._core.doors import read_image
from chdstat.errors import InputError

_PRECISION = 5.2 * 2.0**-11
"""Largest error of R, G or B over the largest of them, if X, Y and Z of a grey were rounded to half
floats before their conversion: 5.2 is what R adds up of their errors, 3.24 X + 1.54 Y + 0.50 Z."""
_SINGLE = 2.0**-22
"""Relative errors of samples in single precision, and of their sums."""
_SUBNORMAL = 2.0**-25
"""Largest error of half floats that are nearly 0."""
_NEAR = 11
"""Edge of the neighbourhood that shows how bright the samples of a pixel may be, in pixels."""
_TIMES = 16
"""Samples of a reference that are taken for granted, as a multiple of those of the render."""
_ALIKE = 1 / 8
"""If neighbours lack so much of what a pixel lacks, they have not seen that light, either."""
_RAREST = 1 / 300
"""Light that neighbours have not seen, either, may come in so few samples."""


@dataclass(frozen=True, repr=False)
class Reference(Shown):
    """An image to compare a render with, and how well it is known.

    Attributes
    ----------
    mean
        Linear radiance, shape (y, x, channel); NaN or infinite where nothing is known.
    variance
        Variance of one sample, same shape, not of the mean; NaN or None where it is unknown.
        Negative ones, of rounded squares, count as 0.
    spp
        Number of samples of each pixel; None if unknown. With a variance and no number, the mean is
        taken to be as noisy as the render that is compared with it. With a number and no variance,
        its samples are taken to vary as those of the render. With neither, it has no noise but one
        bright sample of at least 16 times as many as those of the render.
    precision
        Largest rounding error of a value over the largest channel of its pixel. The default,
        0.25 %, is that of half floats that were converted from CIE XYZ to R, G and B, as many
        images have been; 0 takes the image as it is.
    name
        What it is called.

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
        if not 0 <= self.precision < 1:
            message = f"precision must lie between 0 and 1, got {self.precision}"
            raise InputError(message)

    @classmethod
    def read(
        cls,
        mean: str | Path,
        *,
        variance: str | Path | None = None,
        spp: int | None = None,
        precision: float = _PRECISION,
    ) -> Reference:
        """Return a reference from EXR files: an image, and its variances if they are known.

        Parameters
        ----------
        mean, variance
            EXR files, read by `chdstat.io.read_exr`.
        spp, precision
            As the attributes.

        Raises
        ------
        InputError
            If the files differ in size or channels.
        StoreError
            If a file is missing or damaged.
        """
        variances = None if variance is None else read_image(variance)
        return cls(read_image(mean), variances, spp, precision, name=str(mean))

    @classmethod
    def of(cls, image: Any) -> Reference | None:
        """Return a reference of an image without samples; None if it is something else."""
        if isinstance(image, Reference):
            return image
        if isinstance(image, str | Path):
            return cls.read(image) if Path(image).suffix.lower() == ".exr" else None
        if np.ndim(image) == 3 and "sample" not in getattr(image, "dims", ()):
            return cls(image)
        return None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(y, x, channel)."""
        height, width, channels = self.mean.shape
        return height, width, channels

    @property
    def known(self) -> Literal["exact", "spp", "variance"]:
        """How its noise is known: not at all, so that it counts as exact, by spp, or a variance."""
        return "variance" if self.variance is not None else "spp" if self.spp else "exact"

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
        found = (self.precision + _SINGLE) * size + _SUBNORMAL * halves
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
        return largest / math.sqrt(spp * (self.spp or _TIMES * spp))


def with_luminance(x: Array) -> Array:
    """Return bands (y, x, band, ...): luminance before R, G and B; other channels as they are."""
    if x.shape[2] != 3:
        return x
    light = np.einsum("yxc...,c->yx...", x, LUMINANCE.astype(x.dtype), optimize=True)
    return np.concatenate([light[:, :, np.newaxis], x], axis=2)


def unseen_variance(
    mean: Floats, variance: Floats, shift: Floats, lowest: Floats, highest: Floats
) -> tuple[Floats, Mask]:
    """Return how much samples may vary of which hardly any shows light that their pixel has.

    Samples of size e that make its mean larger by `shift` come in a share shift / e of them, and
    add a variance of shift e. With that variance, n samples that are all alike are sqrt(n shift /
    e) standard errors from their mean, and miss the light with a probability of at least (1 - shift
    / e)^n.

    The samples of its neighbours show how a pixel may vary if they are about as bright as the
    reference is there, and do not lack such light, too. Otherwise the light is hidden: e may be the
    largest sample of the image, and for pixels whose samples are all equal at least 300 times the
    shift, so that 217 nulls are no evidence. Where the reference is darker, samples may be missing
    that are as dark as the darkest, or as 0.

    Parameters
    ----------
    mean, variance, lowest, highest
        Of the samples of each pixel, shape (y, x).
    shift
        Mean of the reference minus that of the samples.

    Returns
    -------
    variance
        Variance of a sample, shape (y, x).
    hidden
        Where light is hidden.
    """
    near, light = ndimage.maximum_filter(highest, _NEAR) - mean, _around(mean)
    unlike = (_around(shift) > _ALIKE * shift) | (light < (mean + shift) / 2) | (shift > near)
    hidden = (shift > 0) & unlike
    # Samples of neighbours around the mean of the pixel.
    spread = _around(variance + mean**2) - mean * (2 * light - mean)
    equal = variance <= (_SINGLE * mean) ** 2
    far = np.maximum(highest.max(initial=0) - mean, np.where(equal, shift / _RAREST, 0))
    event = np.where(hidden, far, np.where(shift > 0, near, mean - lowest.min(initial=0)))
    found = np.abs(shift) * np.maximum(event, 0)
    return np.where((shift > 0) & ~hidden, np.minimum(found, np.maximum(spread, 0)), found), hidden


def _around(x: Floats) -> Floats:
    """Return means of neighbourhoods, not by running sums: their rounding errors drown what is dim.

    Examples
    --------
    >>> float(_around(np.eye(11))[5, 5] * 11)
    1.0
    """
    weights = np.full(_NEAR, 1 / _NEAR)
    return np.asarray(ndimage.correlate1d(ndimage.correlate1d(x, weights, 0), weights, 1))
