"""Path guiding: densities are what is drawn, nothing is biased, a guide belongs to its samples."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import RenderError, StoreError
from chdstat.rendering import guiding, render_batches, render_pixels
from chdstat.rendering.backend import activate, resolve
from chdstat.rendering.guiding import Guide, Lookup, Paths, learn, uniform
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.workers import render_remote
from chdstat.samples.store import Store
from chdstat.samples.tiles import chunk_grid

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


BALL, RADIUS = np.array([0.5, 0.5, 2.0]), 0.1
CUBE = uniform((0, 0, 0), (1, 1, 1)).box


def far(rng, n):
    """Return paths of far light: from one octant in a half of space, from all in the other."""
    positions, w = rng.random((n, 3)), directions(rng, n)
    light = np.where(positions[:, 0] < 0.5, np.all(w > 0, axis=1), 1.0)
    return Paths(positions, w, light, np.full(n, np.inf))


def near(rng, n):
    """Return paths of light from a ball near by, each weighted for the density of uniform ones."""
    positions, w = rng.random((n, 3)), directions(rng, n)
    w[: n // 2] = BALL + RADIUS * w[: n // 2] - positions[: n // 2]
    distance = np.linalg.norm(w, axis=1)
    w /= distance[:, np.newaxis]
    return Paths(positions, w, hits(positions, w), np.where(distance > 1.01, distance, 3.0))


def hits(positions, w):
    along = ((BALL - positions) * w).sum(axis=1)
    beside = np.linalg.norm(BALL - positions - along[:, np.newaxis] * w, axis=1)
    return np.where((along > 0) & (beside < RADIUS), 1.0, 0.0)


@pytest.fixture(scope="module", params=[far, near])
def guide(request):
    return learn(CUBE, request.param(np.random.default_rng(0), 100_000))


def density_of(backend, guide, positions, w):
    """Return densities relative to that of all directions alike."""
    with activate(resolve(backend)) as mi:
        lookup = Lookup(mi, guide)
        place = lookup.place(mi.Point3f(np.transpose(positions)))
        return np.array(lookup.density(place, mi.Vector3f(w.T)), float) * 4 * np.pi


def test_a_guide_is_a_density_everywhere(wavefront, guide):
    rng = np.random.default_rng(1)
    positions, w = rng.random((400_000, 3)), directions(rng, 400_000)
    assert density_of(wavefront, uniform((0, 0, 0), (1, 1, 1)), positions, w) == pytest.approx(1)
    density = density_of(wavefront, guide, positions, w)
    assert density.mean() == pytest.approx(1, abs=5 * density.std() / 400_000**0.5)


def test_it_follows_far_light(wavefront):
    guide = learn(CUBE, far(np.random.default_rng(0), 100_000))
    w = directions(np.random.default_rng(1), 200_000)
    for x, inside in ((0.2, 0.9 + 0.1 / 8), (0.8, 1 / 8)):
        density = density_of(wavefront, guide, np.tile([x, 0.5, 0.5], (len(w), 1)), w)
        # The standard error is .001 of one octant's share.
        assert np.mean(density * np.all(w > 0, axis=1)) == pytest.approx(inside, abs=0.03)


def test_all_positions_of_a_cell_look_at_light_near_by(wavefront):
    """A ball fills .1 % of the sphere; without parallax, the 12 directions of a cell would."""
    paths = near(np.random.default_rng(0), 100_000)
    guide = learn(CUBE, paths)
    without = learn(CUBE, paths._replace(distances=np.full(100_000, np.inf)))
    positions = np.random.default_rng(1).random((20_000, 3))
    w = (BALL - positions) / np.linalg.norm(BALL - positions, axis=1, keepdims=True)
    one, other = (density_of(wavefront, g, positions, w).mean() for g in (guide, without))
    assert one > 2 * other


def test_what_is_stored_is_the_guide(guide):
    again = Guide.of_arrays(guide.arrays)
    assert again.digest == guide.digest
    assert replace(guide, nearness=guide.nearness + 1).digest != guide.digest


def test_drawn_directions_have_the_density_that_is_said(wavefront, guide):
    """The inverse density of what is drawn integrates to the sphere."""
    with activate(resolve(wavefront)) as mi:
        lookup = Lookup(mi, guide)
        place = lookup.place(mi.Point3f(0.2, 0.6, 0.3))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(5, 200_000)
        drawn = lookup.sample(place, sampler.next_2d())
        density, w = np.array(lookup.density(place, drawn)), np.array(drawn).T
    for part, angle in ((w[:, 2] > 0.5, np.pi), (w[:, 2] <= 0.5, 3 * np.pi)):
        error = float((part / density).std()) / len(w) ** 0.5
        assert np.mean(part / density) == pytest.approx(angle, abs=4 * error)


def test_only_diffuse_parts_are_guided(wavefront):
    materials = {"diffuse": True, "roughplastic": True, "roughconductor": False, "conductor": False}
    spheres = {kind: {"type": "sphere", "material": {"type": kind}} for kind in materials}
    with activate(resolve(wavefront)) as mi:
        scene = mi.load_dict({"type": "scene", **spheres})
        guiding.into_scene(mi, scene, uniform((0, 0, 0), (1, 1, 1)))
        found = {s.id(): type(s.bsdf()).__name__ == "Guided" for s in scene.shapes()}
    assert found == materials


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


def test_guiding_needs_a_wavefront(wavefront):
    with pytest.raises(RenderError, match="guided.*llvm and cuda"):
        render_pixels(ROOM, [(0, 0)], integrator="guided")
    found = render_pixels(ROOM, [(6, 6)], spp=16, integrator="guided", backend=wavefront)
    assert found.shape == (1, 3, 16)
    short = chd.render(
        ROOM, integrator={"type": "guided", "max_depth": 2}, spp=4, backend=wavefront
    )
    assert short.attrs["integrator"]["max_depth"] == 2


def test_a_worker_draws_the_same_samples(wavefront):
    """The guide travels with the job, and is no other job's."""
    job = Job.of(ROOM, spp=4, integrator="guided", backend=wavefront)
    (chunk,) = chunk_grid(12, 12, 4)
    with activate(job.backend):
        renderer = MitsubaRenderer(job)
        sent = pickle.loads(pickle.dumps(renderer.job))
        assert sent.guide.digest == renderer.provenance["guide"]
        samples = {}
        for name, guide in (("guided", sent.guide), ("plain", guiding.NOTHING)):
            of_worker = replace(sent, guide=guide)
            ((_, samples[name]),) = render_remote(
                of_worker, renderer.identity, None, (chunk, [chunk])
            )
        assert np.array_equal(samples["guided"], renderer.chunk(chunk))
    assert np.array_equal(samples["plain"], chd.render(ROOM, spp=4, backend=wavefront).read())


def test_auto_guides_only_where_it_pays(wavefront, tmp_path, monkeypatch):
    """Without its tray, nothing hides the lamp, and light is sampled well."""
    monkeypatch.setattr(guiding, "FEW", 0)
    lit = {name: value for name, value in ROOM.items() if name != "tray"}
    out, view = tmp_path / "lit.zarr", VIEW | {"backend": wavefront}
    plain = chd.render(lit, **view).read()
    auto = chd.render(lit, integrator="auto", out=out, **view | {"spp": 32})
    assert auto.attrs["guide"] is None
    for integrator in ("auto", None):  # either goes on
        spp = 48 if integrator else 64
        auto = chd.render(lit, integrator=integrator, out=out, **view | {"spp": spp})
    assert np.array_equal(auto.read(), plain)
    by_scalar = [
        render_pixels(ROOM, [(1, 1)], spp=4, integrator=i, backend="scalar") for i in ("auto", None)
    ]
    assert np.array_equal(*by_scalar)


def test_auto_is_guided_where_that_pays(wavefront, monkeypatch):
    """The guide of the room takes the variance to .75 of what it is."""
    monkeypatch.setattr(guiding, "WORTH", 0.95)
    few = chd.render(ROOM, integrator="auto", spp=4, backend=wavefront)
    assert few.attrs["guide"] is None  # a training would cost more than it can gain
    monkeypatch.setattr(guiding, "FEW", 0)
    auto, guided = (
        chd.render(ROOM, integrator=i, spp=4, backend=wavefront) for i in ("auto", "guided")
    )
    assert auto.attrs["guide"] == guided.attrs["guide"]
    assert np.array_equal(auto.read(), guided.read())
