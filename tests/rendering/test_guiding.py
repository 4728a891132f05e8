"""Path guiding: densities are what is drawn, nothing is biased, a guide belongs to its samples."""

from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import RenderError, StoreError
from chdstat.rendering import render_batches, render_pixels
from chdstat.rendering.backend import activate, resolve
from chdstat.rendering.guiding import Guide, Lookup, Paths, learn, uniform
from chdstat.samples.store import Store

BOX = {"type": "cube"}
ROOM = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 6},
    "sensor": {
        "type": "perspective",
        "fov": 60,
        "to_world": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0.95], [0, 0, 0, 1.0]]),
        "film": {"type": "hdrfilm", "width": 12, "height": 12},
    },
    "room": {**BOX, "flip_normals": True, "bsdf": {"type": "diffuse"}},
    # A lamp in a corner, in a tray that lets it see a part of the ceiling only.
    "lamp": {
        "type": "rectangle",
        "to_world": np.array(
            [[0.05, 0, 0, 0.65], [0, 0, 0.05, -0.95], [0, -0.05, 0, 0.65], [0, 0, 0, 1]]
        ),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 200}},
    },
    "tray": {
        "type": "cylinder",
        "radius": 0.3,
        "p0": [0.65, -1, 0.65],
        "p1": [0.65, -0.5, 0.65],
        "bsdf": {"type": "twosided", "nested": {"type": "diffuse"}},
    },
}
VIEW = {"spp": 64, "progress": False}


def directions(rng, n):
    w = rng.normal(size=(n, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def octant():
    """Return a guide of light from one octant in one half of space, and from all in the other."""
    rng = np.random.default_rng(0)
    positions, w = rng.random((40_000, 3)), directions(rng, 40_000)
    light = np.where(positions[:, 0] < 0.5, np.all(w > 0, axis=1), 1.0)
    density = np.full(40_000, 1 / (4 * np.pi))
    return learn(uniform((0, 0, 0), (1, 1, 1)), Paths(positions, w, light, density), per_cell=9000)


def test_a_guide_is_a_density_that_follows_the_light(octant):
    rng = np.random.default_rng(1)
    w = directions(rng, 200_000)
    for x, inside in ((0.2, 0.9 + 0.1 / 8), (0.8, 1 / 8)):
        cell = octant.cells_at([[x, 0.5, 0.5]])
        density = octant.density(np.repeat(cell, len(w)), w) * 4 * np.pi
        # Standard errors are .006 and .001 of one octant's share.
        assert density.mean() == pytest.approx(1, abs=0.03)
        assert np.mean(density * np.all(w > 0, axis=1)) == pytest.approx(inside, abs=0.03)


def test_what_is_stored_is_the_guide(octant):
    again = Guide.of_arrays(octant.arrays)
    assert again.digest == octant.digest
    assert replace(octant, shares=octant.shares / 2).digest != octant.digest


def test_drawn_directions_have_the_density_that_is_said(wavefront, octant):
    """The inverse density of what is drawn integrates to the sphere."""
    with activate(resolve(wavefront)) as mi:
        lookup = Lookup(mi, octant)
        _, *leaves = lookup.cell(mi.Point3f(0.2, 0.5, 0.5))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(5, 200_000)
        drawn = lookup.sample(leaves, sampler.next_2d())
        density, w = np.array(lookup.density(leaves, drawn)), np.array(drawn).T
    cell = np.repeat(octant.cells_at([[0.2, 0.5, 0.5]]), len(w))
    # Single precision puts a direction into the square beside its own, rarely.
    assert np.isclose(density, octant.density(cell, w), rtol=1e-3).mean() > 0.999
    assert np.mean(np.all(w > 0, axis=1)) == pytest.approx(0.9 + 0.1 / 8, abs=0.005)
    assert np.mean(1 / density) == pytest.approx(4 * np.pi, rel=0.03)


@pytest.fixture(scope="module")
def both(wavefront):
    """Return the room by path tracing, and guided."""
    view = {**VIEW, "backend": wavefront, "spp": 512}
    return chd.render(ROOM, seed=1, **view), chd.render(ROOM, integrator="guided", seed=2, **view)


def test_it_is_less_noisy_and_not_biased(both):
    plain, guided = (samples.read().mean(axis=2).astype(np.float64) for samples in both)
    error = np.hypot(*(x.mean(axis=(0, 1)).std(ddof=1) / 512**0.5 for x in (plain, guided)))
    assert abs(plain.mean() - guided.mean()) < 3 * error
    assert chd.contrast(*both).outcome == "no difference found"
    assert guided.var(axis=-1).mean() < 0.7 * plain.var(axis=-1).mean()


def test_a_guide_stays_with_its_samples(wavefront, tmp_path):
    out, settings = tmp_path / "room.zarr", {**VIEW, "backend": wavefront, "integrator": "guided"}
    some = chd.render(ROOM, out=out, **settings)
    x = some.read()
    assert "guide-cells" not in some.features
    more = chd.render(ROOM, out=out, **settings | {"spp": 128})
    assert np.array_equal(more.read()[..., :64], x)
    batches = render_batches(ROOM, **settings)
    assert np.array_equal(np.concatenate(list(batches), axis=-1), x)
    with pytest.raises(StoreError, match="guide: stored"):
        chd.render(ROOM, out=out, **settings | {"spp": 256, "integrator": None})
    # Where the guide is damaged, the same training makes it again.
    (file,) = out.glob("features/guide-cells/c/*/*")
    file.write_bytes(b"")
    assert Store.open(out).guide() is None
    again = chd.render(ROOM, out=out, **settings | {"spp": 192})
    assert np.array_equal(again.read()[..., :64], x)
    assert Store.open(out).guide() is not None


def test_it_needs_a_backend_of_wavefronts_and_a_scene_of_its_own(wavefront):
    with pytest.raises(RenderError, match="guided.*llvm and cuda.*doctor"):
        render_pixels(ROOM, [(0, 0)], integrator="guided")
    found = render_pixels(ROOM, [(6, 6)], spp=16, integrator="guided", backend=wavefront)
    assert found.shape == (1, 3, 16)
    short = chd.render(
        ROOM, integrator={"type": "guided", "max_depth": 2}, spp=4, backend=wavefront
    )
    assert short.attrs["integrator"]["max_depth"] == 2
