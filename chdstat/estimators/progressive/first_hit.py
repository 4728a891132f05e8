"""First hits: what a camera ray meets, as numbers that a network can work with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError

__all__ = ["NAMES", "Features", "describe", "likeness_fields"]

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
    its spread over the picture with sine and cosine of it, as in Tancik et al. 2020, "Fourier
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


def likeness_fields(features: Features | None, shape: tuple[int, int]) -> dict[str, Array]:
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
