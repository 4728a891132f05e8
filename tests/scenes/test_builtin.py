"""Built-in scenes: what they are made of, and their shares of nulls.

Shares and spreads are of fixed seeds and few samples. The bounds lie far outside what another seed
gives, so that a failure means a changed scene.
"""

from __future__ import annotations

import functools
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chdstat.scenes import BUILTIN, builtin, load_scene

IDENTITIES = {
    "bathroom": "f799da4d",
    "caustic": "4eb7885b",
    "cornell-box": "fde6f84c",
    "day-room": "1332d35a",
    "fog": "ab44f1d3",
    "gallery": "21ccb0d1",
    "many-lights": "0dc7bc90",
    "night-room": "c4569b7d",
}
"""The first digits of hashes of scenes that stores, and figures in the documentation, are of."""
NULL_SHARES = {
    "bathroom": (0.52, 0.62),
    "caustic": (0.08, 0.2),
    "day-room": (0.1, 0.2),
    "fog": (0.0, 0.1),
    "gallery": (0.1, 0.2),
    "many-lights": (0.0, 0.1),
    "night-room": (0.6, 0.75),
}


@functools.cache
def source_of(name: str) -> Any:
    return load_scene(name).source


def test_scenes_are_what_they_were():
    assert {name: load_scene(name).hash[:8] for name in IDENTITIES} == IDENTITIES


def test_the_tool_makes_their_meshes_and_textures(monkeypatch):
    tools = Path(__file__).parents[2] / "tools"
    monkeypatch.syspath_prepend(tools)
    made = runpy.run_path(str(tools / "make_scenes.py"))["made"]()
    with np.load(Path(builtin.__file__).parent / "arrays.npz") as held:
        assert list(made) == held.files
        for name in held.files:
            np.testing.assert_array_equal(made[name], held[name], err_msg=name)


@pytest.mark.parametrize("name", BUILTIN)
def test_every_scene_has_light_and_nulls(name, draw):
    """Of 24 576 samples; the means of pixels vary more than they, but less than 0.01 over seeds."""
    x = draw(source_of(name), size=32, spp=24)
    assert np.isfinite(x).all()
    assert (x >= 0).all()
    assert (x.max(axis=(2, 3)) > 0).mean() > 0.8
    assert 0.05 < x.mean() < 1.0
    low, high = NULL_SHARES.get(name, (0, 1))
    assert low <= (x == 0).all(axis=-2).mean() < high
