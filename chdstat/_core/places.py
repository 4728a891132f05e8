"""Places of files: folders of this machine, and whatever else fsspec reaches by a URL."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, TypeGuard, cast

from upath import UPath

from chdstat.errors import InputError, StoreError

__all__ = ["exists", "is_path", "is_remote", "local", "place_of", "tail", "zarr_store"]


def is_path(x: object) -> TypeGuard[str | Path]:
    """Return whether something names a place, be it text, a path or one of ``universal_pathlib``.

    Examples
    --------
    >>> is_path("s3://bucket/room.zarr"), is_path(UPath("memory://room.zarr")), is_path(3)
    (True, True, False)
    """
    return isinstance(x, str | Path | UPath)


def place_of(path: str | Path) -> Path:
    """Return the place that text names: a path, or for a URL what is used as one.

    Raises
    ------
    InputError
        If nothing that is installed reaches such URLs.

    Examples
    --------
    >>> place_of("room.zarr").name, place_of("memory://kept/room.zarr").parent.name
    ('room.zarr', 'kept')
    >>> place_of("tape://room.zarr")
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: cannot reach tape://room.zarr: Unsupported filesystem: 'tape'
    """
    given: Any = path
    if not isinstance(given, str) or "://" not in given:
        return Path(given) if isinstance(given, str) else given
    try:
        place = UPath(given)
        place.fs  # noqa: B018 - what is not installed shows here
    except (ImportError, ValueError) as error:
        message = f"cannot reach {path}: {error}"
        raise InputError(message) from error
    return Path(place.path) if place.protocol in ("file", "local") else cast("Path", place)


def local(path: str | Path) -> Path:
    """Return a path of this machine.

    Raises
    ------
    InputError
        If it is a URL, of which a `Path` has one slash left.

    Examples
    --------
    >>> local(Path("s3://bucket/maps.zarr"))
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: only stores of samples may lie behind URLs, got s3:/bucket/maps.zarr
    """
    if re.match(r"\w[\w+.-]+:/", str(path)):
        message = f"only stores of samples may lie behind URLs, got {path}"
        raise InputError(message)
    return Path(path)


def is_remote(path: Any) -> bool:
    """Return whether a place is none of this machine's folders.

    There are no locks there, and nothing is written beside its place: what fsspec writes is there
    whole or not at all, as far as the service behind it promises that.
    """
    return isinstance(path, UPath) and not isinstance(path, Path)


def exists(path: Path) -> bool:
    """Return whether something is at a place.

    Raises
    ------
    StoreError
        If what is behind a URL does not answer, or does not let one in.
    """
    try:
        return path.exists()
    except Exception as error:
        if not is_remote(path):
            raise
        # Each service has errors of its own.
        message = f"cannot reach {path}: {error or type(error).__name__}"
        raise StoreError(message) from error


def tail(file: Path, size: int) -> tuple[bytes, int]:
    """Return the last bytes of a file, and how many there are before them."""
    # Else fsspec reads a block of several megabytes for them.
    how: dict[str, Any] = {"cache_type": "none"} if is_remote(file) else {}
    with file.open("rb", **how) as opened:
        length = opened.seek(-size, os.SEEK_END)
        return opened.read(size), length


def zarr_store(path: Path) -> Any:
    """Return what zarr reads a place through."""
    from zarr.storage import FsspecStore, LocalStore

    if not is_remote(path):
        return LocalStore(path, read_only=True)
    remote = cast("Any", path)
    options = dict(remote.storage_options)
    return FsspecStore.from_url(str(remote), storage_options=options, read_only=True)
