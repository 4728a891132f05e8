"""Path guiding: densities are what is drawn, nothing is biased, a guide belongs to its samples."""

import pickle
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import RenderError, StoreError
from chdstat.rendering import guiding, render_batches, render_pixels
from chdstat.rendering.backend import activate, resolve
from chdstat.rendering.guiding import Guide, Lookup, Paths, learn, uniform
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.workers import render_remote
from chdstat.samples import layout
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


UP = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
"""Normal of the surfaces that the tests below draw from."""


def lookup_and_place(mi, guide, positions, normals):
    lookup = Lookup(mi, guide)
    vectors = (mi.Vector3f(np.transpose(np.atleast_2d(x))) for x in (positions, normals))
    return lookup, lookup.at(*vectors)


def taught(mi, rng, n, light):
    """Return what a guide learns from directions of diffuse surfaces in a cube."""
    positions, w = rng.random((n, 3)), directions(rng, n)
    w = w + UP
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    lookup, of = lookup_and_place(mi, uniform((0, 0, 0), (1, 1, 1)), positions, np.tile(UP, (n, 1)))
    bins = np.array(lookup.bin(of, mi.Vector3f(w.T)))
    places, nothing = np.array(of.code)[np.newaxis], np.zeros((1, n), np.float32)
    found = np.float32(light(positions, w))
    return learn(CUBE, Paths(places, bins[np.newaxis], nothing + 1, nothing, nothing, found))


CUBE = uniform((0, 0, 0), (1, 1, 1)).box


def octant(positions, w):
    """Light from one octant in a half of space, and from everywhere in the other."""
    return np.where(positions[:, 0] < 0.5, np.all(w > 0, axis=1), 1.0)


@pytest.fixture(scope="module")
def guide(wavefront):
    with activate(resolve(wavefront)) as mi:
        return taught(mi, np.random.default_rng(0), 100_000, octant)


@pytest.mark.parametrize("position", [(0.2, 0.6, 0.3), (0.9, 0.1, 0.5)])
@pytest.mark.parametrize("normal", [UP, (0, 0, -1), (-0.6, 0, 0.8), (1, 0, 0)])
def test_all_its_directions_are_above_the_surface(wavefront, guide, position, normal):
    rng = np.random.default_rng(1)
    n, w = 400_000, directions(rng, 400_000)
    with activate(resolve(wavefront)) as mi:
        lookup, of = lookup_and_place(mi, guide, position, normal)
        density = np.array(lookup.density(of, mi.Vector3f(w.T)), float) * 4 * np.pi
    assert not density[w @ np.array(normal) < 0].any()
    assert density.mean() == pytest.approx(1, abs=5 * density.std() / n**0.5)


def test_drawn_directions_have_the_density_that_is_said(wavefront, guide):
    """Chi-square over parts of the square; it fails by accident in one case of 10,000."""
    with activate(resolve(wavefront)) as mi:
        lookup, of = lookup_and_place(mi, guide, (0.2, 0.6, 0.3), UP)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(5, 200_000)
        drawn = lookup.sample(of, sampler.next_2d())
        counts = np.bincount(np.array(lookup.bin(of, drawn)), minlength=guide.chances.shape[1])
        cell = int(np.array(dr.gather(mi.UInt32, lookup.cells, of.code))[0])
        shares = guide.chances.ravel()[cell : cell + counts.size] / guide.chances[0].sum()
        density, w = np.array(lookup.density(of, drawn), float), np.array(drawn).T
    assert stats.chisquare(counts[shares > 0], 200_000 * shares[shares > 0]).pvalue > 1e-4
    # The mean of f over the density is the integral of f: here, of the cosine where light is.
    lit = np.all(w > 0.1, axis=1) * (w @ UP)
    reference = directions(np.random.default_rng(2), 1_000_000)
    expected = 4 * np.pi * np.mean(np.all(reference > 0.1, axis=1) * (reference @ UP))
    error = float((lit / density).std()) / len(w) ** 0.5
    assert np.mean(lit / density) == pytest.approx(expected, abs=4 * error + 0.005)


def test_without_knowledge_it_draws_like_a_diffuse_surface(wavefront):
    with activate(resolve(wavefront)) as mi:
        guide = uniform((0, 0, 0), (1, 1, 1))
        lookup, of = lookup_and_place(mi, guide, (0.2, 0.6, 0.3), UP)
        w = directions(np.random.default_rng(1), 10_000)
        density = np.array(lookup.density(of, mi.Vector3f(w.T)))
    assert density == pytest.approx(np.maximum(w @ UP, 0) / np.pi, abs=1e-5)


def test_it_learns_where_light_comes_from(wavefront, guide):
    """Each half of space has its own light; few directions are left to the BSDF alone."""
    w = directions(np.random.default_rng(1), 200_000)
    diffuse = np.maximum(w @ UP, 0) * 4
    of_octant = np.mean(diffuse * np.all(w > 0, axis=1))
    for x, low, high in ((0.2, 0.9, 1.0), (0.8, of_octant - 0.03, of_octant + 0.03)):
        with activate(resolve(wavefront)) as mi:
            lookup, of = lookup_and_place(mi, guide, (x, 0.5, 0.5), UP)
            density = np.array(lookup.density(of, mi.Vector3f(w.T)), float) * 4 * np.pi
        assert low < np.mean(density * np.all(w > 0, axis=1)) < high


def test_it_finds_a_small_light(wavefront):
    """A disk fills .2 % of the hemisphere; a bin and those around it are 1.6 %."""

    def small(_, w):
        return (w @ UP > 0.998).astype(float)

    with activate(resolve(wavefront)) as mi:
        found = taught(mi, np.random.default_rng(0), 200_000, small)
        lookup, of = lookup_and_place(mi, found, (0.4, 0.6, 0.3), UP)
        density = float(np.array(lookup.density(of, mi.Vector3f(*UP.tolist())))[0])
    assert density * np.pi > 20  # times that of a diffuse surface


def test_the_mean_near_a_vertex_stands_for_what_one_path_found(wavefront):
    """One of 1000 paths finds all of the light, behind a wall that all of them see alike."""
    rng, n = np.random.default_rng(0), 100_000
    places, bins = np.zeros((2, n), np.uint32), np.zeros((2, n), np.uint32)
    bins[0] = rng.integers(guiding._BINS, size=n)
    one, nothing = np.ones((2, n), np.float32), np.zeros((2, n), np.float32)
    found = np.where(rng.random(n) < 1e-3, np.float32(1000), np.float32(0))
    guide = learn(CUBE, Paths(places, bins, one, nothing, nothing, found))
    assert np.ptp(guide.chances[0]) <= 2


def test_what_is_stored_is_the_guide(guide):
    again = Guide.of_arrays(guide.arrays)
    assert again.digest == guide.digest
    assert replace(guide, box=guide.box + 1).digest != guide.digest


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


def test_a_guide_stays_with_its_samples(wavefront, tmp_path, monkeypatch):
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
    with monkeypatch.context() as earlier:
        earlier.setattr(layout, "FORMER_GUIDE", "guide-cells")
        with pytest.raises(StoreError, match="earlier chdstat.*new store"):
            chd.render(ROOM, out=out, **settings | {"spp": 256})
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
    """A guide never takes the variance to a hundredth."""
    monkeypatch.setattr(guiding, "FEW", 0)
    monkeypatch.setattr(guiding, "WORTH", 0.01)
    out, view = tmp_path / "lit.zarr", VIEW | {"backend": wavefront}
    plain = chd.render(ROOM, **view).read()
    auto = chd.render(ROOM, integrator="auto", out=out, **view | {"spp": 32})
    assert auto.attrs["guide"] is None
    for integrator in ("auto", None):  # either goes on
        spp = 48 if integrator else 64
        auto = chd.render(ROOM, integrator=integrator, out=out, **view | {"spp": spp})
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
