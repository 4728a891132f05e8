"""Matrices (4, 4) for scene dicts, which act on columns: of ``a @ b``, b acts first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def translate(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def scale(x: float, y: float, z: float) -> np.ndarray:
    return np.diag([x, y, z, 1.0])


def look_at(
    origin: Sequence[float], target: Sequence[float], *, up: Sequence[float] = (0.0, 0.0, 1.0)
) -> np.ndarray:
    """Place a camera, whose own view is along +z."""
    forward = np.subtract(target, origin)
    left = np.cross(up, forward)
    axes = left, np.cross(forward, left), forward
    matrix = np.eye(4)
    matrix[:3, :3] = np.transpose([axis / np.linalg.norm(axis) for axis in axes])
    matrix[:3, 3] = origin
    return matrix.round(9)
