"""A symmetric hall of ribs and niches, neutral in colour and lit mostly indirectly.

White panels at the far end, behind the camera and above the aisles light the hall; small yellow
lamps between the slats of the walls are chosen seldom and lie deep, so what finds them is rare and
bright. The panels can be seen from nearly everywhere: there are few null samples. The lamps at the
left are weaker, so that the light is not quite as symmetric as the hall.

The hall is 8 m wide (x from -4 to 4), 18 m deep (y) and 5.6 m high (z). The camera stands on the
axis at the front.
"""

from __future__ import annotations

import numpy as np

from chdstat.scenes.props.furniture import bulb, camera, glow, paving
from chdstat.scenes.props.shapes import Mesh, ball, box, circle, join, quad, ring, sheet, tube
from chdstat.scenes.props.textures import Entry, glossy, matte, metal, rgb
from chdstat.scenes.scene import rotate, translate

__all__ = ["build"]

_HALF, _DEPTH, _HEIGHT = 4.0, 18.0, 5.6
_BAYS = 6
_BAY = 2.6
_START = 1.2
_MIDDLES = [_START + (k + 0.5) * _BAY for k in range(_BAYS)]
_NAVE = 2.3
"""Half the width between the columns."""

_CONCRETE = matte(rgb(0.80, 0.80, 0.79))
_SATIN = glossy(rgb(0.66, 0.66, 0.67), roughness=0.22)
_DARK = glossy(rgb(0.09, 0.09, 0.095), roughness=0.15)
_STEEL = metal("Cr", roughness=0.25)


def build() -> Entry:
    """Return the scene dict of the gallery."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6},
        "sensor": camera((0.0, 0.25, 1.75), (0.0, 12.0, 2.25), fov=62.0),
        **_shell(),
        **_bays(),
        **_portal(),
        **_panels(),
        **_lamps(),
        **_sculptures(),
    }


def _shell() -> Entry:
    """Return walls and ceiling, and dark and pale slabs, polished, in concrete beside the nave."""
    walls = join(
        quad((-_HALF, _DEPTH, _HEIGHT), (2 * _HALF, 0, 0), (0, -_DEPTH, 0)),
        quad((-_HALF, _DEPTH, 0), (2 * _HALF, 0, 0), (0, 0, _HEIGHT)),
        quad((_HALF, 0, 0), (-2 * _HALF, 0, 0), (0, 0, _HEIGHT)),
        quad((_HALF, _DEPTH, 0), (0, -_DEPTH, 0), (0, 0, _HEIGHT)),
        quad((-_HALF, 0, 0), (0, _DEPTH, 0), (0, 0, _HEIGHT)),
    )
    base = quad((-_HALF, 0, -0.002), (2 * _HALF, 0, 0), (0, _DEPTH, 0))
    colors = (0.05, 0.05, 0.052), (0.72, 0.71, 0.69)
    return {
        "walls": walls.shape(_CONCRETE),
        "slabs": paving((-_NAVE, 0.0), (8, 32), colors, edge=_NAVE / 4, roughness=0.12),
        "base": base.shape(matte(rgb(0.55, 0.55, 0.55))),
    }


def _bays() -> Entry:
    """Return the columns, the arches that join them over the nave, fins and beams."""
    columns, collars, arches, fins, beams = [], [], [], [], []
    column = _column()
    collar = join(*(ring(*at, wire=(0.03, 0.03), sides=12) for at in ((0.235, 0.22), (0.225, 3.2))))
    arch, fin, beam = _arch(), _fins(), _beams()
    for k in range(_BAYS + 1):
        along = translate(0, _START + k * _BAY, 0)
        for side in (translate(_NAVE + 0.25, 0, 0), translate(-_NAVE - 0.25, 0, 0)):
            columns.append(column.moved(along @ side))
            collars.append(collar.moved(along @ side))
        arches += [arch.moved(along @ translate(0, y, 0)) for y in (-0.16, 0.16)]
    for y in _MIDDLES:
        middle = translate(0, y, 0)
        # Symmetric in y, the other side of the hall is the first one turned.
        fins += [fin.moved(middle), fin.moved(rotate("z", 180)).moved(middle)]
        beams.append(beam.moved(middle))
    return {
        "columns": join(*columns).shape(_SATIN),
        "collars": join(*collars).shape(_STEEL),
        "arches": join(*arches).shape(_SATIN),
        "fins": join(*fins).shape(_CONCRETE),
        "beams": join(*beams).shape(_DARK),
    }


def _column() -> Mesh:
    """Return a fluted shaft that widens at foot and head."""
    height = np.array([0.0, 0.12, 0.2, 0.6, 1.4, 2.4, 3.0, 3.3, 3.5])
    radius = np.array([0.3, 0.3, 0.24, 0.22, 0.205, 0.2, 0.205, 0.25, 0.34])
    turn = np.append(np.linspace(0, 2 * np.pi, 97)[:-1], 0.0)
    x, y = circle(96).T * (1 - 0.09 * np.abs(np.sin(6 * turn)))
    return sheet(radius[:, None] * x, radius[:, None] * y, height[:, None])


def _arch() -> Mesh:
    """Return a pipe from head to head of two columns, over the nave."""
    turn = np.linspace(0, np.pi, 33)
    reach = _NAVE + 0.25
    path = np.column_stack([reach * np.cos(turn), 0 * turn, 3.45 + 1.75 * np.sin(turn)])
    return tube(path, 0.085, segments=12)


def _fins() -> Mesh:
    """Return the side wall of one bay: upright slats that stand out more towards its middle."""
    slats = []
    for k in range(9):
        y = (k - 4) * 0.27
        out = 0.25 + 0.42 * np.cos(np.pi * (k - 4) / 10)
        slats.append(box((_HALF - out, y - 0.035, 0.5), (_HALF, y + 0.035, 4.4), bevel=0.01))
    shelf = box((_HALF - 0.85, -1.2, 0.0), (_HALF, 1.2, 0.42), bevel=0.02)
    return join(*slats, shelf)


def _beams() -> Mesh:
    """Return a coffer of the ceiling: crossing beams."""
    across = [box((-_HALF, y - 0.06, 5.2), (_HALF, y + 0.06, 5.6)) for y in (-0.65, 0.0, 0.65)]
    along = [box((x - 0.06, -1.3, 5.26), (x + 0.06, 1.3, 5.6)) for x in (-2.8, -1.4, 0.0, 1.4, 2.8)]
    return join(*across, *along)


def _portal() -> Entry:
    """Return nested frames before the far panel."""
    frames = []
    for k in range(4):
        half, high, y = 2.1 - 0.3 * k, 4.4 - 0.42 * k, _DEPTH - 0.5 - 0.35 * (3 - k) * 0.8
        t = 0.09
        frames += [
            box((-half - t, y - 0.1, 0.0), (-half, y + 0.1, high + t), bevel=0.015),
            box((half, y - 0.1, 0.0), (half + t, y + 0.1, high + t), bevel=0.015),
            box((-half, y - 0.1, high), (half, y + 0.1, high + t), bevel=0.015),
        ]
    return {"portal": join(*frames).shape(_DARK)}


def _panels() -> Entry:
    """Return the white lights: at the far end, over the nave, and behind the columns."""
    far = quad((-1.15, _DEPTH - 0.05, 0.3), (2.3, 0, 0), (0, 0, 2.8))
    # Behind the camera, as wide as the nave.
    near = quad((2.2, 0.05, 0.6), (-4.4, 0, 0), (0, 0, 3.6))
    entries: Entry = {
        "far-panel": glow(far, rgb(6.0, 6.1, 6.3), weight=3.0),
        "near-panel": glow(near, rgb(1.6, 1.62, 1.68), weight=9.0),
    }
    for k, y in enumerate(_MIDDLES):
        # Above the aisles, outside the columns.
        for name, x in (("left", -3.35), ("right", 2.75)):
            panel = quad((x, y + 0.9, 5.15), (0.6, 0, 0), (0, -1.8, 0))
            entries[f"panel-{name}-{k}"] = glow(panel, rgb(9.0, 9.2, 9.6), weight=0.8)
    return entries


def _lamps() -> Entry:
    """Return small yellow lamps between the fins; the left ones are a little weaker."""
    entries: Entry = {}
    for k, y in enumerate(_MIDDLES):
        for name, side, level in (("left", -1, 0.7), ("right", 1, 1.0)):
            yellow = rgb(420.0 * level, 240.0 * level, 40.0 * level)
            spot = (side * (_HALF - 0.2), y + 0.135, 1.6)
            entries[f"lamp-{name}-{k}"] = bulb(spot, 0.05, yellow, weight=0.1)
    return entries


def _sculptures() -> Entry:
    """Return two plinths with polished pieces, and a bench on the axis."""
    entries: Entry = {}
    torus = ring(0.26, 0.0, wire=(0.075, 0.075), sides=24, segments=64)
    plinths = [box((x - 0.28, 4.6, 0), (x + 0.28, 5.16, 0.95), bevel=0.015) for x in (-1.35, 1.35)]
    entries["plinths"] = join(*plinths).shape(_CONCRETE)
    globe = ball(0.3, rows=32, segments=64)
    entries["ball"] = globe.moved(translate(-1.35, 4.88, 1.25)).shape(_STEEL)
    tilted = translate(1.35, 4.88, 1.285) @ rotate("z", 20) @ rotate("x", 90)
    entries["ring"] = torus.moved(tilted).shape(_STEEL)
    bench = join(
        box((-0.5, 7.6, 0.36), (0.5, 9.4, 0.43), bevel=0.01),
        box((-0.4, 7.9, 0.0), (0.4, 8.0, 0.36), bevel=0.01),
        box((-0.4, 9.0, 0.0), (0.4, 9.1, 0.36), bevel=0.01),
    )
    entries["bench"] = bench.shape(_DARK)
    return entries
