"""Where samples fall: a ramp that shines with its place tells it, whatever draws the samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.work import client_of
from chdstat.errors import InputError, InputWarning
from chdstat.patterns import film_split
from chdstat.patterns.film_splits import split_by_place
from chdstat.recording import DrawnPass
from chdstat.samples import inspect
from chdstat.samples.store import Store
from tests.stops import stopped

W, H = 70, 66
STEP = 1 / 16


def ramp(*, step: bool = False) -> dict[str, Any]:
    """Return a scene whose radiance is the place on the image: x in red, y in green.

    With `step`, it is 1 from the middle of each pixel on, and 0 before.
    """
    corners = np.zeros((2, 2, 3), np.float32)
    corners[:, 1, 0] = corners[1, :, 1] = 1
    light = {"type": "bitmap", "data": corners, "filter_type": "bilinear"}
    if step:
        stripes = np.zeros((1, 2 * W, 3), np.float32)
        stripes[:, 1::2] = 1
        light = {"type": "bitmap", "data": stripes, "filter_type": "nearest"}
    light |= {"raw": True, "wrap_mode": "clamp", "format": "variant"}
    look = np.diag([-1.0, 1, -1, 1])
    look[2, 3] = 1
    size = 1.0 if step else 2.0
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": {"type": "orthographic", "to_world": look},
        "square": {
            "type": "rectangle",
            "to_world": np.diag([size, size, 1.0, 1.0]),
            "emitter": {"type": "area", "radiance": light},
        },
    }


def render(scene: Any = None, **options: Any) -> chd.Samples:
    scene = ramp() if scene is None else scene
    given = {"size": (W, H), "spp": 16, "film": True, "seed": 3, "progress": False} | options
    return chd.render(scene, **given)


def film_of(samples: chd.Samples) -> np.ndarray:
    assert samples.film is not None
    return samples.film.read()


@pytest.mark.parametrize("crop", [None, (5, 1, 65, 64)])
@pytest.mark.parametrize("sampler", ["independent", "stratified"])
def test_light_that_tells_its_place_agrees_with_the_film(backend, sampler, crop):
    samples = render(backend=backend, sampler=sampler, crop=crop)
    left, top = (crop or (0, 0))[:2]
    height, width = samples.shape[:2]
    x, y = samples.read()[:, :, :2].transpose(2, 0, 1, 3)
    places = [
        W * x - np.arange(left, left + width)[:, np.newaxis],
        H / 2 + W * (0.5 - y) - np.arange(top, top + height)[:, np.newaxis, np.newaxis],
    ]
    found = film_of(samples)
    assert found.shape == (height, width, 2, 16)
    assert np.abs(found - np.stack(places, axis=2)).max() < 0.51 * STEP


def test_it_changes_no_sample_and_repeats_to_the_bit(backend):
    scene: dict[str, Any] = {"scene": "cornell-box", "size": (9, 7), "backend": backend}
    with_film = render(**scene)
    assert (with_film.read() == render(**scene, film=False).read()).all()
    assert (film_of(with_film) == film_of(render(**scene))).all()
    assert with_film.depths == {}
    assert render(**scene, film=False).film is None


def test_stores_keep_it_and_go_on_with_it(tmp_path):
    at = {"out": tmp_path / "a.zarr", "size": (70, 3), "backend": "scalar"}
    with stopped(Store, "write", 3):
        render(**at)
    render(**at)
    more = render(**at, spp=96, film=False)
    assert (film_of(more) == film_of(render(**at | {"out": None}, spp=96))).all()
    found = chd.open(tmp_path / "a.zarr")
    assert found.film.shape == (3, 70, 2, 96)
    assert found.isel(y=slice(2, 4), sample=slice(5)).film.shape == (1, 70, 2, 5)
    told = inspect(tmp_path / "a.zarr", verify=True)
    assert (told["film_spp"], told["damaged"]) == (96, [])


def test_adaptive_samples_fall_where_their_light_tells(backend):
    samples = render(backend=backend, adaptive=True, size=(12, 10), spp=24)
    x, film = samples.read()[:, :, 0], film_of(samples)[:, :, 0]
    places = 12 * x - np.arange(12)[:, np.newaxis]
    assert samples.unequal
    assert (np.isnan(x) == np.isnan(film)).all()
    assert np.nanmax(np.abs(film - places)) < 0.51 * STEP


# --- the split of the variance ------------------------------------------------------------------

RADIANCE = {
    "constant": (lambda x, _: np.zeros_like(x), 0.0),
    "ramp": (lambda x, _: x, (1 - 1 / 64) / 12),
    "step edge": (lambda x, _: 1.0 * (x > 0.5), 0.25),
    "corner": (lambda x, y: 1.0 * ((x > 0.5) & (y > 0.5)), 3 / 16),
}


@pytest.mark.parametrize("kind", RADIANCE)
def test_the_split_of_known_pixels(kind):
    """Mean of 1,000 pixels within 4.5 standard errors: fails by chance in 1 of 100,000."""
    of_place, between = RADIANCE[kind]
    rng = np.random.default_rng(7)
    places = rng.random((1000, 2, 1024))
    noise = (rng.gamma(0.3, size=(1000, 1024)) / 0.3 - 1) * np.sqrt(0.3)
    x = of_place(places[:, 0], places[:, 1]) + noise
    found = split_by_place(x, places, 8)
    error = found.places.std() / np.sqrt(1000)
    assert abs(found.places.mean() - between) < 4.5 * error
    within = {"ramp": 1 + 1 / 64 / 12}.get(kind, 1.0)
    assert abs(found.paths.mean() - within) < 4.5 * found.paths.std() / np.sqrt(1000)
    assert 1 < found.places_error.mean() / found.places.std() < 2.5  # never too small


@pytest.mark.parametrize(("spp", "k"), [(12, 2), (32, 4), (64, 2), (256, 4)])
@pytest.mark.parametrize("sigma", [0.0, 1.5])
def test_two_errors_hold_what_strata_take_of_few_samples_and_of_long_tails(spp, k, sigma):
    """An edge in 4,000 pixels, also where cells hold fewer than two samples.

    The mean is off by chance in 1 of 100,000; 88 to 96 % of the intervals hold in 2,000 others.
    """
    rng = np.random.default_rng(9)
    places = rng.random((4000, 2, spp))
    noise = rng.lognormal(0, sigma, (4000, spp)) if sigma else rng.normal(size=(4000, spp)) / 2
    found = split_by_place((places[:, 1] > 0.5) + noise, places, k)
    known = found.reason == 0
    assert known.mean() > 0.95
    of_places = found.places[known]
    off = of_places - 0.25
    assert abs(off.mean()) < 4.5 * of_places.std() / len(off) ** 0.5
    assert (np.abs(off) < 2 * found.places_error[known]).mean() > 0.86


def test_of_a_step_within_pixels_all_variance_is_between_places(backend):
    samples = render(ramp(step=True), size=(W, 4), spp=256, backend=backend)
    found = film_split(samples)
    assert found.attrs["cells"] == 4
    # Where the texture's edge is rounded, a sample may be on the wrong side.
    assert np.abs(found["places"] - 0.25).max() < 0.02
    assert (found["paths"] < 1e-6).mean() > 0.9


def test_what_cannot_be_split_says_why():
    dark = np.zeros((2, 2, 1, 64))
    with pytest.raises(InputError, match="film=True"):
        film_split(chd.Samples.from_array(dark))
    with pytest.raises(InputError, match="512 samples"):
        film_split(render(size=(4, 4)), cells=16)
    scene = render("cornell-box", size=(8, 8), spp=32, backend="scalar")
    found = film_split(scene)
    assert set(np.unique(found["reason"])) <= {0, *map(int, chd.errors.Reason)}


def test_places_that_are_given_are_kept_and_follow_their_samples(tmp_path):
    """Selections, stores, appended samples and clusters; unequal numbers of samples."""
    rng = np.random.default_rng(4)
    x, places = rng.gamma(2.0, size=(5, 70, 3, 96)), rng.random((5, 70, 2, 96))
    counts = rng.integers(32, 97, size=(5, 70))
    given = chd.Samples.from_array(x, film=places, counts=counts, scene="given")
    saved = given.save(tmp_path / "a.zarr")
    for samples in (given, saved, chd.open(tmp_path / "a.zarr"), saved.load()):
        film = film_of(samples)
        assert film.dtype == np.float32
        assert (np.isnan(film) == (np.arange(96) >= counts[..., None, None])).all()
        assert np.nanmax(np.abs(film - places)) <= STEP / 2
        np.testing.assert_array_equal(samples.to_dataset()["film"], film)
        part = samples[1:4, 60:].isel(sample=slice(8, None, 2))
        np.testing.assert_array_equal(film_of(part), film[1:4, 60:, :, 8::2])
        assert film_of(samples.isel(sample=slice(4))).shape == (5, 70, 2, 4)
    one, two = film_split(given, progress=False), film_split(saved, progress=False)
    assert one.attrs["cells"] == 2  # the median pixel has 64 samples
    np.testing.assert_array_equal(one["places"], two["places"])
    assert (one["reason"] == 0).all()


def test_appended_samples_have_no_places_but_the_first_ones_do(tmp_path):
    rng = np.random.default_rng(4)
    x, places = rng.gamma(2.0, size=(2, 4, 4, 1, 64)), rng.random((4, 4, 2, 64))
    first = chd.Samples.from_array(x[0], film=places, scene="given")
    first.save(tmp_path / "a.zarr")
    more = chd.Samples.from_array(x[1], scene="given").save(tmp_path / "a.zarr", append=True)
    for found in (more, chd.open(tmp_path / "a.zarr")):
        assert (found.spp, found.film.spp) == (128, 64)
    split = film_split(more, progress=False)
    np.testing.assert_array_equal(split["places"], film_split(first, progress=False)["places"])


def test_workers_draw_places_as_threads_do(tmp_path):
    given = {"size": (66, 5), "spp": 20, "backend": "scalar"}
    with client_of(None, 1) as client:
        drawn = render(**given, out=tmp_path / "a.zarr", client=client)
        split = drawn.map(lambda block: {"n": ((), block[:, :, 0, 0])}, client=client)
    assert split["n"].shape == (5, 66)
    assert (film_of(drawn) == film_of(render(**given))).all()


def test_a_render_in_a_time_has_places_of_all_it_draws():
    samples = render(size=(8, 8), spp=2**14, backend="scalar", seconds=0.05)
    assert not np.isnan(film_of(samples)).any()
    assert samples.film.spp == samples.spp


def test_a_store_without_places_gets_them_later(tmp_path):
    at = {"out": tmp_path / "a.zarr", "size": (9, 7), "spp": 40, "backend": "scalar"}
    render(**at, film=False)
    assert (film_of(render(**at)) == film_of(render(**at | {"out": None}))).all()


# --- renderers that are recorded ----------------------------------------------------------------


def of_place(seed: int) -> DrawnPass:
    """Draw passes of an edge in every pixel, and say where samples fell."""
    rng = np.random.default_rng(seed)
    film = rng.random((6, 5, 2))
    return DrawnPass(10.0 * (film[..., 0] > 0.5) + rng.gamma(1.0, size=(6, 5)), film=film)


@pytest.mark.parametrize("stored", [False, True])
def test_a_recorded_renderer_says_where_its_samples_fell(tmp_path, stored):
    out = tmp_path / "a.zarr" if stored else None
    if stored:
        chd.record(of_place, spp=70, out=out, progress=False)
    samples = chd.record(of_place, spp=256, out=out, progress=False)
    assert samples.film.shape == (6, 5, 2, 256)
    assert samples.attrs["notes"] == []
    places = film_split(samples, progress=False)["places"]
    assert abs(places.mean() - 25) < 4.5 * places.std() / 30**0.5  # else in 1 of 10,000 runs


def test_places_of_another_filter_are_told():
    def tent(seed: int) -> DrawnPass:
        image, _, _, film, *_ = of_place(seed)
        return DrawnPass(image, film=film**2)

    with pytest.warns(InputWarning, match="box filter"):
        chd.record(tent, spp=64, progress=False)
    places = np.random.default_rng(0).random((4, 4, 2, 64)) ** 2
    with pytest.warns(InputWarning, match="box filter"):
        chd.Samples.from_array(np.ones((4, 4, 1, 64)), film=places)
