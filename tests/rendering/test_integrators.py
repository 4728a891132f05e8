"""Integrators and crops that are asked for in place of the scene's own."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, RenderError, StoreError
from chdstat.rendering import render_batches, render_pixels

VIEW = {"spp": 4, "size": (12, 8), "backend": "scalar", "progress": False}


def render(**change):
    return chd.render("cornell-box", **{**VIEW, **change})


def test_an_integrator_takes_the_place_of_the_scene_s():
    direct = render(integrator="direct")
    assert direct.attrs["integrator"]["type"] == "direct"
    assert direct.read().sum() < render().read().sum()
    (batch,) = render_batches("cornell-box", **VIEW, integrator="direct")
    assert np.array_equal(batch, direct.read())
    few = {name: value for name, value in VIEW.items() if name != "progress"} | {"spp": 64}
    pixel = render_pixels("cornell-box", (6, 6), **few, integrator={"type": "direct"})
    assert (pixel[0] == 0).mean() > (render_pixels("cornell-box", (6, 6), **few)[0] == 0).mean() - 1


def test_its_settings_and_the_longest_path_count():
    short = render(integrator={"type": "path", "max_depth": 2})
    assert np.array_equal(short.read(), render(integrator="path", max_depth=2).read())
    assert short.attrs["integrator"]["max_depth"] == 2
    assert not np.array_equal(short.read(), render(integrator="path", max_depth=5).read())
    own = render(integrator={"type": "path", "max_depth": 6})
    assert list(render(integrator={"type": "path", "max_depth": 6}, by_depth=3).depths) == [2, 3]
    assert own.shape == (8, 12, 3, 4)


@pytest.mark.parametrize(
    ("integrator", "error", "told"),
    [
        ("pth", ChdstatError, "pth"),
        ("diffuse", RenderError, "is no integrator"),
        ("ptracer", RenderError, "ptracer"),
        ({"type": "path", "max_dpth": 3}, InputError, "no setting max_dpth"),
        ({"max_depth": 3}, InputError, "must be a name such as"),
        ({"type": "path", "max_depth": [1]}, InputError, "numbers, strings or booleans"),
        (3, InputError, "must be a name such as"),
    ],
)
def test_what_is_no_integrator_is_refused(integrator, error, told):
    with pytest.raises(error, match=told):
        render(integrator=integrator)


def test_a_store_goes_on_with_its_own_integrator_only(tmp_path):
    out = tmp_path / "a.zarr"
    render(out=out, integrator="direct")
    with pytest.raises(StoreError, match="holds other samples"):
        render(out=out, spp=8)
    grown = render(out=out, spp=8, integrator="direct")
    assert np.array_equal(grown.read(), render(spp=8, integrator="direct").read())


def test_a_crop_shows_a_part_of_the_image(tmp_path):
    many = {"spp": 256, "size": (16, 16)}
    whole, part = render(**many).read(), render(**many, crop=(4, 2, 8, 6))
    assert part.shape == (6, 8, 3, 256)
    mean, other = whole[2:8, 4:12].mean(axis=-1), part.read().mean(axis=-1)
    assert np.abs(mean - other).mean() < 0.3 * mean.mean()
    assert np.abs(mean - other).mean() < np.abs(whole[:6, :8].mean(axis=-1) - other).mean()
    kept = chd.render(
        "cornell-box", **{**VIEW, **many}, crop=(4, 2, 8, 6), out=tmp_path / "part.zarr"
    )
    assert np.array_equal(kept.read(), part.read())
    with pytest.raises(StoreError, match="holds other samples"):
        render(**many, crop=(0, 0, 8, 6), out=tmp_path / "part.zarr")


@pytest.mark.parametrize("crop", [(8, 0, 8, 8), (0, 0, 0, 4), (0, 0, 4), "abcd", (-1, 0, 2, 2)])
def test_a_crop_outside_of_the_image_is_refused(crop):
    with pytest.raises(InputError, match="crop"):
        render(crop=crop)


def test_the_command_takes_both(tmp_path, monkeypatch):
    from chdstat.cli import main

    out = tmp_path / "a.zarr"
    settings = ("--spp", "4", "--size", "12x8", "--backend", "scalar", "-q")
    asked = ("--integrator", '{"type": "path", "max_depth": 3}', "--crop", "2,1,8x6")
    monkeypatch.setattr(
        "sys.argv", ["chdstat", "render", "cornell-box", "-o", str(out), *settings, *asked]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    found = chd.open(out)
    assert found.shape == (6, 8, 3, 4)
    direct = render(integrator={"type": "path", "max_depth": 3}, crop=(2, 1, 8, 6))
    assert np.array_equal(found.read(), direct.read())
