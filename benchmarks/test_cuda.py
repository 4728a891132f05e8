"""What a GPU gains: times with llvm over those with cuda, and of training with and without one.

``--benchmark-only -s`` prints, for each scene, the time of a sample, independent and guided (whose
guide is trained each time), in nanoseconds, and what training and estimating take in seconds, with
the ratios. Kernels are compiled before. It is skipped where cuda does not work. A failure: a GPU
that gains nothing, for what it is there for.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

import chdstat as chd
from chdstat.rendering.backend import probe

VIEW: dict[str, Any] = {"size": (128, 128), "spp": 256, "progress": False}
SAMPLES = 128 * 128 * 256


def seconds(function: Callable[[], Any]) -> float:
    """Return the lesser of two times, after one that compiles."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def told(what: str, slow: float, fast: float, unit: str) -> None:
    print(f"{what:32}{slow:9.2f}{fast:9.2f} {unit:4}{slow / fast:6.1f}", flush=True)
    assert fast < slow, what


@pytest.fixture
def on_a_gpu(as_benchmark):
    for name in ("cuda", "llvm"):
        if not (tried := probe(name)).works:
            pytest.skip(f"no {name} backend here: {tried.detail}")
    print(f"\n{'':32}     llvm     cuda       ratio")


@pytest.mark.parametrize("scene", ["cornell-box", "bathroom", "night-room"])
def test_renders(on_a_gpu, scene):
    for integrator in (None, "guided"):
        render = functools.partial(chd.render, scene, integrator=integrator, **VIEW)
        times = [seconds(functools.partial(render, backend=name)) for name in ("llvm", "cuda")]
        told(f"{scene} {integrator or ''}", *(1e9 / SAMPLES * one for one in times), "ns")


def test_networks(on_a_gpu, monkeypatch):
    if not torch.cuda.is_available():
        pytest.skip("this build of PyTorch has no CUDA")
    torch.cuda.init()  # or it is initialised while it is said to be absent, which raises an error
    samples = chd.render("cornell-box", backend="cuda", **VIEW | {"size": (64, 64)})
    few = chd.render("cornell-box", backend="cuda", **VIEW | {"size": (256, 256), "spp": 32})
    times = []
    for works in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda works=works: works)
        model = chd.estimators.MLP.preset("elek2019")
        train = functools.partial(model.train, samples, iterations=100, progress=False)
        times.append([seconds(train), seconds(functools.partial(model.predict, few))])
    for what, slow, fast in zip(("training", "estimating"), *times, strict=True):
        told(f"network {what}", slow, fast, "s")
