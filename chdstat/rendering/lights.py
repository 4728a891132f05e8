"""Lights of a scene: their names, and the same paths with some of them alone.

Paths do not depend on how bright a light is: next-event estimation chooses among lights by their
number or their sampling weights, and Russian roulette looks at the throughput. So the light of a
sample is the sum of what it has by each light alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat.errors import InputError, RenderError

__all__ = ["check_lights", "darken", "flush", "light_names", "switched_off"]

_DARK = 2.0**-100
"""What a light that is off is multiplied by: not 0, of which a texture or an environment map could
not be sampled, but a power of two, which leaves all probabilities as they are."""
_FLUSHED = 2.0**-60
"""Less than this is of lights that are off."""
_LISTED = 20
_RADIANCE = ("value", "values", "data", "scale", "sun_scale", "sky_scale")


def light_names(scene: Any) -> list[str]:
    """Return the names of the lights of a Mitsuba scene: ids of their shapes, or of their own.

    Those that have none are called by their kind; those that share one are numbered.
    """
    names: list[str] = []
    for light in scene.emitters():
        shape = light.get_shape()
        name = (shape.id() if shape is not None else light.id()) or type(light).__name__
        names.append(name)
    return [
        name if names.count(name) == 1 else f"{name}-{names[:i].count(name)}"
        for i, name in enumerate(names)
    ]


def check_lights(names: Sequence[str], patterns: Sequence[str]) -> None:
    """Refuse patterns of names that match no light, or one that another matches, too.

    Raises
    ------
    InputError
        If one does.

    Examples
    --------
    >>> check_lights(["lamp-0", "lamp-1", "sky"], ["lamp-*", "sky"])
    """
    if isinstance(patterns, str | Path):
        message = f"by_light must be a sequence of names, such as [{str(patterns)!r}]"
        raise InputError(message)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            there = ", ".join(names[:_LISTED]) or "none"
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            message = f"no light {pattern!r}; the scene has {there}{more}"
            raise InputError(message)
    for name in names:
        matching = [pattern for pattern in patterns if fnmatchcase(name, pattern)]
        if len(matching) > 1:
            message = f"light {name!r} is of several groups: {', '.join(matching)}"
            raise InputError(message)


def switched_off(mi: Any, scene: Any, kept: str) -> list[tuple[Any, list[str]]]:
    """Return the parameters of all lights but those of a pattern, and the names of their radiance.

    Raises
    ------
    RenderError
        If a light has no radiance that can be changed.
    """
    found = []
    for light, name in zip(scene.emitters(), light_names(scene), strict=True):
        if fnmatchcase(name, kept):
            continue
        parameters = mi.traverse(light)
        keys = ["scale"] if "scale" in parameters else []
        keys = keys or [key for key in parameters.keys() if key.split(".")[-1] in _RADIANCE]  # noqa: SIM118
        if not keys:
            message = f"light {name!r} ({type(light).__name__}) cannot be switched off"
            raise RenderError(message)
        found.append((parameters, keys))
    return found


def darken(mi: Any, scene: Any, kept: str) -> None:
    """Switch off all lights of a Mitsuba scene but those whose names match a pattern.

    Raises
    ------
    RenderError
        If a light has no radiance that can be changed.
    """
    for parameters, keys in switched_off(mi, scene, kept):
        for key in keys:
            parameters[key] = parameters[key] * _DARK
        parameters.update()


def flush(block: Image) -> Image:
    """Return samples without what lights that are off have left in them."""
    return np.where(np.abs(block) < _FLUSHED, np.float32(0), block)
