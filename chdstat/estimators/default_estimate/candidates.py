"""Candidates: the images that are combined, from all samples and from each half of them.

Samples are read once, tile by tile; only their sums per pixel are kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Image, Reals, spans
from chdstat._core.denoiser import denoise, works
from chdstat._core.work import in_order
from chdstat.estimators.registry import interval_of_mean
from chdstat.estimators.shapes import RADIUS, PowerSums, ShapeStatistics
from chdstat.samples import Samples
from chdstat.samples.tiles import Work

if TYPE_CHECKING:
    from distributed import Client

_BAND = 2**19
"""Radiance values that are computed at once."""
_USUAL = 0.999
"""Share of an image's radiances, the darkest ones, from which its unit is computed."""
_ABSURD = 1e5
"""Multiple of the mean of these radiances from which a pixel is absurd."""
_NEAR = 2.0
"""Standard deviation, in pixels, of the window from which missing pixels are filled."""


@dataclass(frozen=True)
class Measured:
    """Statistics of the samples that a combination needs.

    All radiance is in units of `unit`.

    Attributes
    ----------
    starts
        The mean and `shared_shape` by name: from all samples, from the even and from the odd ones.
        Pixels without a good sample and absurd pixels are filled from the pixels around them.
    errors
        Standard errors of these three means, filled alike.
    mean
        Mean of each channel's good samples, shape (y, x, channel), 0 where there is none.
    unit
        A power of two, near the typical radiance of the image.
    absurd
        Whether a pixel is so much brighter than all others that it must not affect them, shape (y,
        x).
    null
        Share of null samples, shape (y, x).
    count
        Number of good samples of each channel, shape (y, x, channel).
    signed
        Whether any good sample is negative.
    """

    starts: Sequence[Mapping[str, Image]]
    errors: Sequence[Reals]
    mean: Reals
    unit: float
    absurd: npt.NDArray[np.bool_]
    null: Reals
    count: Reals
    signed: bool

    def interval(self, level: float) -> Reals:
        """Return the lower and upper end of intervals of the mean, shape (2, y, x, channel)."""
        return interval_of_mean(self.mean, self.errors[0], self.count, level, signed=self.signed)

    @classmethod
    def of(cls, image: Samples, **work: Unpack[Work]) -> Measured:
        """Measure an image in memory that does not grow with the number of samples."""

        def of_tile(x: Image) -> dict[str, tuple[tuple[str, ...], Reals]]:
            return {
                f"{name} {i}": (("channel",)[: sums.ndim - 2], sums)
                for i, half in enumerate((x[..., ::2], x[..., 1::2]))
                for name, sums in vars(PowerSums.of(half)).items()
            }

        maps = image.map(of_tile, dependent=True, description="estimating", **work)
        names = [field.name for field in fields(PowerSums)]
        halves = (PowerSums(*(maps[f"{name} {i}"].values for name in names)) for i in (0, 1))
        return cls.of_halves(*halves)

    @classmethod
    def of_halves(cls, one: PowerSums, other: PowerSums) -> Measured:
        """Measure an image from the sums of its even and of its odd samples."""
        height, width, channels = one.total.shape
        starts = [
            {name: np.empty(one.total.shape) for name in ("mean", "shared_shape")} for _ in range(3)
        ]
        errors = [np.empty(one.total.shape) for _ in range(3)]
        count, null = np.empty(one.total.shape), np.empty((height, width))
        # Bands of rows keep temporary arrays small.
        for rows in spans(height, max(1, _BAND // (width * channels))):
            around = slice(max(0, rows.start - RADIUS), rows.stop + RADIUS)
            inside = slice(rows.start - around.start, rows.stop - around.start)
            halves = one.part(around), other.part(around)
            whole = halves[0].merged(halves[1])
            for part, start, error in zip((whole, *halves), starts, errors, strict=True):
                mean, limited = part.mean(), ShapeStatistics.of(part).limited()
                start["mean"][rows] = mean[inside]
                start["shared_shape"][rows] = np.where(np.isfinite(limited), limited, mean)[inside]
                error[rows] = part.error()[inside]
            count[rows] = whole.good[inside]
            null[rows] = (whole.null / np.maximum(whole.good.max(axis=-1), 1))[inside]
        mean = np.nan_to_num(starts[0]["mean"], posinf=0, neginf=0)
        unit, absurd = _unit_and_absurd(np.abs(starts[0]["shared_shape"]), np.abs(mean))
        for start, error in zip(starts, errors, strict=True):
            missing = absurd[..., np.newaxis] | ~np.isfinite(start["mean"])
            for image in (*start.values(), error):
                image[...] = _filled(image / unit, missing)
        return cls(
            [{k: v.astype(np.float32) for k, v in start.items()} for start in starts],
            [error.astype(np.float32) for error in errors],
            mean / unit,
            unit,
            absurd,
            null,
            count,
            bool((one.below < 0).any() or (other.below < 0).any()),
        )


def _unit_and_absurd(limited: Reals, mean: Reals) -> tuple[float, npt.NDArray[np.bool_]]:
    """Return the unit of an image, and which pixels are absurd."""
    known = limited[np.isfinite(limited)].astype(np.float64)
    usual = known[known <= np.quantile(known, _USUAL)] if known.size else known
    typical = float(usual.mean()) if usual.size else 0.0
    unit = float(np.exp2(np.round(np.log2(typical)))) if typical > 0 else 1.0
    most = _ABSURD * typical if typical > 0 else np.inf
    return unit, np.asarray((mean > most).any(axis=-1))


def _filled(image: Reals, missing: npt.NDArray[np.bool_]) -> Reals:
    """Fill missing values of an image (y, x, channel) with the average of those around them."""
    if not missing.any():
        return image
    total, known = (
        ndimage.gaussian_filter(np.where(missing, 0, values), (_NEAR, _NEAR, 0), mode="nearest")
        for values in (image, np.ones(image.shape))
    )
    return np.where(missing, total / np.maximum(known, 1e-30), image)


def candidates(
    starts: Mapping[str, Image],
    features: Mapping[str, npt.NDArray[Any]],
    client: Client | None = None,
) -> dict[str, Image]:
    """Return the candidate images by name, each (y, x, channel); the first is the base.

    With a client, its workers denoise. If the library of the denoiser cannot be loaded, nothing is
    denoised.
    """
    guides = {name: features[name] for name in ("albedo", "normal") if name in features}
    kinds = {"denoised with features": guides} if "albedo" in guides else {}
    kinds = {**kinds, "denoised": {}} if works() else {}
    jobs = {
        kind if name == "mean" else f"{kind} {name}": (image, own)
        for name, image in starts.items()
        for kind, own in kinds.items()
    }
    # One image at a time: the denoiser uses all cores by itself.
    denoised = in_order(_denoised, jobs.values(), workers=1, client=client)
    found = {**dict(zip(jobs, denoised, strict=True)), **starts}
    return {name: image.astype(np.float32) for name, image in found.items()}


def _denoised(job: tuple[Reals, Mapping[str, npt.NDArray[Any]]]) -> Reals:
    """Denoise an image; the negative radiance of signed samples is denoised by itself.

    A black image stays black, as the denoiser would put light in it.
    """
    image, features = job
    found = np.zeros_like(image)
    for sign in (1, -1):
        if (sign * image > 0).any():
            found = found + sign * through_denoiser(sign * image, features)
    return found


def through_denoiser(
    radiance: npt.NDArray[Any], features: Mapping[str, npt.NDArray[Any]]
) -> npt.NDArray[Any]:
    """Denoise estimates, with albedo and normal if `features` contain an albedo.

    The denoiser takes no negative radiance: negative estimates, as of signed samples, count as 0.
    """
    albedo = features.get("albedo")
    normal = None if albedo is None else features.get("normal")
    return denoise(np.where(radiance < 0, 0, radiance), albedo=albedo, normal=normal)
