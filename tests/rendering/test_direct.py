"""Direct light: rendered as the same samples once more, stored beside them, and never mixed up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.samples import inspect
from chdstat.samples.store import Store
from tests.stops import stopped

DIRECT = "direct"


def render(scene: Any = "cornell-box", **options: Any) -> chd.Samples:
    return chd.render(
        scene,
        **{"backend": "scalar", "size": (8, 6), "spp": 4, "direct": True, "progress": False}
        | options,
    )


def direct_of(samples: chd.Samples) -> np.ndarray:
    assert samples.direct is not None
    return samples.direct.read()


def test_direct_light_is_part_of_every_sample(backend):
    """Bit for bit the same paths: no sample of it is brighter, and those that end there agree."""
    samples = render(backend=backend)
    whole, direct = samples.read(), direct_of(samples)
    assert (direct <= whole).all()
    assert (direct < whole).any()
    assert ((direct == whole) & (whole > 0)).any()
    assert (whole == render(backend=backend, direct=False).read()).all()


def test_it_is_what_paths_of_two_segments_carry():
    samples = render()
    assert (direct_of(samples) == render(max_depth=2, direct=False).read()).all()
    assert samples.direct.attrs["integrator"]["max_depth"] == 2
    assert render(direct=False).direct is None
    x = np.ones((4, 5, 3, 8))
    with pytest.raises(InputError, match=r"\(4, 5, 3, 8\)"):
        chd.Samples.from_array(x, direct=x[..., :4])


@pytest.mark.parametrize("depth", [1, 2])
def test_paths_that_are_as_short_anyway_are_all_direct(depth):
    samples = render(max_depth=depth)
    assert (direct_of(samples) == samples.read()).all()


def test_the_store_holds_it_and_finds_it_again(tmp_path):
    rendered = render(out=tmp_path / "a.zarr")
    found = chd.open(tmp_path / "a.zarr")
    expected = direct_of(render())
    for samples in (rendered, found, found.load()):
        assert (direct_of(samples) == expected).all()
    assert found.direct.path == tmp_path / "a.zarr" / DIRECT
    assert inspect(tmp_path / "a.zarr", verify=True)["direct_spp"] == 4
    assert found.features


def test_it_can_be_added_to_a_store_and_grows_with_it(tmp_path):
    out = tmp_path / "a.zarr"
    render(out=out, direct=False)
    assert chd.open(out).direct is None
    assert inspect(out)["direct_spp"] == 0
    assert (direct_of(render(out=out)) == direct_of(render())).all()
    grown = render(out=out, spp=70, direct=False)  # whoever has it goes on with it
    assert (direct_of(grown) == direct_of(render(spp=70))).all()


def test_a_render_that_was_stopped_resumes(tmp_path):
    out, size = tmp_path / "a.zarr", (80, 6)
    with stopped(Store, "create", when=lambda path: path.name == DIRECT):
        render(out=out, size=size)
    assert chd.open(out).direct is None
    with stopped(Store, "write", when=lambda store, *_: store.path.name == DIRECT):
        render(out=out, size=size)
    assert chd.open(out).spp == 4
    assert chd.open(out).direct is None
    assert (direct_of(render(out=out, size=size)) == direct_of(render(size=size))).all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 1}, "seed"),
        ({"size": (6, 8)}, "shape"),
        ({"scene": "night-room"}, "scene_hash"),
    ],
)
def test_that_of_other_samples_is_refused(tmp_path, change, named):
    out = tmp_path / "a.zarr"
    render(out=out, direct=False)
    render(**{"out": out / DIRECT, "max_depth": 2, "direct": False} | change)
    for again in (lambda: chd.open(out), lambda: inspect(out), lambda: render(out=out, spp=8)):
        with pytest.raises(StoreError, match=named):
            again()
