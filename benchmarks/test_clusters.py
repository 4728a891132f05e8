"""Workers of a cluster: the same bits as threads, whatever dies, and how much faster they are.

Run with ``--benchmark-only -s -n 0``; CHDSTAT_WORKERS, such as ``1,2,4``, says how many to measure,
CHDSTAT_SPP how many samples of a pixel.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import chdstat as chd

WORKERS = [int(n) for n in os.environ.get("CHDSTAT_WORKERS", "1,2,4").split(",")]
SPP = int(os.environ.get("CHDSTAT_SPP", "256"))
SETTINGS: dict[str, Any] = {
    "spp": SPP,
    "size": (128, 128),
    "backend": "scalar",
    "progress": False,
}
ESTIMATORS = ["mean", "catoni", "shared_shape"]


@contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """Yield a client of worker processes of one thread each, which have imported what they use."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as local,
        Client(local) as client,
    ):
        small = chd.render("cornell-box", spp=32, size=(16, 16), backend="scalar", progress=False)
        client.run(work, small)
        yield client


def work(samples: Any) -> None:
    """Let a worker import, and fill its caches."""
    chd.render("bathroom", spp=1, size=(8, 8), backend="scalar", progress=False)
    chd.analyze(samples, progress=False)
    chd.estimate(samples, progress=False)


def stages(folder: Path, store: Any) -> dict[str, Callable[[Any], Any]]:
    """Return what is done with a client, by name; each result can be compared to the bit."""

    def render(client: Any) -> Any:
        path = folder / f"{time.monotonic_ns()}.zarr"
        return chd.render("bathroom", out=path, client=client, **SETTINGS)

    return {
        "render": render,
        "analyze": lambda client: chd.analyze(store, client=client, progress=False),
        "estimate": lambda client: chd.estimate(store, client=client, progress=False),
        "compare": lambda client: chd.compare(
            store, ESTIMATORS, n=32, client=client, progress=False
        ),
    }


def bits(found: Any) -> list[np.ndarray[Any, Any]]:
    """Return the numbers of a result."""
    if hasattr(found, "data_vars"):
        return [found[name].values for name in sorted(found.data_vars)]
    if hasattr(found, "measures"):
        return [found.estimates, *(m.value for m in found.measures.values())]
    if hasattr(found, "radiance"):
        return [found.radiance, found.low]
    return [found.read(), *found.features.values()]


def same(one: Any, two: Any) -> bool:
    return all(
        np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        for a, b in zip(bits(one), bits(two), strict=True)
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "bathroom.zarr"
    return chd.render("bathroom", out=path, **SETTINGS)


def test_time_and_bits_by_number_of_workers(as_benchmark, store, tmp_path):
    done = stages(tmp_path, store)
    right = {name: stage(None) for name, stage in done.items()}
    seconds: dict[str, list[float]] = {name: [] for name in done}
    empty = []
    for workers in WORKERS:
        with cluster(workers) as client:
            start = time.perf_counter()
            client.gather(client.map(abs, range(200)))
            empty.append((time.perf_counter() - start) / 200)
            for name, stage in done.items():
                start = time.perf_counter()
                found = stage(client)
                seconds[name].append(time.perf_counter() - start)
                assert same(found, right[name]), name
    print("\nworkers   " + "".join(f"{n:>10}" for n in WORKERS) + "   seconds, same bits")
    for name, times in seconds.items():
        print(f"{name:10}" + "".join(f"{t:10.2f}" for t in times))
    print("task      " + "".join(f"{1000 * t:10.2f}" for t in empty) + "   ms, of nothing")


@pytest.mark.parametrize("stage", ["render", "analyze", "estimate", "compare"])
def test_a_worker_that_is_killed_changes_nothing(as_benchmark, store, tmp_path, stage):
    do = stages(tmp_path, store)[stage]
    right = do(None)
    with cluster(2) as client:
        start = time.perf_counter()
        do(client)
        whole = time.perf_counter() - start
        victim = next(iter(client.run(os.getpid).values()))
        killer = threading.Timer(whole / 2, os.kill, (victim, signal.SIGKILL))
        killer.start()
        found = do(client)
        killer.join()
        assert victim not in client.run(os.getpid).values()
    assert same(found, right)
    print(f"\n{stage}: a worker killed after {whole / 2:.1f} of {whole:.1f} s; the same bits")
