"""Floors of the built-in scenes, as plain scene entries."""

from __future__ import annotations

from chdstat.scenes import textures
from chdstat.scenes.materials import Entry, glossy
from chdstat.scenes.shapes import tiles
from chdstat.scenes.transforms import translate

__all__ = ["paving"]


def paving(
    corner: tuple[float, float],
    fields: tuple[int, int],
    *,
    edge: float,
    dark: textures.Color,
    pale: textures.Color,
    roughness: float,
) -> Entry:
    """Return square slabs under a clear coat, dark and pale ones in turn, with open joints.

    Parameters
    ----------
    corner
        Where the floor begins, (x, y) in metres; it lies at z = 0.
    fields
        How many slabs along x and y.
    edge
        Of a slab and its joint, in metres.
    dark, pale
        Linear RGB of the slabs; the first is dark.
    roughness
        Of the clear coat.
    """
    columns, rows = fields
    image = textures.checks(dark, pale, rows=rows, columns=columns)
    slabs = tiles(columns, rows, size=(edge, edge), gap=0.024 * edge, depth=0.008 * edge)
    coat = glossy(textures.bitmap(image, sharp=True), roughness=roughness)
    return slabs.moved(translate(*corner, 0.0)).shape(coat)
