"""Halves: candidates of half the samples, compared with the mean of the other half.

Samples are read once, tile by tile; what is kept of them are images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Image, Reals
from chdstat._core.work import in_order
from chdstat.estimators.shapes import PowerSums, ShapeStatistics
from chdstat.io.denoiser import denoise, works
from chdstat.samples import Samples
from chdstat.samples.tiles import Work

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["Measured", "candidates", "compare_halves"]


_SCALES = (1.5, 4.0, 12.0)
"""Standard deviations in pixels of the windows that comparisons are averaged over."""
_USUAL = 0.999
"""Share of an image's radiances, the darkest, that its unit is made of."""
_ABSURD = 1e5
"""Multiple of their mean from which a pixel is absurd."""
_NEAR = 5
"""Edge in pixels of what is around an absurd pixel."""
_FAINT = 0.01
"""Share of the image's mean radiance that is added to a pixel's own, as unit of its errors."""


@dataclass(frozen=True)
class Measured:
    """Images of what a combination has to know of the samples, which are read once, by tiles.

    All radiance is in `unit`.

    Attributes
    ----------
    starts
        The mean and `shared_shape` of all samples, and of every other of them, by name; NaN where
        no sample is good, and what is around where `absurd`.
    errors
        Standard errors of the mean of all samples, and of every other of them.
    mean
        Of each channel's good samples, shape (y, x, channel), 0 where there is none.
    unit
        A power of two, near the typical radiance of the image.
    absurd
        Marks pixels that are brighter than all others by so much that no other may know of them,
        shape (y, x).
    null
        Share of null samples, shape (y, x).
    count
        Good samples of each channel, shape (y, x, channel).
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

    @classmethod
    def of(cls, image: Samples, **work: Unpack[Work]) -> Measured:
        """Measure an image in memory that does not grow with the number of samples."""
        names = [field.name for field in fields(PowerSums)]

        def of_tile(x: Image) -> dict[str, tuple[tuple[str, ...], Reals]]:
            found: dict[str, tuple[tuple[str, ...], Reals]] = {}
            for i, half in enumerate((x[..., ::2], x[..., 1::2])):
                sums = vars(PowerSums.of(half))
                sums["roots"] = np.moveaxis(sums["roots"], 0, -1)
                for name, value in sums.items():
                    dims = ("channel", "power")[: value.ndim - 2]
                    found[f"{name} {i}"] = dims, value
            return found

        maps = image.map(of_tile, dependent=True, description="estimating", **work)

        def half(i: int) -> PowerSums:
            values = {name: maps[f"{name} {i}"].values for name in names}
            return PowerSums(**values | {"roots": np.moveaxis(values["roots"], -1, 0)})

        return cls.of_halves(half(0), half(1))

    @classmethod
    def of_halves(cls, one: PowerSums, other: PowerSums) -> Measured:
        """Measure an image of which every other sample was added to the one sums, the others."""
        parts = (one.merged(other), one, other)
        starts: list[dict[str, Reals]] = []
        for part in parts:
            shape = ShapeStatistics.of(part)
            starts.append({"mean": part.mean(), "shared_shape": shape.or_mean(shape.limited())})
        whole = parts[0]
        mean = np.nan_to_num(starts[0]["mean"], posinf=0, neginf=0)
        unit, absurd = _unit_and_absurd(np.abs(starts[0]["shared_shape"]), np.abs(mean))
        return cls(
            [{k: _tamed(v / unit, absurd) for k, v in start.items()} for start in starts],
            [_tamed(part.error() / unit, absurd) for part in parts],
            mean / unit,
            unit,
            absurd,
            whole.null / np.maximum(whole.good.max(axis=-1), 1),
            whole.good,
            bool((whole.below < 0).any()),
        )


def _unit_and_absurd(limited: Reals, mean: Reals) -> tuple[float, npt.NDArray[np.bool_]]:
    """Return the unit of an image, and the pixels that no other may know of."""
    known = limited[np.isfinite(limited)].astype(np.float64)
    usual = known[known <= np.quantile(known, _USUAL)] if known.size else known
    typical = float(usual.mean()) if usual.size else 0.0
    unit = float(np.exp2(np.round(np.log2(typical)))) if typical > 0 else 1.0
    most = _ABSURD * typical if typical > 0 else np.inf
    return unit, np.asarray((mean > most).any(axis=-1))


def _tamed(image: Reals, absurd: npt.NDArray[np.bool_]) -> Image:
    """Return an image with the median of what is around in place of absurd pixels."""
    if absurd.any():
        around = ndimage.median_filter(np.nan_to_num(image), size=(_NEAR, _NEAR, 1))
        image = np.where(absurd[..., np.newaxis], around, image)
    return image.astype(np.float32)


def candidates(
    starts: Mapping[str, Image],
    features: Mapping[str, npt.NDArray[Any]],
    client: Client | None = None,
) -> dict[str, Image]:
    """Return the images that are weighted, by name, each (y, x, channel); the first is the base.

    Where no sample of a pixel is good, they are 0. With a client, its workers denoise; where the
    library of the denoiser cannot be loaded, nothing is denoised.
    """
    starts = {name: np.nan_to_num(image, posinf=0, neginf=0) for name, image in starts.items()}
    albedo = features.get("albedo")
    normal = None if albedo is None else features.get("normal")
    kinds: dict[str, Any] = {} if albedo is None else {"denoised with features": (albedo, normal)}
    kinds = {**kinds, "denoised": (None, None)} if works() else {}
    jobs = {
        kind if name == "mean" else f"{kind} {name}": (np.maximum(image, 0), *guides)
        for name, image in starts.items()
        for kind, guides in kinds.items()
    }
    # One at a time here: the denoiser uses all cores by itself.
    denoised = in_order(_denoised, jobs.values(), workers=1, client=client)
    found = dict(zip(jobs, denoised, strict=True)) | starts
    return {name: image.astype(np.float32) for name, image in found.items()}


def _denoised(job: tuple[Reals, Any, Any]) -> Reals:
    """Return an image denoised; a black one, in which the denoiser sees light, as it is."""
    image, albedo, normal = job
    return denoise(image, albedo=albedo, normal=normal) if image.any() else image


def compare_halves(
    measured: Measured, features: Mapping[str, npt.NDArray[Any]], client: Client | None = None
) -> tuple[list[str], Image, Image, Image, Image]:
    """Return candidates, and how those of half the samples compare with the other half.

    Returns
    -------
    names : list of str
    full, halves : ndarray
        The candidates from all samples, shape (candidate, y, x, channel), and from each half of
        them, (half, candidate, y, x, channel).
    inputs : ndarray
        What the network sees, shape (y, x, number).
    unit : ndarray
        Radiance that errors are measured in, shape (y, x).
    """
    made = [_stacked(candidates(start, features, client)) for start in measured.starts]
    names, full = made[0]
    parts = np.stack([images for _, images in made[1:]])
    targets = np.stack([np.nan_to_num(part["mean"]) for part in measured.starts[:0:-1]])
    inputs, unit = _inputs(
        full,
        parts,
        targets.astype(np.float32),
        np.square(measured.errors[0]),
        measured.null,
        np.nan_to_num(measured.starts[0]["mean"]),
    )
    return names, full, parts, inputs, unit


def _stacked(images: Mapping[str, Image]) -> tuple[list[str], Image]:
    return list(images), np.stack(list(images.values()))


def _inputs(
    full: Image, parts: Image, targets: Image, variance: Reals, null: Reals, mean: Reals
) -> tuple[Image, Image]:
    """Return what the network sees: logarithms, ratios and standard scores, without a unit.

    Of each candidate against the first: which mixture of the two the other half of the samples asks
    for (the slope of a regression without constant) and its standard error, in three windows; how
    far they are apart, and on which side. Of each candidate: how far those of the two halves are
    apart, and how many standard errors of the mean it is from the mean.
    """
    overall = float(np.abs(full[0]).mean(dtype=np.float64)) or 1.0
    unit = _smooth(np.abs(full).mean(axis=(0, 3)), _SCALES[0]) + _FAINT * overall
    error = np.sqrt(variance.mean(axis=-1))
    noise = [_smooth(variance.mean(axis=-1), s) for s in _SCALES[:2]]
    count = 5 + (2 * len(_SCALES) + 3) * (len(full) - 1) + 3 * len(full)
    found = np.empty((*unit.shape, count), np.float32)
    place = iter(range(count))

    def write(*images: Reals) -> None:
        for image in images:
            found[..., next(place)] = image

    write(
        _log(error / unit, 1e-4),
        _log(np.sqrt(noise[0]) / unit, 1e-4),
        _log(np.sqrt(noise[1]) / _smooth(unit, _SCALES[1]), 1e-4),
        _smooth(null, _SCALES[0]),
        np.log(unit / overall),
    )
    scale = unit[..., np.newaxis]
    target_variance = 2 * variance / scale**2
    parts = parts / scale
    targets = targets / scale
    for j in range(1, len(full)):
        apart = parts[:, j] - parts[:, 0]
        towards = (apart * (targets - parts[:, 0])).mean(axis=(0, 3))
        squared = np.square(apart).mean(axis=(0, 3))
        of_noise = (np.square(apart) * target_variance).mean(axis=(0, 3)) / 2
        for s in _SCALES:
            whole = _smooth(squared, s) + 1e-8
            slope = _smooth(towards, s) / whole
            spread = np.sqrt(_smooth(of_noise, s) / (4 * np.pi * s * s)) / whole
            write(np.clip(slope, -1, 2), np.clip(_log(spread, 1e-3), -7, 3))
        write(_log(np.sqrt(_smooth(squared, _SCALES[0])), 1e-4))
        moved = (full[j] - full[0]) / scale
        size = _smooth(np.square(moved).mean(axis=-1), _SCALES[0])
        write(np.arcsinh(3 * moved.mean(axis=-1)), _log(np.sqrt(size), 1e-4))
    for j in range(len(full)):
        between = _smooth(np.var(parts[:, j], axis=0).mean(axis=-1), _SCALES[0])
        score = (full[j] - mean).mean(axis=-1) / (error + 1e-3 * unit)
        around = _smooth(np.minimum(np.square(score), 1e6), _SCALES[0])
        write(_log(np.sqrt(between), 1e-4), np.arcsinh(score), _log(np.sqrt(around), 1e-2))
    return found, unit.astype(np.float32)


def _smooth(image: Reals, scale: float) -> Reals:
    smooth = ndimage.gaussian_filter(image.astype(np.float32), scale, mode="nearest", truncate=3)
    return np.asarray(np.maximum(smooth, 0) if (image >= 0).all() else smooth)


def _log(x: Reals, least: float) -> Reals:
    return np.asarray(np.log(x + least))
