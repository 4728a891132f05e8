from __future__ import annotations

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.scenes.props import shapes
from chdstat.scenes.scene import rotate, translate

# Known answers are volumes and areas from elementary geometry. Round shapes are inscribed polygons:
# n segments fall short of a circle's area by the factor sin(2 pi / n) / (2 pi / n).


def polygon_area(n: int) -> float:
    """Area of the regular n-gon in the unit circle."""
    return n / 2 * np.sin(2 * np.pi / n)


def sphere(segments: int = 48) -> shapes.Mesh:
    return shapes.ball(1.0, rows=segments // 2, segments=segments)


def outline_loft() -> shapes.Mesh:
    outline = shapes.rounded_rectangle(2.0, 1.0, 0.2, arc=32)
    return shapes.loft([outline, outline], [0.0, 0.7])


CLOSED = {
    "box": (lambda: shapes.box((0, 0, 0), (1, 2, 3)), 6.0),
    # A cut of b off twelve edges of lengths 1 - 2b, 2 - 2b, 3 - 2b, and eight corners of 5/6 b^3.
    "cut box": (
        lambda: shapes.box((0, 0, 0), (1, 2, 3), bevel=0.1),
        6.0 - 4 * 0.1**2 / 2 * (6 - 6 * 0.1) - 8 * 5 / 6 * 0.1**3,
    ),
    "cylinder": (
        lambda: shapes.revolve([(0, 0), (2, 0), (2, 3), (0, 3)], segments=32),
        4 * 3 * polygon_area(32),
    ),
    "cone": (lambda: shapes.revolve([(0, 0), (1, 0), (0, 3)], segments=32), polygon_area(32)),
    "pipe": (
        lambda: shapes.tube([(0, 0, 0), (0, 1, 0), (0, 2, 0)], 0.5, segments=16),
        2 * 0.25 * polygon_area(16),
    ),
    "loft": (outline_loft, 0.7 * (2.0 - (4 - 32 * 4 / 2 * np.sin(np.pi / 64)) * 0.2**2)),
}


def edges(mesh: shapes.Mesh) -> list[tuple[int, int]]:
    """Directed edges between positions, so that seams and creases are joined."""
    _, position = np.unique(mesh.vertices.round(7), axis=0, return_inverse=True)
    faces = position.ravel()[mesh.faces]
    return [tuple(edge) for face in faces.tolist() for edge in zip(face, np.roll(face, -1))]  # noqa: B905


@pytest.mark.parametrize("name", CLOSED)
def test_volume_is_the_analytic_one(name):
    build, volume = CLOSED[name]
    assert build().volume == pytest.approx(volume, rel=1e-9)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_wind_consistently(name):
    found = edges(CLOSED[name][0]())
    assert len(set(found)) == len(found)
    assert {(b, a) for a, b in found} == set(found)


def test_an_open_sheet_is_told_from_a_closed_shape():
    found = edges(shapes.quad((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    assert {(b, a) for a, b in found} != set(found)


def test_sphere_normals_point_along_the_radius():
    mesh = sphere()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(mesh.normals, mesh.vertices, atol=0.003)


def test_sphere_area_and_volume_converge():
    # The error of an inscribed mesh falls with the square of the segments.
    areas = [4 * np.pi - sphere(n).area for n in (24, 48, 96)]
    volumes = [4 * np.pi / 3 - sphere(n).volume for n in (24, 48, 96)]
    np.testing.assert_allclose(np.divide(areas[:-1], areas[1:]), 4.0, rtol=0.02)
    np.testing.assert_allclose(np.divide(volumes[:-1], volumes[1:]), 4.0, rtol=0.02)


def test_a_crease_keeps_an_edge_sharp():
    profile = [(0, 0), (1, 0), (1, 2), (0, 2)]
    sharp = shapes.revolve(profile, segments=32, crease=50.0)
    smooth = shapes.revolve(profile, segments=32, crease=180.0)
    straight = np.isclose(np.abs(sharp.normals).max(axis=-1), 1.0) | (sharp.normals[:, 2] == 0)
    assert np.abs(sharp.normals[straight, 2]).round(9).tolist().count(0.0) == 2 * 33
    assert not np.isclose(smooth.normals[:, 2], 0.0).any()


def test_moving_keeps_volume_and_turns_normals():
    mesh = sphere(24)
    moved = mesh.moved(translate(1, 2, 3) @ rotate("y", 40.0))
    assert moved.volume == pytest.approx(mesh.volume)
    np.testing.assert_allclose(moved.normals, mesh.normals @ rotate("y", 40.0)[:3, :3].T)


def test_a_bent_pipe_keeps_its_radius_at_every_point_of_its_path():
    turn = np.linspace(0, np.pi, 25)
    path = np.column_stack([np.cos(turn), 0 * turn, np.sin(turn)])
    mesh = shapes.tube(path, 0.1, segments=12)
    distance = np.linalg.norm(mesh.vertices[:, None] - path, axis=-1).min(axis=1)
    assert distance.max() == pytest.approx(0.1)
    assert mesh.volume == pytest.approx(np.pi * 0.01 * polygon_area(12), rel=0.01)


def test_tiles_have_their_size_and_do_not_overlap():
    field = shapes.tiles(4, 3, size=(0.2, 0.1), gap=0.006, depth=0.003)
    assert field.vertices.min(axis=0) == pytest.approx([0.003, 0.003, 0.0])
    assert field.vertices.max(axis=0) == pytest.approx([0.797, 0.297, 0.003])
    # Seen from above, twelve feet of 0.194 by 0.094.
    assert field.face_normals[:, 2].sum() / 2 == pytest.approx(12 * 0.194 * 0.094)
    assert (field.face_normals[:, 2] > 0).all()


def test_staggered_tiles_fill_the_same_rectangle():
    field = shapes.tiles(4, 3, size=(0.2, 0.1), gap=0.006, depth=0.003, stagger=0.5)
    assert field.vertices[:, 0].min() == pytest.approx(0.003)
    assert field.vertices[:, 0].max() == pytest.approx(0.797)
    # The middle row has five tiles, so one joint more.
    feet = 9 * 0.194 + 3 * 0.194 - 0.006
    assert field.face_normals[:, 2].sum() / 2 == pytest.approx(feet * 0.094)


def test_each_tile_points_at_its_own_texture_cell():
    field = shapes.tiles(4, 3, size=(0.2, 0.1), gap=0.006, depth=0.003)
    cells = np.unique((field.uv * [4, 3]).round(6), axis=0)
    expected = np.stack(np.meshgrid(np.arange(4), np.arange(3), indexing="ij"), axis=-1) + 0.5
    np.testing.assert_allclose(cells, expected.reshape(-1, 2))


def test_box_texture_runs_along_the_grain():
    mesh = shapes.box((0, 0, 0), (1, 2, 3), grain="z")
    assert np.ptp(mesh.uv[:, 0]) == pytest.approx(3.0)


def test_joined_meshes_keep_their_parts():
    first, second = shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((5, 0, 0), (6, 2, 2))
    both = shapes.join(first, second)
    assert both.volume == pytest.approx(first.volume + second.volume)
    assert both.faces.max() == len(both.vertices) - 1


@pytest.mark.parametrize(
    ("build", "match"),
    [
        (lambda: shapes.box((0, 0, 0), (1, 1, 0.1), bevel=0.05), "twice its bevel"),
        (lambda: shapes.surface(np.zeros((4, 3))), "points must have shape"),
        (lambda: shapes.join(sphere(8), shapes.quad((0, 0, 0), (1, 0, 0), (0, 1, 0))), "flat"),
    ],
)
def test_impossible_shapes_are_refused(build, match):
    with pytest.raises(InputError, match=match):
        build()
