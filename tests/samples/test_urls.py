"""Stores behind URLs: in memory, and in buckets of a server of this machine that speaks S3."""

from __future__ import annotations

import contextlib
import logging
import uuid
from collections.abc import Iterator
from typing import Any

import fsspec
import numpy as np
import pytest
from distributed import Client, LocalCluster
from moto.server import ThreadedMotoServer
from upath import UPath

import chdstat as chd
import chdstat.samples
from chdstat.errors import StoreError
from chdstat.samples import Samples

SETTINGS: dict[str, Any] = {"size": (70, 20), "seed": 3, "backend": "scalar", "progress": False}


@pytest.fixture(scope="module")
def bucket():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logging.getLogger("werkzeug"), "level", logging.ERROR)
        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        host, port = server.get_host_and_port()
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "any")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_MAX_ATTEMPTS", "1")
        fsspec.filesystem("s3").mkdir("renders")
        yield "s3://renders"
        server.stop()


@pytest.fixture(params=["memory", "s3"])
def either(request):
    root = "memory://renders" if request.param == "memory" else request.getfixturevalue("bucket")
    return f"{root}/{uuid.uuid4().hex}/box.zarr"


@pytest.fixture
def url():
    return f"memory://renders/{uuid.uuid4().hex}/box.zarr"


@pytest.fixture(scope="module")
def expected() -> Samples:
    return chd.render("cornell-box", spp=130, **SETTINGS)


@contextlib.contextmanager
def workers() -> Iterator[Client]:
    """Yield a client of two workers in this process, which see ``memory://``, too."""
    quiet: dict[str, Any] = {"dashboard_address": ":0", "processes": False, "protocol": "tcp://"}
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", **quiet) as cluster,
        Client(cluster) as client,
    ):
        yield client


def test_a_store_is_rendered_read_and_grows(either, expected, monkeypatch):
    for name in ("Lock", "_partial"):  # nothing is locked, and nothing written beside
        monkeypatch.setattr(f"chdstat._core.files.{name}", None)
    made = chd.render("cornell-box", spp=70, out=either, direct=True, **SETTINGS)
    assert str(made.path) == either
    assert np.array_equal(chd.open(either).read(), expected.first(70).read())
    assert np.array_equal(chd.open(UPath(either))[3, 66], expected.first(70)[3, 66])
    assert chd.open(either).features.keys() == expected.features.keys()
    assert set(chd.open(either).parts) == {2}
    grown = chd.render("cornell-box", spp=130, out=either, **SETTINGS)
    assert np.array_equal(grown.read(), expected.read())
    found = chdstat.samples.inspect(either, verify=True)
    assert (found["complete_spp"], found["damaged"]) == (130, [])


def test_workers_draw_and_compute_as_in_a_folder(url, expected, tmp_path):
    with workers() as client:
        made = chd.render("cornell-box", spp=130, out=url, client=client, **SETTINGS)
        assert np.array_equal(made.read(), expected.read())
        remote = chd.summarize(url, progress=False, client=client)
    expected.save(tmp_path / "box.zarr", progress=False)
    local = chd.summarize(tmp_path / "box.zarr", progress=False)
    assert remote.drop_attrs().identical(local.drop_attrs())


def test_damage_is_named_and_repaired(either, expected):
    chd.render("cornell-box", spp=130, out=either, **SETTINGS)
    changed, cut, gone = (UPath(either) / f"radiance/c/0/1/0/{batch}" for batch in range(3))
    content = bytearray(changed.read_bytes())
    content[100] ^= 1
    changed.write_bytes(bytes(content))
    cut.write_bytes(cut.read_bytes()[:300])
    gone.unlink()
    for batch, file in enumerate((changed, cut, gone)):
        with pytest.raises(StoreError, match=f"cannot read {file} "):
            chd.open(either).read(ss=slice(64 * batch, 64 * batch + 2))
    damaged = chdstat.samples.inspect(either, verify=True)["damaged"]
    assert damaged == [str(changed), str(cut), str(gone)]
    repaired = chd.render("cornell-box", spp=130, out=either, **SETTINGS)
    assert np.array_equal(repaired.read(), expected.read())


@pytest.mark.parametrize("words", ["analyze {} -o", "render cornell-box --summary-only -o"])
def test_maps_go_to_folders(expected, tmp_path, monkeypatch, run, words):
    monkeypatch.chdir(tmp_path)
    url = "memory://maps/box.zarr"
    if not chdstat.samples.is_store(url):
        expected.save(url, progress=False)
    code, _, err = run(*words.format(url).split(), "memory://maps/maps.zarr")
    assert code
    assert "only stores of samples may lie behind URLs" in err
    assert not list(tmp_path.iterdir())


def test_a_service_that_does_not_answer_is_told(bucket, monkeypatch):
    place = UPath(f"{bucket}/box.zarr", endpoint_url="http://127.0.0.1:9")
    with pytest.raises(StoreError, match="s3://renders/box.zarr"):
        chd.open(place)
