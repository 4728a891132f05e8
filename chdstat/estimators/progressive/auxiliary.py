"""Auxiliary features of pixels: what camera rays hit first, and the pixels around, as numbers.

First hits describe the surface that a pixel shows. The neighbourhood lends it statistics: what its
rare samples may be worth, and what the light is like where it has seen none. Profiles around are
averaged with weights that fall with the distance and with how different the surfaces are. The pixel
itself is left out, so that its neighbourhood is independent of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError
from chdstat.estimators.progressive.profile import OCTAVES, Profile
from chdstat.estimators.similarity import pool

__all__ = [
    "BANDS",
    "NAMES",
    "RADII",
    "Features",
    "describe",
    "pool_around",
    "similarity_fields",
]

NAMES = ("albedo", "normal", "depth", "position")
_WAVES = 3
"""Octaves of sine and cosine of the position, so that light may vary faster than linearly."""
_DARK = 0.02
"""Albedo below which logarithms are cut."""

Array = npt.NDArray[np.float32]
Features = Mapping[str, npt.NDArray[Any]]


def describe(features: Features | None, shape: tuple[int, int]) -> Array:
    """Return numbers of about unit size for each pixel, shape (y, x, number).

    Albedo and its logarithm, the normal, the logarithm of the depth, and the position in units of
    its spread over the image with sine and cosine of it, as in Tancik et al. 2020, "Fourier
    features let networks learn high frequency functions in low dimensional domains".

    Parameters
    ----------
    features
        By the names of `NAMES`, shape (y, x) or (y, x, 3); those that are missing are left out.
    shape
        Height and width.

    Raises
    ------
    InputError
        If a feature has another shape.
    """
    parts = [np.zeros((*shape, 0))]
    known = _checked(features, shape)
    if "albedo" in known:
        parts += [known["albedo"], np.log(known["albedo"].clip(min=0) + _DARK)]
    if "normal" in known:
        parts.append(known["normal"])
    if "depth" in known:
        parts.append(_standard(np.log(known["depth"].clip(min=1e-6))))
    if "position" in known:
        position = _standard(known["position"])
        waves = [np.pi / 2 * 2**k * position for k in range(_WAVES)]
        parts += [position, *map(np.sin, waves), *map(np.cos, waves)]
    return np.concatenate(parts, axis=-1).astype(np.float32)


def similarity_fields(features: Features | None, shape: tuple[int, int]) -> dict[str, Array]:
    """Return the features that tell surfaces apart, finite, each of shape (y, x, number)."""
    return {name: field.astype(np.float32) for name, field in _checked(features, shape).items()}


def _checked(features: Features | None, shape: tuple[int, int]) -> dict[str, npt.NDArray[Any]]:
    found = {}
    for name in NAMES:
        if features is None or name not in features:
            continue
        field = np.asarray(features[name], np.float64)
        if field.shape[:2] != shape or field.ndim not in (2, 3):
            message = f"feature {name!r} must have shape {shape} or {shape} x 3, got {field.shape}"
            raise InputError(message)
        found[name] = np.nan_to_num(np.atleast_3d(field), posinf=0, neginf=0)
    return found


def _standard(field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Centre and scale; what lies far out, as the sky does, is drawn in."""
    flat = field.reshape(-1, field.shape[-1])
    low, high = np.quantile(flat, [0.01, 0.99], axis=0)
    inside = field.clip(low, high)
    return np.asarray((inside - inside.mean(axis=(0, 1))) / (inside.std(axis=(0, 1)) + 1e-6))


RADII = (1, 3, 8)
"""Of the windows, in pixels."""
BANDS = 8
"""Parts of a pooled profile: of three octaves each, for an average needs fewer."""
_ALBEDO, _COSINE, _PLANE = 0.05, 0.1, 0.02
"""Differences of albedo, 1 - cosine of the normals, and distance from the tangent plane over depth,
at which two surfaces count as unlike."""


def pool_around(
    profile: Profile, features: Mapping[str, npt.NDArray[Any]] | None
) -> tuple[Array, Array]:
    """Pool the profiles around each pixel.

    Parameters
    ----------
    profile
        Of an image, shape (y, x).
    features
        First-hit features; what is missing does not tell surfaces apart.

    Returns
    -------
    bands : ndarray
        Share of the samples in each band, then their radiance in each channel in units of the
        profile's; shape (y, x, radius, band, 1 + channel), 0 where nothing around is similar.
    weight : ndarray
        How many pixels' worth were pooled, shape (y, x, radius).
    """
    height, width = profile.count.shape
    fields = similarity_fields(features, (height, width))
    order = [name for name in ("albedo", "normal", "depth", "position") if name in fields]
    count = np.maximum(profile.count, 1)[..., np.newaxis, np.newaxis]
    bands = (
        (profile.bins / count.astype(np.float32))
        .reshape(height, width, BANDS, OCTAVES // BANDS, -1)
        .sum(axis=3)
    )
    known = (profile.count > 0).astype(np.float32)[..., np.newaxis]
    # Single precision is plenty, at twice the speed.
    values: Any = np.concatenate([bands.reshape(height, width, -1) * known, known], axis=-1)
    compared: Any = (*np.indices((height, width), np.float32), *(fields[name] for name in order))
    pooled, weights = [], []
    for radius in RADII:
        reach = 2 * (radius / 1.5) ** 2

        def weigh(here: tuple[Any, ...], there: tuple[Any, ...], reach: float = reach) -> Any:
            distance = (here[0] - there[0]) ** 2 + (here[1] - there[1]) ** 2
            pairs = zip(order, zip(here[2:], there[2:], strict=True), strict=True)
            return np.exp(-distance / reach - _dissimilarity(dict(pairs)))

        sums, _ = pool(weigh, compared, values, radius=radius)
        around = sums - values
        weight = np.maximum(around[..., -1:], 0)
        pooled.append(around[..., :-1] / np.maximum(weight, 1e-6))
        weights.append(weight[..., 0])
    stacked = np.stack(pooled, axis=2).reshape(height, width, len(RADII), BANDS, -1)
    return np.maximum(stacked, 0).astype(np.float32), np.stack(weights, axis=-1).astype(np.float32)


def _dissimilarity(pairs: Mapping[str, tuple[Any, Any]]) -> Any:
    """Return how unlike two surfaces are, 0 for the same, from features here and there."""
    total: Any = 0.0
    if "albedo" in pairs:
        here, there = pairs["albedo"]
        total = total + ((here - there) ** 2).sum(axis=-1) / _ALBEDO**2
    if "normal" in pairs:
        here, there = pairs["normal"]
        total = total + np.maximum(1 - (here * there).sum(axis=-1), 0) / _COSINE
        if {"position", "depth"} <= pairs.keys():
            across = ((pairs["position"][0] - pairs["position"][1]) * here).sum(axis=-1)
            total = total + (across / (_PLANE * pairs["depth"][0][..., 0] + 1e-6)) ** 2
    return total
