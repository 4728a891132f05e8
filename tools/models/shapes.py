"""Meshes for the built-in scenes, in NumPy alone.

Use `quad`, `box` and `tiles` for flat shapes; `revolve`, `tube` and `loft` for round ones; `sheet`
for any other surface. Lengths are metres, z is up, and faces wind counterclockwise seen from
outside.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Parameters
    ----------
    vertices
        Positions in metres, shape (n, 3).
    faces
        Vertex indices, shape (m, 3), counterclockwise seen from outside.
    uv
        Texture coordinates, shape (n, 2); the rows of an image run along v.
    normals
        Unit shading normals, shape (n, 3), or None for flat shading.
    """

    vertices: Array
    faces: npt.NDArray[np.int64]
    uv: Array
    normals: Array | None = None

    def moved(self, matrix: Array) -> Mesh:
        """Return the mesh under an affine map that does not mirror, shape (4, 4)."""
        linear = matrix[:3, :3]
        normals = self.normals
        if normals is not None:
            normals = _unit(normals @ np.linalg.inv(linear))
        return replace(self, vertices=self.vertices @ linear.T + matrix[:3, 3], normals=normals)

    def mapped(self, *, scale: Sequence[float]) -> Mesh:
        """Return the mesh with its texture coordinates multiplied by `scale`."""
        return replace(self, uv=self.uv * np.asarray(scale))

    def arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return the mesh as scenes hold it.

        Values are rounded far below what can be seen, so that a last-bit difference between two
        machines' mathematics does not change the identity of the scene.
        """
        parts = {"vertices": self.vertices, "uv": self.uv, "normals": self.normals}
        single = {k: np.round(v, 6).astype(np.float32) for k, v in parts.items() if v is not None}
        return {**single, "faces": self.faces.astype(np.uint32)}

    @property
    def face_normals(self) -> Array:
        """Normals of the faces, twice as long as the faces are large, shape (m, 3)."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.cross(b - a, c - a)


def translate(x: float, y: float, z: float) -> Array:
    """Return the matrix (4, 4) that moves by (x, y, z)."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotate(axis: Literal["x", "y", "z"], degrees: float) -> Array:
    """Return the matrix that turns counterclockwise about a coordinate axis."""
    first, second = (("xyz".index(axis) + k) % 3 for k in (1, 2))
    angle = np.deg2rad(degrees)
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -matrix[second, first]
    return matrix


def join(*meshes: Mesh) -> Mesh:
    """Return one mesh of several that are either all smooth or all flat."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    normals = [mesh.normals for mesh in meshes if mesh.normals is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate(normals) if normals else None,
    )


def quad(corner: Sequence[float], along_u: Sequence[float], along_v: Sequence[float]) -> Mesh:
    """Return a parallelogram that faces `along_u` x `along_v`; its uv are metres."""
    u, v = np.asarray(along_u, dtype=float), np.asarray(along_v, dtype=float)
    vertices = np.asarray(corner, dtype=float) + np.stack([0 * u, u, u + v, v])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [np.linalg.norm(u), np.linalg.norm(v)]
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(
    low: Sequence[float],
    high: Sequence[float],
    *,
    bevel: float = 0.0,
    grain: Literal["x", "y", "z"] = "x",
) -> Mesh:
    """Return an axis-parallel box between two corners, with its edges cut by `bevel`.

    Texture coordinates are metres, u along the axis `grain` on the faces that contain it.
    """
    half = np.subtract(high, low) / 2
    # A direction with one sign is a side, with two a cut edge, with three a cut corner.
    directions = [np.array(d) for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
    if bevel == 0:
        directions = [d for d in directions if np.count_nonzero(d) == 1]
    centre = np.add(low, high) / 2
    return _polygons([centre + _box_polygon(half, bevel, d) for d in directions], grain=grain)


def surface(points: npt.ArrayLike, *, crease: float = 180.0) -> Mesh:
    """Return the smooth sheet through a grid of points, shape (rows, columns, 3).

    It faces (along columns) x (along rows); u runs along columns and v along rows, both over
    [0, 1]. A grid whose last row or column repeats the first closes, and is smooth across the
    seam; a row of one repeated point is a pole.

    Parameters
    ----------
    points
        Positions, shape (rows, columns, 3).
    crease
        Rows across which the sheet bends by more than this angle, in degrees, stay sharp.
    """
    grid = np.asarray(points, dtype=float)
    cuts = [0, *_sharp_rows(grid, crease).tolist(), len(grid) - 1]
    return join(*(_smooth_sheet(grid[a : b + 1]) for a, b in itertools.pairwise(cuts)))


def sheet(x: Array, y: Array, z: Array, *, crease: float = 180.0) -> Mesh:
    """Return the `surface` through points whose coordinates broadcast to (rows, columns)."""
    return surface(np.stack(np.broadcast_arrays(x, y, z), axis=-1), crease=crease)


def circle(segments: int) -> Array:
    """Return points on the unit circle, shape (segments + 1, 2), the last equal to the first."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    angle[-1] = 0.0
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def revolve(profile: npt.ArrayLike, *, segments: int = 48, crease: float = 50.0) -> Mesh:
    """Return the surface that a profile of (radius, height) sweeps about the z axis.

    A profile that runs upwards outside, or from the axis to the axis, faces outwards.
    """
    radius, height = np.asarray(profile, dtype=float).T
    x, y = radius[:, None] * circle(segments).T[:, None]
    return sheet(x, y, height[:, None], crease=crease)


def ring(
    radius: float, height: float, *, wire: tuple[float, float], sides: int, segments: int = 48
) -> Mesh:
    """Return a torus about the z axis, whose wire has `sides` sides and is an ellipse.

    Parameters
    ----------
    radius, height
        Of the middle of the wire, in metres.
    wire
        Half the width and half the height of the wire, in metres.
    sides, segments
        Corners around the wire and around the z axis.
    """
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    outline = np.asarray(wire) * np.column_stack([np.cos(turn), np.sin(turn)])
    return revolve(np.add(outline, [radius, height]), segments=segments, crease=180.0)


def ball(radius: float, *, rows: int = 16, segments: int = 32) -> Mesh:
    """Return a sphere about the origin."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    profile = radius * np.column_stack([np.cos(turn).round(12), np.sin(turn)])
    return revolve(profile, segments=segments)


def tube(path: npt.ArrayLike, radius: float, *, segments: int = 16) -> Mesh:
    """Return a round pipe with flat ends about a path of points, shape (n, 3)."""
    centres = np.asarray(path, dtype=float)
    tangents = _unit(np.gradient(centres, axis=0))
    side = np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()])
    rings = []
    for centre, tangent in zip(centres, tangents, strict=True):
        # Carried along and made perpendicular again, the frame does not twist.
        side = _unit(side - tangent * (side @ tangent))
        frame = np.stack([side, np.cross(tangent, side)])
        rings.append(centre + radius * circle(segments) @ frame)
    caps = np.broadcast_to(centres[[0, -1], None], (2, segments + 1, 3))
    return surface(np.concatenate([caps[:1], rings, caps[1:]]), crease=50.0)


def loft(outlines: Sequence[Array], heights: Sequence[float], *, crease: float = 50.0) -> Mesh:
    """Return the surface through closed outlines, each shape (n, 2), at heights from first to last.

    The first and the last outline are filled by fans about their centres.
    """
    rings = [_at_height(outline, z) for outline, z in zip(outlines, heights, strict=True)]
    first, last = (np.broadcast_to(r[:-1].mean(axis=0), r.shape) for r in (rings[0], rings[-1]))
    return surface(np.stack([first, *rings, last]), crease=crease)


def rounded_rectangle(width: float, depth: float, radius: float, *, arc: int = 8) -> Array:
    """Return a closed outline about the origin, counterclockwise, shape (4 `arc` + 5, 2)."""
    turn = np.linspace(0, np.pi / 2, arc + 1)
    half = np.array([width, depth]) / 2 - radius
    corners = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    arcs = [
        half * corner + radius * np.column_stack([np.cos(turn + start), np.sin(turn + start)])
        for corner, start in zip(corners, np.pi / 2 * np.arange(4), strict=True)
    ]
    return np.concatenate([*arcs, arcs[0][:1]])


def tiles(
    columns: int,
    rows: int,
    *,
    size: tuple[float, float],
    gap: float,
    depth: float,
    stagger: float = 0.0,
) -> Mesh:
    """Return bevelled tiles on the plane z = 0, from the origin along +x and +y, facing +z.

    Each tile's uv are one point, the centre of its cell in an image of `rows` x `columns` pixels,
    so such an image gives every tile its own colour.

    Parameters
    ----------
    columns, rows
        How many tiles.
    size
        Width and height of one cell, joint included, in metres.
    gap, depth
        Width of the joint and height of the tile above it, in metres.
    stagger
        Shift of every other row, as a fraction of the width; tiles at its ends are cut.
    """
    row, column = (i.ravel() for i in np.mgrid[0:rows, 0 : columns + bool(stagger)])
    left = (column - (row % 2) * stagger) * size[0]
    right = np.minimum(left + size[0], columns * size[0])
    left = np.maximum(left, 0.0)
    kept = right - left > 2 * (gap + depth)
    row, column, left, right = (a[kept] for a in (row, column, left, right))
    low = np.stack([left, row * size[1]], axis=-1) + gap / 2
    high = np.stack([right, (row + 1) * size[1]], axis=-1) - gap / 2
    centre = (np.stack([column % columns, row], axis=-1) + 0.5) / [columns, rows]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    foot = low[:, None] + corners * (high - low)[:, None]
    top = foot + depth * (1 - 2 * corners)
    vertices = np.concatenate([_at_height(foot, 0.0), _at_height(top, depth)], axis=1)
    sides = [[k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    quads = vertices[:, [*sides, [4, 5, 6, 7]]].reshape(-1, 4, 3)
    index = 4 * np.arange(len(quads))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(quads.reshape(-1, 3), index.reshape(-1, 3), np.repeat(centre, 20, axis=0))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _at_height(points: Array, z: float) -> Array:
    return np.concatenate([points, np.full((*points.shape[:-1], 1), z)], axis=-1)


def _smooth_sheet(grid: Array) -> Mesh:
    rows, columns = grid.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    below, above = index[:-1], index[1:]
    a, b, c, d = (i.ravel() for i in (below[:, :-1], below[:, 1:], above[:, 1:], above[:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    mesh = Mesh(grid.reshape(-1, 3), faces, np.stack([u.ravel(), v.ravel()], axis=-1))
    # At a pole one triangle of each quadrilateral has no area.
    mesh = replace(mesh, faces=faces[np.linalg.norm(mesh.face_normals, axis=-1) > 1e-12])
    return replace(mesh, normals=_smooth_normals(mesh))


def _smooth_normals(mesh: Mesh) -> Array:
    """Sum the face normals at every position, weighted by the angle that a face has there.

    Vertices that share a position share the normal, so seams and poles are smooth; weights by
    angle, unlike by area, do not depend on how the surface is cut into triangles (Thuermer and
    Wuethrich 1998).
    """
    _, position = np.unique(mesh.vertices.round(7), axis=0, return_inverse=True)
    corners = mesh.vertices[mesh.faces]
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    behind = -np.roll(ahead, 1, axis=1)
    angle = np.arccos(np.clip((ahead * behind).sum(axis=-1), -1, 1))
    total = np.zeros((position.max() + 1, 3))
    weighted = angle[..., None] * _unit(mesh.face_normals)[:, None]
    np.add.at(total, position.ravel()[mesh.faces], weighted)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    # A position in no face needs some unit normal, too.
    normals = np.where(length > 0, total / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    return np.asarray(normals[position.ravel()])


def _sharp_rows(grid: Array, crease: float) -> npt.NDArray[np.int64]:
    """Return the inner rows across which the sheet bends by more than `crease` degrees."""
    along, across = np.diff(grid, axis=0), np.diff(grid, axis=1)
    # All columns bend alike where a crease is meant, so the first stands for them.
    local = np.cross(across[:-1, 0] + across[1:, 0], along[:, 0] + along[:, 1])
    length = np.linalg.norm(local, axis=-1)
    cosine = (local[:-1] * local[1:]).sum(axis=-1) / np.maximum(length[:-1] * length[1:], 1e-30)
    return np.flatnonzero(cosine < np.cos(np.deg2rad(crease))) + 1


def _box_polygon(half: Array, bevel: float, direction: npt.NDArray[np.int64]) -> Array:
    """Return the part of a cut box that faces a direction of signs, counterclockwise."""
    axes = np.flatnonzero(direction)
    free = [(d,) if d else (-1, 1) for d in direction.tolist()]
    # A corner of the box is three points: the k-th lies at full height on axis k.
    points = np.array(
        [
            corner * np.where(np.arange(3) == axis, half, half - bevel)
            for corner in itertools.product(*free)
            for axis in axes
        ]
    )
    middle = points.mean(axis=0)
    first = points[0] - middle
    second = np.cross(direction, first)
    height = (points - middle) @ second / np.linalg.norm(direction)
    angle = np.arctan2(height, (points - middle) @ first)
    return np.asarray(points[np.argsort(angle.round(6))])


def _polygons(polygons: Sequence[Array], *, grain: Literal["x", "y", "z"]) -> Mesh:
    """Return convex polygons as one flat mesh, with uv in metres and u along `grain`."""
    vertices, faces, uv = [], [], []
    start = 0
    for corners in polygons:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        plane = [k for k in range(3) if k != np.abs(normal).argmax()]
        plane.sort(key=lambda k: "xyz"[k] != grain)
        vertices.append(corners)
        uv.append(corners[:, plane])
        faces += [[start, start + k, start + k + 1] for k in range(1, len(corners) - 1)]
        start += len(corners)
    return Mesh(np.concatenate(vertices), np.array(faces), np.concatenate(uv))
