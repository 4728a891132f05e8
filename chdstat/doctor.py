"""Doctor: what runs on this machine, and why."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

from chdstat._workers import cores, memory
from chdstat.backend import BACKENDS, llvm_libraries, probe

__all__ = ["examine"]

_PACKAGES = ("chdstat", "mitsuba", "drjit", "numpy", "scipy", "torch", "xarray", "zarr", "typst")


def examine(*, fresh: bool = False) -> dict[str, Any]:
    """Return what works here: backends with the reason, libraries, devices, memory, versions.

    Parameters
    ----------
    fresh
        Try backends again where an answer is cached.
    """
    verdicts = {name: probe(name, fresh=fresh) for name in BACKENDS}
    return {
        "backends": {
            name: f"{'works' if v.works else 'does not work'}: {v.detail}"
            + (f" ({v.library})" if v.works and v.library else "")
            for name, v in verdicts.items()
        },
        "auto_uses": next(n for n in ("cuda", "llvm", "scalar") if verdicts[n].works),
        "llvm_libraries": llvm_libraries(),
        "torch_device": _torch_device(),
        "cores": cores(),
        "memory_gib": None if (size := memory()) is None else round(size / 2**30, 1),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _torch_device() -> str:
    import torch

    if torch.cuda.is_available():
        return f"cuda: {torch.cuda.get_device_name(0)}"
    return f"cpu, {torch.get_num_threads()} threads"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
