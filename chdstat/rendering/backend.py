"""Backends: which Mitsuba variants work on this machine, and why others do not.

`scalar` needs nothing but the Mitsuba wheel. `llvm` and `cuda` need libraries outside it, and some
versions of LLVM abort the process instead of raising. So each candidate is tried in a child process
that renders one small image. The answer is cached per library and version of Mitsuba.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from chdstat._core.files import Cache, installed, user_cache
from chdstat._core.work import cores, memory
from chdstat.errors import InputError, RenderError, check_option, did_you_mean

Backend = Literal["auto", "scalar", "llvm", "cuda"]
Color = Literal["rgb", "spectral", "mono"]

BACKENDS = {"scalar": "scalar_rgb", "llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb"}
"""Mitsuba variant of each backend that renders in RGB."""
_COLORS = ("rgb", "spectral", "mono")
"""How light is represented during transport: the end of the names of Mitsuba's variants."""

_LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
_LIBRARY_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_TIMEOUT = 120.0


@dataclass(frozen=True)
class TriedBackend:
    """A backend, and whether it works here, according to a trial in a child process."""

    name: str
    works: bool
    detail: str
    library: str | None = None
    color: str = "rgb"

    @property
    def variant(self) -> str:
        """Name of Mitsuba's variant."""
        return BACKENDS[self.name].removesuffix("rgb") + self.color


def resolve(backend: Backend = "auto", color: Color = "rgb") -> TriedBackend:
    """Return the backend to use: the one asked for, or the fastest one that works.

    Raises
    ------
    InputError
        If the name is not "auto", "scalar", "llvm" or "cuda", the colour is not in `_COLORS`, or
        Mitsuba has no such variant.
    RenderError
        If the backend asked for does not work here.
    """
    check_option("color", color, _COLORS)
    if color == "mono" and backend == "scalar":
        message = "Mitsuba has no scalar variant in mono; use the llvm or cuda backend"
        raise InputError(message)
    if backend == "auto":
        found = (probe(name) for name in ("cuda", "llvm", "scalar"))
        tried = next(one for one in found if one.works)
        if color == "mono" and tried.name == "scalar":
            message = (
                "color='mono' needs the llvm or cuda backend, of which none works here, see: "
                "chdstat doctor"
            )
            raise RenderError(message)
        return replace(tried, color=color)
    tried = probe(backend)
    if not tried.works:
        message = f"the {backend} backend does not work here: {tried.detail}. Use scalar or auto"
        raise RenderError(message)
    return replace(tried, color=color)


def probe(backend: str, *, fresh: bool = False) -> TriedBackend:
    """Try a backend in a child process, or return the result of an earlier trial.

    Parameters
    ----------
    backend
        A key of `BACKENDS`.
    fresh
        Try again even if an answer is cached.

    Raises
    ------
    InputError
        If there is no such backend.
    """
    if backend not in BACKENDS:
        near = did_you_mean(backend, ("auto", *BACKENDS))
        more = (
            ". Spectral and mono variants of Mitsuba are chosen by color; polarized ones are not "
            "supported"
        )
        names = ", ".join(("auto", *BACKENDS))
        message = f"backend must be one of {names}, got {backend!r}{near or more}"
        raise InputError(message)
    if backend == "scalar":
        return TriedBackend("scalar", works=True, detail="built into Mitsuba")
    if backend == "cuda":
        devices = ("/dev/nvidia0", "/dev/dxg", "C:/Windows/System32/nvcuda.dll")
        if not any(Path(device).exists() for device in devices):
            return TriedBackend("cuda", works=False, detail="no NVIDIA device")
        return _trial("cuda", None, fresh=fresh)
    failures = []
    for library in llvm_libraries():
        tried = _trial("llvm", library, fresh=fresh)
        if tried.works:
            return tried
        failures.append(f"{Path(library).name}: {tried.detail}")
    detail = "; ".join(failures) or "no LLVM library found"
    return TriedBackend("llvm", works=False, detail=detail)


@contextlib.contextmanager
def activate(backend: TriedBackend) -> Iterator[Any]:
    """Set the Mitsuba variant of a backend, yield the module, and restore the previous variant.

    An error that leaves the context holds no scene: Dr.Jit would otherwise call the materials of a
    living scene in the next render.
    """
    if backend.library is not None:
        os.environ.setdefault(_LIBRARY_VARIABLE, backend.library)
    import mitsuba as mi

    previous = mi.variant()
    mi.set_variant(backend.variant)
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield mi
    except BaseException as error:
        held: list[BaseException | None] = [error]
        while (last := held[-1]) is not None and last not in held[:-1]:
            traceback.clear_frames(last.__traceback__)
            held.append(last.__cause__ or last.__context__)
        raise
    finally:
        if previous is not None:
            mi.set_variant(previous)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let Mitsuba's scalar passes run in the calling thread."""
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def llvm_libraries() -> list[str]:
    """Return the LLVM libraries of this machine, newest first, each once.

    If the environment variable that Mitsuba reads names a library, it is the only candidate.
    """
    named = os.environ.get(_LIBRARY_VARIABLE)
    if named:
        return [named]
    found = {
        path.resolve()
        for pattern in _LIBRARY_FOLDERS
        for folder in Path("/").glob(pattern.lstrip("/"))
        for path in (*folder.glob("libLLVM*.so*"), *folder.glob("libLLVM*.dylib"))
        if re.match(r"libLLVM([-.]|$)", path.name)
    }

    def version(path: Path) -> list[int]:
        return [int(number) for number in re.findall(r"\d+", path.name)]

    return [str(path) for path in sorted(found, key=version, reverse=True)]


def _trial(backend: str, library: str | None, *, fresh: bool) -> TriedBackend:
    """Return the cached answer for a library, or render with it in a child process."""
    changed = Path(library).stat().st_mtime_ns if library and Path(library).exists() else 0
    inputs = (library, changed, importlib.metadata.version("mitsuba"))
    cache = Cache(user_cache(), "backend")
    return cache.record(
        backend, TriedBackend, lambda: _try_in_child(backend, library), inputs=inputs, again=fresh
    )


_CHILD = """
import sys, mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
scene = mi.load_dict(mi.cornell_box())
image = np.array(mi.render(scene, spp=2))
assert np.isfinite(image).all() and image.mean() > 0
"""


def _try_in_child(backend: str, library: str | None) -> TriedBackend:
    environment = dict(os.environ)
    if library is not None:
        environment[_LIBRARY_VARIABLE] = library
    command = [sys.executable, "-c", _CHILD, BACKENDS[backend]]
    try:
        done = subprocess.run(  # noqa: S603 - our own code in our own interpreter
            command, env=environment, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return TriedBackend(backend, False, f"no image in {_TIMEOUT:.0f} s", library)
    if done.returncode == 0:
        return TriedBackend(backend, True, "rendered an image", library)
    # What is indented is the code that a traceback quotes.
    lines = [line.strip() for line in done.stderr.splitlines() if line[:1].strip()]
    errors = [line for line in lines if "rror" in line or "Cannot" in line]
    ended = f"aborted by signal {-done.returncode}" if done.returncode < 0 else "raised"
    return TriedBackend(
        backend, False, f"{ended} ({[*errors, *lines, 'no output'][0][:120]})", library
    )


_PACKAGES = ("chdstat", "mitsuba", "drjit", "numpy", "scipy", "torch", "xarray", "zarr", "typst")


def examine(*, fresh: bool = False) -> dict[str, Any]:
    """Return what works here: backends with reasons, libraries, devices, memory, versions.

    Parameters
    ----------
    fresh
        Try backends again even if answers are cached.
    """
    tried = {name: probe(name, fresh=fresh) for name in BACKENDS}
    return {
        "backends": {
            name: f"{'works' if v.works else 'does not work'}: {v.detail}"
            + (f" ({v.library})" if v.works and v.library else "")
            for name, v in tried.items()
        },
        "auto_uses": next(n for n in ("cuda", "llvm", "scalar") if tried[n].works),
        "llvm_libraries": llvm_libraries(),
        "torch_device": _torch_device(),
        "cores": cores(),
        "memory_gib": None if (size := memory()) is None else round(size / 2**30, 1),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: installed(name) or "not installed" for name in _PACKAGES},
    }


def _torch_device() -> str:
    import torch

    if torch.cuda.is_available():
        return f"cuda: {torch.cuda.get_device_name(0)}"
    return f"cpu, {torch.get_num_threads()} threads"
