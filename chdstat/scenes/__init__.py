"""Scenes: built-in ones, scene files, dicts in Mitsuba's form, and scenes that Mitsuba has built.

`load_scene` takes any of them and returns a `Scene` for `chdstat.render`.
"""

from __future__ import annotations

from chdstat.scenes.builtin import BUILTIN, REMAKES
from chdstat.scenes.plugins import load_plugin
from chdstat.scenes.scene import Scene, SceneLike, load_scene

__all__ = ["BUILTIN", "REMAKES", "Scene", "SceneLike", "load_plugin", "load_scene"]
