"""Built-in scenes: their names, and their descriptions as dicts in Mitsuba's form.

Each is a JSON file beside this module. Meshes and textures are arrays in ``arrays.npz``, made by
``tools/make_scenes.py``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BUILTIN", "REMAKES", "built_in"]

BUILTIN: dict[str, str] = {
    "bathroom": "A closed room lit through one window: nulls, long tails, a penumbra, a mirror.",
    "caustic": "Glass and gold under a small lamp: caustics, fireflies, hard shadows.",
    "cornell-box": "The classic test box: seconds to render.",
    "day-room": "A living room by day, a red evening sky before three windows: few nulls.",
    "fog": "A park in fog at dawn: a participating medium, halos, silhouettes. Uses volpath.",
    "gallery": "A symmetric hall of columns, lit by white panels and small yellow lamps.",
    "many-lights": "A terrace under strings of 112 coloured bulbs: mixtures of many modes.",
    "night-room": "The same living room by night, two lamps with paper shades: mostly nulls.",
}
"""Names of the built-in scenes, and what each shows."""
REMAKES = {
    "bathroom": "Bathroom",
    "day-room": "WhiteRoom",
    "night-room": "NightRoom",
    "gallery": "MeasureOne",
}
"""Built-in scenes made after a scene of Elek, Thomas and Forbes 2019, with that scene's name."""
_FOLDER = Path(__file__).parent


def built_in(name: str) -> dict[str, Any]:
    """Return the description of a built-in scene.

    Examples
    --------
    >>> built_in("cornell-box")["integrator"]["type"]
    'path'
    """
    with np.load(_FOLDER / "arrays.npz") as arrays:
        return _described(name, arrays)


def _described(name: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a JSON file, with matrices and arrays filled in.

    The data of a mesh or bitmap are names of arrays. ``include`` names another file, whose parts
    take its place.
    """

    def filled(value: Any) -> Any:
        if isinstance(value, list):
            return [filled(item) for item in value]
        if not isinstance(value, dict):
            return value
        found: dict[str, Any] = {}
        for key, item in value.items():
            if key == "include":
                found |= _described(item, arrays)
            elif key == "to_world":
                found[key] = np.array(item)
            elif key == "data" and value["type"] == "mesh":
                parts = ("vertices", "faces", "uv", "normals")
                found |= {part: arrays.get(f"{item}.{part}") for part in parts}
            else:
                found[key] = arrays[item] if key == "data" else filled(item)
        return found

    description: dict[str, Any] = filled(json.loads((_FOLDER / f"{name}.json").read_text("utf-8")))
    return description
