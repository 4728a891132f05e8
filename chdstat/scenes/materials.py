"""Materials for the built-in scenes, as plain scene entries.

Use `matte` for plaster and cloth, `glossy` for glaze and lacquer, `walnut` for furniture, `metal`
for taps and frames, `glass` for what light goes through, `translucent` for lamp shades and paper.
All but glass look the same from both sides.
"""

from __future__ import annotations

from typing import Any, Literal

from chdstat.scenes import textures

__all__ = ["Entry", "glass", "glossy", "matte", "metal", "rgb", "translucent", "walnut"]

Entry = dict[str, Any]


def rgb(red: float, green: float, blue: float) -> Entry:
    """Return a linear RGB colour."""
    return {"type": "rgb", "value": [red, green, blue]}


def matte(color: Entry) -> Entry:
    """Return a diffuse surface."""
    return _twosided({"type": "diffuse", "reflectance": color})


def glossy(color: Entry, *, roughness: float) -> Entry:
    """Return a diffuse surface under a clear coat."""
    return _twosided(
        {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": roughness,
            "diffuse_reflectance": color,
            "nonlinear": True,
        }
    )


def metal(material: Literal["Ag", "Au", "Cr"], *, roughness: float = 0.0) -> Entry:
    """Return silver, gold or chromium; a mirror where `roughness` is 0."""
    if roughness == 0:
        return _twosided({"type": "conductor", "material": material})
    return _twosided({"type": "roughconductor", "material": material, "alpha": roughness})


def glass() -> Entry:
    """Return clear glass in air."""
    return {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}


def translucent(color: Entry, *, through: float) -> Entry:
    """Return thin cloth or paper that scatters the share `through` of its light to the far side."""
    # Mitsuba counts from 0, all reflected, to 2, all transmitted.
    return {
        "type": "principledthin",
        "base_color": color,
        "roughness": 0.7,
        "spec_trans": 0.0,
        "eta": 1.3,
        "diff_trans": 2.0 * through,
    }


def walnut(seed: int, *, roughness: float = 0.12) -> Entry:
    """Return walnut under a clear coat; the seed tells which board."""
    image = textures.wood((0.085, 0.036, 0.016), (0.36, 0.185, 0.085), seed=seed)
    return glossy(textures.bitmap(image), roughness=roughness)


def _twosided(bsdf: Entry) -> Entry:
    return {"type": "twosided", "bsdf": bsdf}
