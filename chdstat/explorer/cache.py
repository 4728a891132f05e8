"""Cache: pictures and maps of a store, kept in the user's cache folder, never beside the store."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._code import code_digest
from chdstat._core.files import replacing
from chdstat.samples import Samples

__all__ = ["kept"]

_MOST_FILES = 64

Arrays = Mapping[str, npt.NDArray[Any]]


def kept(samples: Samples, name: str, compute: Callable[[], Arrays]) -> Arrays:
    """Return arrays from the cache, or compute and keep them.

    A store is known by its path, its spp and when it was last written to; samples in memory are not
    kept, and what other code computed is not read. A cache that cannot be read or written costs
    time and is no error.

    Parameters
    ----------
    samples
        What the arrays were computed from.
    name
        What they are.
    compute
        Returns them, where they are not there.
    """
    file = _file(samples, name)
    if file is None:
        return compute()
    try:
        with np.load(file, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        arrays = compute()
    with contextlib.suppress(OSError):
        _write(file, arrays)
    return arrays


def _file(samples: Samples, name: str) -> Path | None:
    if samples.path is None:
        return None
    path = Path(samples.path).resolve()
    parts = [path / "zarr.json", path / "radiance" / "zarr.json", *path.glob("ledger/c/**/*")]
    try:
        written = max(part.stat().st_mtime_ns for part in parts)
    except OSError:
        return None
    told = f"{path}|{samples.spp}|{written}|{name}|{code_digest()}"
    key = hashlib.sha256(told.encode()).hexdigest()[:32]
    return _folder() / f"{key}.npz"


def _folder() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "chdstat" / "explorer"


def _write(file: Path, arrays: Arrays) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as partial, partial.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    newest = sorted(file.parent.glob("*.npz"), key=lambda f: f.stat().st_mtime, reverse=True)
    for old in newest[_MOST_FILES:]:
        old.unlink(missing_ok=True)
