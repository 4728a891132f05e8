"""Clusters that die, have no workers, or others than the client; two processes at one store."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import ClusterError, InputError, RenderError
from chdstat.rendering import workers
from chdstat.rendering.backend import activate, probe
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.samples import inspect
from chdstat.samples.store import Store
from chdstat.samples.tiles import chunk_grid

SETTINGS: dict[str, Any] = {"size": (8, 8), "backend": "scalar"}

SCHEDULER = """
import time
from distributed import LocalCluster
if __name__ == "__main__":
    cluster = LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0",
        protocol="tcp://", host="127.0.0.1",
    )
    print(cluster.scheduler_address, flush=True)
    time.sleep(600)
"""


@contextmanager
def scheduler(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a scheduler with one worker in another process; yield it and its address."""
    script = tmp_path / "scheduler.py"
    script.write_text(SCHEDULER)
    child = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        yield child, child.stdout.readline().strip()
    finally:
        child.kill()
        child.wait()
        child.stdout.close()


def test_values_of_mitsuba_reach_no_cluster():
    from distributed import Client, LocalCluster

    local = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    with (
        activate(probe("scalar")) as mi,
        LocalCluster(dashboard_address=":0", **local) as cluster,
        Client(cluster) as client,
    ):
        scene = mi.cornell_box()  # its transforms are Mitsuba's
        with pytest.raises(InputError, match=r"Transform.*\(4, 4\)"):
            chd.render(scene, spp=2, client=client, **SETTINGS)
        image = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))}
        floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": image}}
        with pytest.raises(InputError, match="Bitmap"):
            chd.render({"type": "scene", "floor": floor}, spp=2, client=client, **SETTINGS)


def test_a_scheduler_without_workers_is_told(monkeypatch):
    from distributed import Client, LocalCluster

    monkeypatch.setattr("chdstat._core.work._PATIENCE", 0.5)
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as cluster,
        Client(cluster) as client,
        pytest.raises(ClusterError, match="inproc:"),
    ):
        chd.render("cornell-box", spp=1, client=client, **SETTINGS)


def test_a_dying_scheduler_keeps_the_rest(tmp_path, monkeypatch):
    from distributed import Client

    out, note = tmp_path / "s.zarr", Store.note
    with scheduler(tmp_path) as (child, address), Client(address, timeout="600s") as client:

        def fatal(*arguments: Any) -> None:
            note(*arguments)
            child.kill()

        with monkeypatch.context() as patch:
            patch.setattr(Store, "note", fatal)
            with pytest.raises(ClusterError, match="lost"):
                chd.render("cornell-box", spp=512, out=out, client=client, **SETTINGS)
    assert 0 < len(Store.open(out).pending()) < 8
    whole = chd.render("cornell-box", spp=512, **SETTINGS).read()
    assert np.array_equal(chd.render("cornell-box", spp=512, out=out, **SETTINGS).read(), whole)


def test_workers_of_other_versions_are_refused():
    packages = {"chdstat": chd.__version__, "mitsuba": "3.9.1"}
    answer = {
        "client": {"packages": packages},
        "workers": {"tcp://a": {"packages": {**packages, "mitsuba": "3.7.0"}}},
    }
    client: Any = SimpleNamespace(
        status="running", wait_for_workers=lambda *_, **__: None, get_versions=lambda **_: answer
    )
    with pytest.raises(ClusterError, match="tcp://a .*3.7.0, here 3.9.1"):
        chd.render("cornell-box", spp=1, client=client, **SETTINGS)


def test_a_worker_that_reads_another_scene_is_refused():
    job = Job.of("cornell-box", size=(8, 8), backend="scalar")
    identity = MitsubaRenderer(job).identity
    chunk = next(chunk_grid(8, 8, 1))
    group = chunk, [chunk]
    ((_, block),) = workers.render_remote(job, identity, None, group)
    assert block is not None
    assert block.shape == (8, 8, 3, 1)
    other = {**identity, "scene_hash": "0", "scene_files": {"tex.exr": "0"}}
    with pytest.raises(RenderError, match=r"tex\.exr"):
        workers.render_remote(job, other, None, group)


# --- two processes at one store -------------------------------------------------------------------


BOX = {"scene": "cornell-box", "size": (66, 5), "backend": "scalar", "progress": False}


def started(out, spp):
    """Start a render in a process of its own."""
    asked = ("cornell-box", "--size", "66x5", "--backend", "scalar", "--spp", str(spp), "-q")
    command = [sys.executable, "-m", "chdstat", "render", *asked, "-o", str(out)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=out.parent
    )


def test_two_writers_spoil_no_sample(tmp_path):
    path, most = tmp_path / "box.zarr", 512
    pair = [started(path, 320), started(path, most)]
    for process in pair:
        _, told = process.communicate(timeout=600)
        assert process.returncode == 0 or (
            process.returncode == 2
            and ("is being written by" in told or "run the command again" in told)
        ), told
    assert 0 in [process.returncode for process in pair]
    chd.render(**BOX, spp=most, out=path)
    assert inspect(path, verify=True)["damaged"] == []
    assert np.array_equal(chd.open(path).read(), chd.render(**BOX, spp=most).read())
    left = [p.name for p in tmp_path.rglob("*") if ".partial" in p.name or p.name == ".lock"]
    assert left == []
