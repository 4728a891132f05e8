"""Where samples fall: a ramp that shines with its place tells it, whatever draws the samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.patterns import film_split
from chdstat.patterns.film_splits import split_by_place
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
    assert inspect(tmp_path / "a.zarr")["film_spp"] == 96


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
