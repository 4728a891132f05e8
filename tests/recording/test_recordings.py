"""Recordings: the same samples to the bit, however often they are stopped, and who draws them."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.work import client_of
from chdstat.errors import InputError, RenderError, StoreError
from chdstat.recording import DrawnPass
from chdstat.recording.pass_sources import seed_of_pass

SOURCE = """
import time
import numpy as np

def draw(seed):
    random = np.random.default_rng(seed)
    time.sleep(0.002)
    features = {"albedo": random.random((70, 9, 3)), "depth": random.random((70, 9))}
    image = random.gamma(0.5, size=(70, 9, 3))
    return image, features
"""
KILLED = """
from passes import draw
import chdstat as chd
from chdstat.recording import recordings
recordings._KEEP_EVERY, recordings._MOST_SHARE = 0.02, 1
chd.record(draw, spp=300, out="killed.zarr")
"""


@pytest.fixture
def draw(tmp_path, monkeypatch):
    """Return a source in a module of its own, as other processes find it."""
    (tmp_path / "passes.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(chd.__file__).parent.parent}")
    sys.modules.pop("passes", None)
    import passes

    return passes.draw


def same(one: Any, other: Any, *, within: float = 1e-6) -> bool:
    features = one.features.keys() == other.features.keys() and all(
        np.allclose(one.features[n], other.features[n], atol=within) for n in one.features
    )
    return features and np.array_equal(one, other)


def test_a_pass_is_a_sample_of_every_pixel(draw):
    samples = chd.record(draw, spp=5, seed=3)
    for number in range(5):
        image, _ = draw(seed_of_pass(3, number))
        assert np.array_equal(np.asarray(samples)[..., number], image.astype(np.float32))
    depths = [draw(seed_of_pass(3, number))[1]["depth"] for number in range(5)]
    assert np.allclose(samples.features["depth"], np.mean(depths, axis=0))
    assert samples.attrs["repeats"]
    assert samples.attrs["size"] == [9, 70]


def test_appended_samples_are_those_of_one_recording(draw):
    whole = chd.record(draw, spp=150)
    for spp in (1, 36, 64, 65, 150):
        samples = chd.record(draw, spp=spp, out="x.zarr")
        assert samples.spp == chd.open("x.zarr").spp == spp
    assert same(chd.open("x.zarr"), whole)
    assert chd.samples.inspect("x.zarr", verify=True)["damaged"] == []


@pytest.mark.parametrize("after", [0.05, 0.2, 0.5])
def test_a_killed_recording_goes_on(draw, after):
    kill = subprocess.Popen([sys.executable, "-c", KILLED])
    while not Path("killed.zarr/radiance/c").exists() and kill.poll() is None:
        time.sleep(0.005)
    time.sleep(after)
    kill.send_signal(signal.SIGKILL)
    kill.wait()
    whole, killed = chd.record(draw, spp=300), chd.open("killed.zarr")
    assert 0 < killed.spp <= 300
    assert np.array_equal(killed, np.asarray(whole)[..., : killed.spp])
    assert set(killed.features) == {"albedo", "depth"}
    # A group of passes may count twice in an average of features, if it was just being written.
    assert same(chd.record(draw, spp=300, out="killed.zarr"), whole, within=0.15)


def test_workers_draw_the_same(draw):
    whole = chd.record(draw, spp=70)
    with client_of(None, 2) as client:
        assert same(chd.record(draw, spp=70, out="x.zarr", client=client), whole)


def test_it_stops_when_the_time_is_over(draw):
    samples = chd.record(draw, spp=100_000, out="x.zarr", seconds=0.1)
    assert 1 <= samples.spp < 100_000
    assert samples.spp == samples.attrs["spp"]
    assert chd.samples.inspect("x.zarr")["pending_chunks"] == 0


def test_a_recording_that_is_interrupted_keeps_its_passes(draw):
    number = 0

    def interrupted(seed: int) -> Any:
        nonlocal number
        number += 1
        if number == 40:
            raise KeyboardInterrupt
        return draw(seed)

    with pytest.raises(KeyboardInterrupt):
        chd.record(interrupted, spp=64, out="x.zarr")
    assert chd.open("x.zarr").spp == 38  # the first pass was drawn twice


def test_parts_of_the_light_are_kept_with_their_samples(tmp_path):
    def draw(seed: int) -> DrawnPass:
        lamp, sky = np.random.default_rng(seed).gamma(1, size=(2, 8, 8, 3))
        return DrawnPass(lamp + sky, {}, {2: lamp / 2, "lamp": lamp})

    whole = chd.record(draw, spp=80)
    for spp in (20, 80):
        chd.record(draw, spp=spp, out=tmp_path / "x.zarr")
    stored = chd.open(tmp_path / "x.zarr")
    assert stored.direct is not None
    assert np.array_equal(stored.direct, whole.direct)
    assert np.array_equal(stored.lights["lamp"], whole.lights["lamp"])
    assert np.array_equal(stored, whole)


def test_another_source_is_not_mixed_in(draw):
    chd.record(draw, spp=4, out="x.zarr", name="room")
    for other, options, named in (
        (draw, {"seed": 1}, "seed"),
        (draw, {"integrator": "path"}, "integrator"),
        (lambda seed: draw(seed), {}, "drawn_by"),
    ):
        with pytest.raises(StoreError, match=named):
            chd.record(other, spp=8, out="x.zarr", **{"name": "room", **options})


def test_a_changed_scene_is_refused_where_passes_repeat(tmp_path, caplog):
    brightness, number = 1.0, 0

    def repeating(seed: int) -> Any:
        return brightness * np.random.default_rng(seed).gamma(1, size=(8, 8, 3))

    def differing(seed: int) -> Any:
        nonlocal number
        number += 1
        return repeating(seed + number)

    chd.record(repeating, spp=4, out=tmp_path / "x.zarr")
    chd.record(differing, spp=4, out=tmp_path / "y.zarr")
    brightness = 2.0
    with pytest.raises(StoreError, match="another scene or renderer"):
        chd.record(repeating, spp=8, out=tmp_path / "x.zarr")
    assert chd.open(tmp_path / "x.zarr").spp == 4
    samples = chd.record(differing, spp=8, out=tmp_path / "y.zarr")
    assert "passes of equal seeds differ" in caplog.text
    assert samples.attrs["repeats"] is False
    assert any("another recording" in note for note in samples.attrs["notes"])


def test_what_is_no_store_is_left_alone(draw):
    Path("file.zarr").mkdir()
    Path("file.zarr/mine").write_text("mine")
    with pytest.raises(StoreError, match="nothing was overwritten"):
        chd.record(draw, spp=4, out="file.zarr")
    with pytest.raises(InputError, match="a folder"):
        chd.record(draw, spp=4, out="x.exr")
    with pytest.raises(RenderError, match="ZeroDivisionError"):
        chd.record(lambda seed: seed / 0, spp=4, out="z.zarr")
    assert not Path("z.zarr").exists()
