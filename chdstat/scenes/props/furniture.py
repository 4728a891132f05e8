"""Furniture, floors, lights and the camera of the built-in scenes, as plain scene entries.

Furniture takes the matrix that places the piece: it stands on, or hangs at, its own origin with
its back towards +y. Lengths are metres.

Lights: `glow` for a mesh that shines, `bulb` for a ball, `spot` for a disk; all three are black
where they do not shine. Their `radiance` is in linear RGB or a texture; their `weight` tells how
often, relative to the other lights, a path tracer chooses this one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat.scenes.props import textures
from chdstat.scenes.props.shapes import (
    Mesh,
    ball,
    box,
    join,
    loft,
    revolve,
    ring,
    rounded_rectangle,
    sheet,
    tiles,
    tube,
)
from chdstat.scenes.props.textures import (
    Entry,
    glass,
    glossy,
    matte,
    metal,
    rgb,
    translucent,
    walnut,
)
from chdstat.scenes.scene import Vector, look_at, rotate, scale, translate

__all__ = [
    "basket",
    "bulb",
    "camera",
    "dispenser",
    "door",
    "glow",
    "lamp",
    "mirror",
    "paving",
    "plant",
    "sphere",
    "spot",
    "towel",
    "towel_rail",
    "tub",
    "tub_tap",
    "tumbler",
    "vanity",
    "vase",
    "wall_lamp",
]


Matrix = npt.NDArray[np.float64]

_CERAMIC = glossy(rgb(0.86, 0.85, 0.82), roughness=0.06)
_CHROME = metal("Cr", roughness=0.08)
_BLACK = matte(rgb(0.0, 0.0, 0.0))
_BRASS = metal("Au", roughness=0.2)
_SATIN_BRASS = metal("Au", roughness=0.25)

# Profiles are (radius, height): up the outside, then down the inside.
_BASIN = [
    *[(0.0, 0.0), (0.11, 0.0), (0.135, 0.012), (0.18, 0.06), (0.208, 0.115), (0.212, 0.135)],
    *[(0.207, 0.140), (0.2, 0.135), (0.185, 0.1), (0.15, 0.055), (0.1, 0.03), (0.0, 0.024)],
]
_BASKET = [
    *[(0.0, 0.0), (0.15, 0.0), (0.19, 0.2), (0.205, 0.46)],
    *[(0.195, 0.46), (0.18, 0.2), (0.14, 0.02), (0.0, 0.02)],
]
_DISPENSER = [
    *[(0.0, 0.0), (0.034, 0.0), (0.037, 0.004), (0.037, 0.11), (0.03, 0.126), (0.013, 0.134)],
    *[(0.013, 0.15), (0.0, 0.15)],
]
_LAMP_FOOT = [(0.0, 0.0), (0.14, 0.0), (0.14, 0.012), (0.02, 0.028), (0.0, 0.028)]
_POT = [(0.0, 0.0), (0.05, 0.0), (0.066, 0.12), (0.06, 0.12), (0.058, 0.105), (0.0, 0.105)]
_TUMBLER = [(0.0, 0.0), (0.034, 0.0), (0.038, 0.1), (0.035, 0.1), (0.031, 0.006), (0.0, 0.006)]
_VASE = [
    *[(0.0, 0.0), (0.04, 0.0), (0.052, 0.03), (0.05, 0.08), (0.022, 0.13), (0.026, 0.16)],
    *[(0.0225, 0.16), (0.0185, 0.13), (0.046, 0.08), (0.048, 0.03), (0.036, 0.008), (0.0, 0.008)],
]

# Width, length, corner radius and height of a tub's outlines: up the outside, down the inside.
_TUB = [
    *[(0.50, 1.34, 0.22, 0.0), (0.54, 1.40, 0.25, 0.02), (0.62, 1.52, 0.29, 0.20)],
    *[(0.70, 1.62, 0.33, 0.42), (0.75, 1.68, 0.36, 0.545), (0.78, 1.71, 0.375, 0.565)],
    *[(0.78, 1.71, 0.375, 0.575), (0.76, 1.69, 0.365, 0.585), (0.70, 1.63, 0.335, 0.585)],
    *[(0.675, 1.605, 0.325, 0.57), (0.62, 1.52, 0.30, 0.42), (0.54, 1.36, 0.26, 0.22)],
    *[(0.44, 1.20, 0.21, 0.15), (0.30, 1.00, 0.14, 0.135)],
]


# --- lights and camera ----------------------------------------------------------------------------


def glow(mesh: Mesh, radiance: Entry, *, weight: float = 1.0) -> Entry:
    """Return a mesh that shines to the side which it faces."""
    return {**mesh.shape(_BLACK), "emitter": _area(radiance, weight)}


def sphere(center: Vector, radius: float, bsdf: Entry) -> Entry:
    """Return an exact sphere, which has no triangles."""
    return {
        "type": "sphere",
        "center": np.round(center, 6).tolist(),
        "radius": radius,
        "bsdf": bsdf,
    }


def bulb(center: Vector, radius: float, radiance: Entry | None, *, weight: float = 1.0) -> Entry:
    """Return a ball that shines, or a white one where the radiance is None."""
    if radiance is None:
        return sphere(center, radius, matte(rgb(0.8, 0.8, 0.8)))
    return {**sphere(center, radius, _BLACK), "emitter": _area(radiance, weight)}


def spot(
    origin: Vector, target: Vector, radius: float, radiance: Entry, *, weight: float = 1.0
) -> Entry:
    """Return a disk at `origin` that shines towards `target`."""
    return {
        "type": "disk",
        "to_world": look_at(origin, target) @ scale(radius, radius, 1.0),
        "bsdf": _BLACK,
        "emitter": _area(radiance, weight),
    }


def _area(radiance: Entry, weight: float) -> Entry:
    return {"type": "area", "radiance": radiance, "sampling_weight": weight}


def camera(origin: Vector, target: Vector, *, fov: float) -> Entry:
    """Return a camera that looks from `origin` at `target`; `fov` is in degrees across."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.01,
        "far_clip": 100.0,
        "to_world": look_at(origin, target),
        "film": {"type": "hdrfilm", "width": 512, "height": 512, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


# --- large pieces ---------------------------------------------------------------------------------


def vanity(place: Matrix) -> Entry:
    """Return a hanging cabinet with two drawers, a vessel basin and its tap."""
    half, front, low, top = 0.57, -0.52, 0.46, 0.84
    drawers = [
        box((a, front - 0.02, low), (b, front, top - 0.012), bevel=0.003)
        for a, b in ((-half, -0.003), (0.003, half))
    ]
    body = box((0.004 - half, front, low + 0.002), (half - 0.004, 0.0, top), bevel=0.002)
    slab = box((-half - 0.015, front - 0.035, top), (half + 0.015, 0.0, top + 0.03), bevel=0.005)
    handles = [
        tube([(x + dx, front - 0.045, 0.71) for dx in (-0.11, 0.0, 0.11)], 0.007, segments=12)
        for x in (-half / 2, half / 2)
    ]
    basin = revolve(_BASIN, crease=70.0).moved(translate(0, -0.28, top + 0.03))
    tap = _swan_neck().moved(translate(0, -0.06, top + 0.03))
    return {
        "vanity": join(body, *drawers).mapped(scale=(0.8, 2.2)).moved(place).shape(walnut(7)),
        "vanity-top": slab.moved(place).shape(glossy(rgb(0.62, 0.60, 0.57), roughness=0.2)),
        "vanity-handles": join(*handles).moved(place).shape(_BRASS),
        "basin": basin.moved(place).shape(_CERAMIC),
        "tap": tap.moved(place).shape(_CHROME),
    }


def mirror(place: Matrix, *, radius: float) -> Entry:
    """Return a round mirror in a brass frame, about its origin and facing -y."""
    frame = ring(radius, 0.0, wire=(0.012, 0.016), sides=16, segments=96)
    return {
        "mirror": {
            "type": "disk",
            "to_world": place @ look_at((0, 0, 0), (0, -1, 0)) @ scale(radius, radius, 1.0),
            "bsdf": metal("Ag"),
        },
        "mirror-frame": frame.moved(place @ rotate("x", 90)).shape(_BRASS),
    }


def tub(place: Matrix) -> Entry:
    """Return a free-standing tub that lies along y."""
    outlines = [rounded_rectangle(width, length, radius) for width, length, radius, _ in _TUB]
    mesh = loft(outlines, [height for *_, height in _TUB], crease=60.0)
    return {"tub": mesh.moved(place).shape(_CERAMIC)}


def tub_tap(place: Matrix) -> Entry:
    """Return a spout between two knobs, on a wall."""
    spout = tube(
        [(0, 0, 0), (0, -0.13, 0), (0, -0.17, -0.005), (0, -0.195, -0.03), (0, -0.2, -0.08)], 0.017
    )
    knobs = [tube([(x, 0, 0), (x, -0.03, 0), (x, -0.05, 0)], 0.026) for x in (-0.13, 0.13)]
    return {"tub-tap": join(spout, *knobs).moved(place).shape(_CHROME)}


def door(place: Matrix) -> Entry:
    """Return a walnut door, 0.8 m by 2.05 m, closed in the wall at its back."""
    leaf = box((-0.4, -0.03, 0), (0.4, 0.05, 2.05), bevel=0.008, grain="z")
    knob = ball(0.03).moved(translate(-0.32, -0.07, 1.02))
    return {
        "door": leaf.mapped(scale=(0.5, 2.0)).moved(place).shape(walnut(2)),
        "door-knob": knob.moved(place).shape(_BRASS),
    }


def paving(
    corner: tuple[float, float],
    fields: tuple[int, int],
    colors: tuple[textures.Color, textures.Color],
    *,
    edge: float,
    roughness: float,
) -> Entry:
    """Return square slabs under a clear coat, dark and pale ones in turn, with open joints.

    Parameters
    ----------
    corner
        Where the floor begins, (x, y) in metres; it lies at z = 0.
    fields
        How many slabs along x and y.
    colors
        Linear RGB of the dark and of the pale slabs; the first slab is dark.
    edge
        Of a slab and its joint, in metres.
    roughness
        Of the clear coat.
    """
    columns, rows = fields
    image = textures.checks(*colors, rows=rows, columns=columns)
    slabs = tiles(columns, rows, size=(edge, edge), gap=0.024 * edge, depth=0.008 * edge)
    coat = glossy(textures.bitmap(image, sharp=True), roughness=roughness)
    return slabs.moved(translate(*corner, 0.0)).shape(coat)


def lamp(place: Matrix, name: str, *, height: float, shade: Entry, light: Entry | None) -> Entry:
    """Return a standing lamp whose paper shade is open at both ends.

    Parameters
    ----------
    place
        Where it stands.
    name
        What the names of its entries begin with.
    height
        Of the upper rim of the shade, in metres.
    shade
        Colour of the shade.
    light
        Radiance of the bulb, or None for a lamp that is off.
    """
    wide, narrow, low = 0.2, 0.14, height - 0.28
    rims = ((wide, low), (narrow, height))
    sleeve = revolve(np.linspace(*rims, 3), crease=180.0)
    stem = revolve([(0, 0.02), (0.011, 0.02), (0.011, low + 0.04), (0, low + 0.04)], segments=16)
    wires = [ring(*rim, wire=(0.004, 0.004), sides=8) for rim in rims]
    metal_parts = join(revolve(_LAMP_FOOT), stem, *wires)
    return {
        f"{name}-shade": sleeve.moved(place).shape(translucent(shade, through=0.55)),
        f"{name}-foot": metal_parts.moved(place).shape(_SATIN_BRASS),
        f"{name}-bulb": bulb((place @ [0, 0, low + 0.13, 1])[:3], 0.045, light),
    }


# --- textiles -------------------------------------------------------------------------------------


def towel_rail(place: Matrix) -> Entry:
    """Return a chrome rail with a striped towel, 0.08 m in front of the wall."""
    rail = tube([(-0.3, 0, 0), (0.0, 0, 0), (0.3, 0, 0)], 0.009).moved(translate(0, -0.08, 0))
    arms = [tube([(x, -0.08, 0), (x, -0.04, 0), (x, 0, 0)], 0.007) for x in (-0.28, 0.28)]
    cloth = textures.bands(
        (0.62, 0.33, 0.055), (0.78, 0.72, 0.62), edges=[(0.12, 0.16), (0.19, 0.21)]
    )
    hanging = _hanging(0.44, front=0.62, back=0.45).moved(place @ translate(0, -0.08, 0))
    return {
        "towel-rail": join(rail, *arms).moved(place).shape(_CHROME),
        "towel": hanging.shape(matte(textures.bitmap(cloth))),
    }


def towel(place: Matrix, *, color: Entry) -> Entry:
    """Return a bath towel over a hook at the origin."""
    return {"bath-towel": _hanging(0.5, front=0.9, back=0.3).moved(place).shape(matte(color))}


def _hanging(width: float, *, front: float, back: float) -> Mesh:
    """Return cloth over a bar along x at the origin, with soft folds in its front."""
    radius, bend = 0.014, np.linspace(0, np.pi, 9)[1:-1]
    profile = np.concatenate(
        [
            [(-radius, z) for z in np.linspace(-front, 0, 24)],
            radius * np.column_stack([-np.cos(bend), np.sin(bend)]),
            [(radius, z) for z in np.linspace(0, -back, 12)],
        ]
    )
    y, z = profile[:, :1], profile[:, 1:]
    x = np.linspace(-width / 2, width / 2, 60)
    fall = np.clip(-z / front, 0, 1)
    wave = np.sin(2 * np.pi * 3.2 * x / width + 0.6) + 0.4 * np.sin(61 * x)
    fold = np.where(y < 0, 0.013 * fall**0.6 * wave - 0.008 * fall, 0)
    narrowed = x * (1 - 0.05 * fall)
    return sheet(narrowed, y + fold, z)


# --- small pieces ---------------------------------------------------------------------------------


def basket(place: Matrix) -> Entry:
    """Return a wicker basket."""
    rounds = [(k / 32, (k + 0.5) / 32) for k in range(32)]
    wicker = textures.bands((0.52, 0.37, 0.21), (0.27, 0.17, 0.085), edges=rounds)
    mesh = revolve(_BASKET, crease=70.0).mapped(scale=(24.0, 1.0))
    return {"basket": mesh.moved(place).shape(matte(textures.bitmap(wicker)))}


def dispenser(place: Matrix) -> Entry:
    """Return a dark soap dispenser with a brass pump."""
    pump = tube([(0, 0, 0.15), (0, 0, 0.185), (-0.003, -0.005, 0.19), (-0.03, -0.03, 0.19)], 0.005)
    glaze = glossy(rgb(0.03, 0.10, 0.11), roughness=0.05)
    return {
        "dispenser": revolve(_DISPENSER).moved(place).shape(glaze),
        "dispenser-pump": pump.moved(place).shape(_BRASS),
    }


def tumbler(place: Matrix) -> Entry:
    """Return a chrome tumbler."""
    return {"tumbler": revolve(_TUMBLER).moved(place).shape(_CHROME)}


def vase(place: Matrix) -> Entry:
    """Return a vase of clear glass."""
    return {"vase": revolve(_VASE).moved(place).shape(glass())}


def wall_lamp(place: Matrix, *, name: str) -> Entry:
    """Return an opal globe on a brass arm, unlit."""
    plate = tube([(0, 0, -0.09), (0, -0.006, -0.09), (0, -0.012, -0.09)], 0.035)
    bend = [(0, 0, -0.09), (0, -0.09, -0.09), (0, -0.12, -0.085), (0, -0.13, -0.06)]
    globe = ball(0.075).moved(translate(0, -0.13, 0))
    return {
        f"{name}-globe": globe.moved(place).shape(_CERAMIC),
        f"{name}-arm": join(plate, tube(bend, 0.008)).moved(place).shape(_BRASS),
    }


def plant(place: Matrix) -> Entry:
    """Return a leafy plant in a terracotta pot."""
    rng = np.random.default_rng(11)
    lengths, lifts = 0.17 + 0.1 * rng.random(18), np.linspace(80, 25, 18)
    turns = 137.5 * np.arange(18) + 20 * rng.random(18)
    leaves = [
        _leaf(length, lift).moved(rotate("z", turn) @ translate(0.012, 0, 0.1))
        for length, lift, turn in zip(lengths, lifts, turns, strict=True)
    ]
    return {
        "plant-pot": revolve(_POT).moved(place).shape(matte(rgb(0.45, 0.17, 0.09))),
        "plant": join(*leaves).moved(place).shape(matte(rgb(0.09, 0.22, 0.06))),
    }


def _leaf(length: float, lift: float) -> Mesh:
    """Return a leaf that grows from the origin towards +x, rises by `lift` degrees and droops."""
    along = np.linspace(0, 1, 9)[:, None]
    across = np.array([-1.0, 0.0, 1.0])
    angle = np.deg2rad(lift - 65 * along)
    step = length / 8 * np.concatenate([[[0.0]], np.ones((8, 1))])
    half = 0.13 * length * np.sin(np.pi * along**0.7) ** 0.8 + 0.002
    x = np.cumsum(step * np.cos(angle), axis=0)
    z = np.cumsum(step * np.sin(angle), axis=0)
    # Folded a little along the midrib.
    return sheet(x, half * across, z + 0.35 * half * np.abs(across))


def _swan_neck() -> Mesh:
    """Return a tap that stands at the origin and pours towards -y."""
    turn = np.linspace(0, np.pi, 13)
    arc = np.column_stack([0 * turn, 0.07 * np.cos(turn) - 0.07, 0.27 + 0.07 * np.sin(turn)])
    path = np.concatenate([[(0, 0, 0), (0, 0, 0.1), (0, 0, 0.2)], arc, [(0, -0.14, 0.22)]])
    foot = revolve([(0, 0), (0.028, 0), (0.028, 0.012), (0.016, 0.02), (0, 0.02)])
    lever = tube([(0.0, 0, 0.075), (0.03, 0, 0.078), (0.075, 0, 0.085)], 0.006)
    return join(tube(path, 0.014), foot, lever)
