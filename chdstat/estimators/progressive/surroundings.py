"""Surroundings: profiles of the pixels around, weighed by how like the surface is.

They lend a pixel statistics: what its rare samples may be worth, and what the light is like where
it has seen none. The pixel itself is left out, so that its surroundings are independent of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.estimators._windows import pool
from chdstat.estimators.progressive.first_hit import likeness_fields
from chdstat.estimators.progressive.profiles import OCTAVES, Profile

__all__ = ["BANDS", "RADII", "surround"]

RADII = (1, 3, 8)
"""Of the windows, in pixels."""
BANDS = 8
"""Parts of a pooled profile: of three octaves each, for an average needs fewer."""
_ALBEDO, _COSINE, _PLANE = 0.05, 0.1, 0.02
"""Differences of albedo, 1 - cosine of the normals, and distance from the tangent plane over depth,
at which two surfaces count as unlike."""

Array = npt.NDArray[np.float32]


def surround(
    profile: Profile, features: Mapping[str, npt.NDArray[Any]] | None
) -> tuple[Array, Array]:
    """Pool the profiles around each pixel.

    Parameters
    ----------
    profile
        Of a picture, shape (y, x).
    features
        First-hit features; what is missing does not tell surfaces apart.

    Returns
    -------
    bands : ndarray
        Share of the samples in each band, then their radiance in each channel in units of the
        profile's; shape (y, x, radius, band, 1 + channel), 0 where nothing around is alike.
    weight : ndarray
        How many pixels' worth were pooled, shape (y, x, radius).
    """
    height, width = profile.count.shape
    fields = likeness_fields(features, (height, width))
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
            return np.exp(-distance / reach - _unlike(dict(pairs)))

        sums, _ = pool(weigh, compared, values, radius=radius)
        around = sums - values
        weight = np.maximum(around[..., -1:], 0)
        pooled.append(around[..., :-1] / np.maximum(weight, 1e-6))
        weights.append(weight[..., 0])
    stacked = np.stack(pooled, axis=2).reshape(height, width, len(RADII), BANDS, -1)
    return np.maximum(stacked, 0).astype(np.float32), np.stack(weights, axis=-1).astype(np.float32)


def _unlike(pairs: Mapping[str, tuple[Any, Any]]) -> Any:
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
