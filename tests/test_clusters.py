"""Work on a Dask cluster, and work that was stopped: the same bits as at once, here."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from xarray.testing import assert_allclose

import chdstat as chd
from chdstat._core import work
from chdstat._core.files import beside
from chdstat._core.work import client_of, in_order
from chdstat.cli import app
from chdstat.errors import ClusterError, InputError, StoreError
from chdstat.estimators import estimate
from chdstat.estimators.shapes import PowerSums
from chdstat.inference.modes import ModalMixture
from chdstat.rendering import render_batches, workers
from chdstat.samples import Samples
from chdstat.samples import tiles as cut
from chdstat.samples.store import Store, reopened
from chdstat.summary.statistics import Summary
from tests.stops import counted, stopped

SETTINGS: dict[str, Any] = {"size": (24, 16), "backend": "scalar", "progress": False}


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    from distributed import Client, LocalCluster

    quiet = {"dashboard_address": ":0", "processes": False, "protocol": "tcp://"}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", **quiet) as cluster,
        Client(cluster) as found,
    ):
        yield found


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch):
    monkeypatch.setattr(cut, "_EDGE", 8)


@pytest.fixture(scope="module")
def store(stored) -> Samples:
    return chd.open(stored())


@pytest.mark.parametrize("held", ["store", "memory"])
def test_workers_analyse_and_estimate_the_same_bits(client, store, held):
    samples = store if held == "store" else store.load()
    found = chd.analyze(samples, client=client, progress=False)
    assert found.identical(chd.analyze(samples, progress=False))
    right = estimate(store).radiance
    for whole in (estimate(samples), estimate(samples, client=client)):
        assert np.array_equal(whole.radiance, right)


def test_workers_compare_the_same_bits(client, store):
    names = ["mean", "catoni", "shared_shape"]
    found = [
        chd.compare(samples, names, n=16, client=at, progress=False)
        for samples, at in ((store, None), (store, client), (store.load(), client))
    ]
    tables = [repr(one.table()) for one in found]  # in which NaN equals NaN
    assert tables[0] == tables[1] == tables[2]
    assert np.array_equal(found[0].estimates, found[1].estimates)


def test_workers_read_images_of_other_programs(client, store, tmp_path):
    for i in range(4):
        chd.io.write_exr(tmp_path / f"{i}.exr", store.read(ss=slice(i, i + 1))[..., 0])
    frames = chd.io.read(*sorted(tmp_path.glob("*.exr")))
    found = chd.summarize(frames, client=client)
    assert found.identical(chd.summarize(frames))


def test_workers_write_their_own_chunks(client, store, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", None)
        found = chd.render(
            "cornell-box", spp=64, out=tmp_path / "a.zarr", client=client, **SETTINGS
        )
    assert np.array_equal(found.read(), store.read())
    for name in store.features:
        assert np.array_equal(found.features[name], store.features[name])

    def unseen(*_: object) -> None:
        message = "no store there"
        raise StoreError(message)

    monkeypatch.setattr(workers, "reopened", unseen)
    found = chd.render("cornell-box", spp=64, out=tmp_path / "b.zarr", client=client, **SETTINGS)
    assert np.array_equal(found.read(), store.read())


def test_a_worker_refuses_another_store(store, tmp_path):
    path, identity, complete, shape = store.source.place
    with pytest.raises(StoreError, match=r"none\.zarr"):
        reopened(tmp_path / "none.zarr", identity, complete, shape)
    for other in (("0" * 16, complete), (identity, complete + 1)):
        with pytest.raises(StoreError, match="another store"):
            reopened(path, *other, shape)


def test_errors_of_the_work_come_as_they_are(client, store):
    def fails(_: object) -> Any:
        message = "of the work"
        raise InputError(message)

    with pytest.raises(InputError, match="of the work"):
        store.map(fails, client=client)


def test_workers_and_scheduler_exclude_each_other():
    with client_of(None, None) as nobody:
        assert nobody is None
    with client_of(None, 1) as here:
        assert list(in_order(abs, [-1, 2], client=here)) == [1, 2]
    with pytest.raises(InputError, match="workers are started here"), client_of("tcp://a:1", 1):
        pass


@pytest.mark.skipif(os.name != "posix", reason="processes inherit no signal mask there")
def test_ctrl_c_waits_while_workers_start(monkeypatch):
    import distributed

    begun = []

    class Begins:
        def __init__(self, **_: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            blocked = "import signal; print(signal.SIGINT in signal.pthread_sigmask(0, []))"
            said = subprocess.run([sys.executable, "-c", blocked], capture_output=True, check=True)
            begun.append(said.stdout.strip())

        def __enter__(self) -> None: ...
        def __exit__(self, *_: object) -> None:
            begun.append(b"ended")

    monkeypatch.setattr(distributed, "LocalCluster", Begins)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # xdist ignores it
    try:
        with pytest.raises(KeyboardInterrupt), client_of(None, 1):
            pass
    finally:
        signal.signal(signal.SIGINT, before)
    assert begun == [b"True", b"ended"]


def test_a_closed_client_is_told(store):
    from distributed import Client, LocalCluster

    quiet = {"dashboard_address": ":0", "processes": False}
    with LocalCluster(n_workers=1, **quiet) as cluster, Client(cluster) as gone:
        pass
    with pytest.raises(ClusterError, match="lost"):
        chd.analyze(store, client=gone, progress=False)


@pytest.fixture
def one_thread(monkeypatch):
    """Let one thread work, so that it is certain what it has done when it is stopped."""
    monkeypatch.setattr(work, "cores", lambda: 1)


TILES = 6
"""Of 8 x 8 pixels in the image."""


@pytest.mark.usefixtures("one_thread")
def test_an_analysis_that_was_stopped_goes_on(store, tmp_path):
    """In its summary, and in its fits: what was done of tiles is not done again."""
    samples, folder = store.load(), tmp_path / "parts"
    for target, name in ((Summary, "read"), (ModalMixture, "measure")):
        with stopped(target, name, 2):
            chd.analyze(samples, checkpoint=folder, progress=False)
        assert folder.exists()
    with counted(Summary, "read") as summaries, counted(ModalMixture, "measure") as fits:
        found = chd.analyze(samples, checkpoint=folder, progress=False)
    assert (len(summaries), len(fits)) == (0, TILES - 2)
    assert not folder.exists()
    assert found.identical(chd.analyze(samples, progress=False))


def test_checkpoints_remove_nothing_of_others(store, tmp_path):
    own = tmp_path / "thesis.txt"
    own.write_text("years of work")
    estimate(store, checkpoint=tmp_path)
    assert list(tmp_path.iterdir()) == [own]
    with pytest.raises(StoreError, match="another folder"):
        estimate(store, checkpoint=own)
    assert own.exists()


def test_checkpoints_stay_until_the_output_is_there(tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        message = "the disk is full"
        raise StoreError(message)

    out = tmp_path / "maps.zarr"
    command = ["render", "cornell-box", "-o", str(out), "--summary-only", "--spp=64", "-q"]
    command += ["--size=24x16", "--backend=scalar"]
    with monkeypatch.context() as patch:
        patch.setattr("chdstat.analysis.writing", full)
        with pytest.raises(StoreError, match="the disk is full"):
            app(command, standalone_mode=False)
    assert beside(out).is_dir()
    with counted(Summary, "read", most=0):
        app(command, standalone_mode=False)
    assert out.is_dir()
    assert not beside(out).exists()


@pytest.mark.usefixtures("one_thread")
def test_a_stopped_estimate_goes_on_if_unchanged(store, tmp_path):
    folder, whole = tmp_path / "parts", estimate(store)
    with stopped(PowerSums, "of", 4):  # it is called twice a tile
        estimate(store, checkpoint=folder)
    with counted(PowerSums, "of") as calls:
        found = estimate(store, checkpoint=folder)
    assert np.array_equal(found.radiance, whole.radiance)
    assert len(calls) == 2 * (TILES - 2)
    with stopped(PowerSums, "of", 4):
        estimate(store, checkpoint=folder)
    fewer = store.isel(sample=slice(32))
    assert np.array_equal(estimate(fewer, checkpoint=folder).radiance, estimate(fewer).radiance)


@pytest.mark.usefixtures("one_thread")
def test_a_render_is_summarised_without_its_samples(client, store, tmp_path):
    def drawn(**at: Any) -> Any:
        rendering = render_batches("cornell-box", spp=64, **SETTINGS)
        return chd.analyze(rendering, progress=False, **at)

    found, kept = drawn(), chd.summarize(store)
    for name in kept:
        assert found[name].identical(kept[name]), name
    fits = chd.fit.select(kept)
    assert_allclose(found[sorted(set(fits) - set(kept))], fits[sorted(set(fits) - set(kept))])
    assert found.equals(chd.analyze(kept, progress=False))
    assert found.equals(drawn(client=client))
    with stopped(Summary, "read", 2):
        drawn(checkpoint=tmp_path / "parts")
    with counted(Summary, "read") as calls:
        assert found.equals(drawn(checkpoint=tmp_path / "parts"))
    assert len(calls) == TILES - 2
    assert not (tmp_path / "parts").exists()
    assert found["best_goodness_effect"].notnull().any()
    assert found["lognormal_mixture_k"].max() >= 1
    assert "tail_index" not in found


def test_options_of_other_sources_are_refused(client, store):
    rendering = render_batches("cornell-box", spp=64, **SETTINGS)
    for summarised in (rendering, chd.summarize(store)):
        with pytest.raises(InputError, match="thresholds"):
            chd.analyze(summarised, held_out=False, progress=False)
    with pytest.raises(InputError, match="one process"):
        chd.estimate(rendering, client=client)


def test_a_summary_is_taken_by_its_places(store):
    summary = chd.summarize(store)
    whole = chd.analyze(summary, progress=False)
    for changed in (
        summary.assign_coords(y=[0] * 16),
        summary.drop_vars(["y", "x"]),
        summary.transpose("x", "y", ...),
    ):
        found = chd.analyze(changed, progress=False)
        assert found["gamma_shape"].dims == ("y", "x", "channel")
        assert np.array_equal(found["gamma_shape"], whole["gamma_shape"], equal_nan=True)
    for other, words in (
        (summary.isel(y=0), "expected the dataset of an image, over y, x and channel"),
        (summary.isel(y=slice(0)), "expected the dataset of an image, over y, x and channel"),
        (summary[["mean"]], "got one without log_counts"),
        (store.to_dataset(), "got one without log_counts"),
    ):
        with pytest.raises(InputError, match=words):
            chd.analyze(other, progress=False)
