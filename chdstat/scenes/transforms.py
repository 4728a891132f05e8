"""Transforms for the built-in scenes: (4, 4) matrices that act on columns, in NumPy alone.

Chain them with ``@``: the rightmost acts first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError

__all__ = ["Axis", "Vector", "look_at", "rotate", "scale", "translate"]

Array = npt.NDArray[np.float64]
Vector = Sequence[float] | Array
Axis = Literal["x", "y", "z"]

_AXES: dict[str, int] = {"x": 0, "y": 1, "z": 2}


def translate(x: float, y: float, z: float) -> Array:
    """Return the matrix that moves by (x, y, z)."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def scale(x: float, y: float, z: float) -> Array:
    """Return the matrix that stretches by (x, y, z)."""
    return np.diag([x, y, z, 1.0])


def rotate(axis: Axis, degrees: float) -> Array:
    """Return the matrix that turns counterclockwise about a coordinate axis.

    Examples
    --------
    >>> (rotate("z", 90.0) @ [1.0, 0.0, 0.0, 1.0]).round(6)
    array([0., 1., 0., 1.])
    """
    first, second = ((_AXES[axis] + k) % 3 for k in (1, 2))
    angle = np.deg2rad(degrees)
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -matrix[second, first]
    return matrix


def look_at(origin: Vector, target: Vector, *, up: Vector = (0.0, 0.0, 1.0)) -> Array:
    """Return the matrix that places a camera or an emitter, whose own view is along +z.

    Raises
    ------
    InputError
        If the view is parallel to `up`.
    """
    forward = np.subtract(target, origin)
    left = np.cross(up, forward)
    if not left.any():
        message = f"up must not be parallel to the view {forward.tolist()}, got {up}"
        raise InputError(message)
    matrix = np.eye(4)
    matrix[:3, 0] = _unit(left)
    matrix[:3, 1] = _unit(np.cross(forward, left))
    matrix[:3, 2] = _unit(forward)
    matrix[:3, 3] = origin
    # Rounded like mesh vertices: it takes part in the scene's identity.
    return matrix.round(9)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
