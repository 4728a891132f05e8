"""Scenes: the built-in catalogue, Mitsuba XML files and dicts, and scenes that Mitsuba has built.

Use `load_scene` for all of them; it returns a `Scene`, which `chdstat.render` takes.
"""

from __future__ import annotations

import difflib
import importlib
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chdstat.errors import InputError, SceneError
from chdstat.scenes.files import is_file
from chdstat.scenes.plugins import load_plugin
from chdstat.scenes.scene import LiveScene, Scene

__all__ = ["BUILTIN", "REMAKES", "Scene", "SceneLike", "load_plugin", "load_scene"]

SceneLike = str | Path | Mapping[str, Any] | Scene | Any
"""A built-in name, an XML file, a dict in Mitsuba's form, a `Scene`, or a ``mi.Scene``."""

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
"""Names of the built-in scenes and what each shows; one module each, dashes as underscores."""
REMAKES = {
    "bathroom": "Bathroom",
    "day-room": "WhiteRoom",
    "night-room": "NightRoom",
    "gallery": "MeasureOne",
}
"""Built-in scenes that were made after one of Elek, Thomas and Forbes 2019, and that one's name."""


def load_scene(source: SceneLike, **parameters: object) -> Scene:
    """Return a scene by built-in name, Mitsuba XML path, Mitsuba dict, or as Mitsuba has built it.

    Parameters
    ----------
    source
        A name in `BUILTIN`, the path of a Mitsuba XML file, a dict in Mitsuba's form, or a
        ``mi.Scene``, which is rendered as it is, in this process. A `Scene` passes through.
    **parameters
        Values for the ``$name`` parameters of an XML file, as ``-D`` gives them to Mitsuba.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If it is none of these.
    SceneError
        If the name is unknown (the nearest is suggested), the file is missing or is not XML, or
        parameters are given to a scene that takes none.

    Examples
    --------
    >>> from chdstat import load_scene
    >>> load_scene("cornell-box").name
    'cornell-box'
    >>> load_scene("cornel-box")
    Traceback (most recent call last):
    chdstat.errors.SceneError: no built-in scene or file 'cornel-box'; did you mean 'cornell-box'...
    """
    if isinstance(source, Scene):
        scene = source
    elif LiveScene.fits(source):
        scene = Scene("scene", LiveScene(source))
    elif not isinstance(source, str | Path | Mapping):
        kind = f"{type(source).__module__}.{type(source).__qualname__}"
        message = (
            "scene must be a name, the path of an XML file, a dict, a chdstat Scene or a mi.Scene, "
            f"got a {kind}"
        )
        raise InputError(message)
    elif isinstance(source, Mapping):
        scene = Scene("scene", _checked_dict(source))
    elif str(source) in BUILTIN:
        module = importlib.import_module(f"chdstat.scenes.builtin.{str(source).replace('-', '_')}")
        scene = Scene(str(source), module.build())
    else:
        return Scene(*_checked_file(Path(source)), {k: str(v) for k, v in parameters.items()})
    if parameters:
        message = (
            f"scene {scene.name!r} takes no parameters (only XML files do), "
            f"got {', '.join(sorted(parameters))}"
        )
        raise SceneError(message)
    return scene


def _checked_dict(source: Mapping[str, Any]) -> Mapping[str, Any]:
    if source.get("type") != "scene":
        message = f"a scene dict needs 'type': 'scene', got 'type': {source.get('type')!r}"
        raise SceneError(message)
    return source


def _checked_file(path: Path) -> tuple[str, Path]:
    """Return the name and the absolute path of an XML scene that exists."""
    if is_file(path / "scene.xml"):
        path = path / "scene.xml"
    if not is_file(path):
        near = difflib.get_close_matches(str(path)[:100], BUILTIN, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        message = (
            f"no built-in scene or file {reprlib.repr(str(path))}; {hint}"
            f"Built-in scenes: {', '.join(sorted(BUILTIN))}"
        )
        raise SceneError(message)
    if path.suffix.lower() != ".xml":
        message = f"a scene file must be Mitsuba XML (*.xml), got {str(path)!r}"
        raise SceneError(message)
    name = path.parent.name if path.stem == "scene" else path.stem
    return name, path.resolve()
