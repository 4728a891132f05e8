"""Materials for the built-in scenes, as plain scene entries.

Use `matte` for plaster and cloth, `glossy` for glaze and lacquer, `metal` for taps and frames,
`glass` for what light goes through. All but glass look the same from both sides.
"""

from __future__ import annotations

from typing import Any, Literal

__all__ = ["Entry", "glass", "glossy", "matte", "metal", "rgb"]

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


def _twosided(bsdf: Entry) -> Entry:
    return {"type": "twosided", "bsdf": bsdf}
