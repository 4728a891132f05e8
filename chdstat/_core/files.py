"""Files: written whole or not at all, by one process at a time, in a folder or behind a URL.

A file or folder is first written beside its place, under a name that ends in ``.partial`` before
its suffix, and moved when it is complete. Its writer holds a lock on it (``flock``), which the
system releases whenever the process ends. A locked file thus belongs to a living process. An
unlocked one was left by a process that was killed, and the next process that writes to the same
place removes it. A URL names a place that fsspec reaches, where nothing is locked.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import importlib.metadata
import math
import mmap
import os
import re
import shutil
import socket
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeGuard, cast

import numpy as np
import numpy.typing as npt
from upath import UPath

from chdstat.errors import InputError, StoreError

__all__ = [
    "Lock",
    "check_claim",
    "checked_target",
    "checksum",
    "exists",
    "free_disk",
    "is_exr",
    "is_path",
    "is_remote",
    "local",
    "locked",
    "place_of",
    "release",
    "remove",
    "replacing",
    "room",
    "scratch",
    "shown",
    "sweep",
    "tail",
    "unused",
    "writing",
    "zarr_store",
]


def is_path(x: object) -> TypeGuard[str | Path]:
    """Return whether something names a place: text, a path, or one of ``universal_pathlib``.

    Examples
    --------
    >>> is_path("s3://bucket/room.zarr"), is_path(UPath("memory://room.zarr")), is_path(3)
    (True, True, False)
    """
    return isinstance(x, str | Path | UPath)


def is_exr(x: object) -> TypeGuard[str | Path]:
    """Return whether something names an EXR file, by its suffix.

    Examples
    --------
    >>> is_exr("a.EXR"), is_exr("a.zarr"), is_exr(None)
    (True, False, False)
    """
    return is_path(x) and place_of(x).suffix.lower() == ".exr"


def place_of(path: str | Path) -> Path:
    """Return the place of a text: a path, or for a URL an object used like one.

    Raises
    ------
    InputError
        If it is not a path, or no installed package reaches such URLs.

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
    if not is_path(path) or "\0" in str(path):
        message = f"expected a path, got {path!r}"
        raise InputError(message)
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
        If it is a URL, which a `Path` reduces to one slash.

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
    """Return whether a place is not a folder of this machine.

    There are no locks there, and nothing is written beside its place. What fsspec writes is there
    as a whole or not at all, as far as its service promises that.
    """
    return isinstance(path, UPath) and not isinstance(path, Path)


def shown(path: Path) -> Path:
    """Return a path as people read it: without the current folder, where it lies there."""
    with contextlib.suppress(OSError):  # a current folder that is gone
        if not is_remote(path) and path.is_relative_to(Path.cwd()):
            return path.relative_to(Path.cwd())
    return path


def exists(path: Path) -> bool:
    """Return whether something is at a place.

    Raises
    ------
    StoreError
        If the service behind a URL does not answer, or denies access.
    """
    if not is_remote(path):
        return os.path.exists(path)  # noqa: PTH110 - also of what is too long for a name
    try:
        return path.exists()
    except Exception as error:
        # Each service has errors of its own.
        message = f"cannot reach {path}: {error or type(error).__name__}"
        raise StoreError(message) from error


def tail(file: Path, size: int) -> tuple[bytes, int]:
    """Return the last bytes of a file, and the number of bytes before them."""
    # Otherwise, fsspec reads a block of several megabytes for them.
    how: dict[str, Any] = {"cache_type": "none"} if is_remote(file) else {}
    with file.open("rb", **how) as opened:
        length = opened.seek(-size, os.SEEK_END)
        return opened.read(size), length


def zarr_store(path: Path) -> Any:
    """Return the object through which zarr reads a place."""
    from zarr.storage import FsspecStore, LocalStore

    if not is_remote(path):
        return LocalStore(path, read_only=True)
    remote = cast("Any", path)
    options = dict(remote.storage_options)
    return FsspecStore.from_url(str(remote), storage_options=options, read_only=True)


_fcntl: Any = importlib.import_module("fcntl") if os.name == "posix" else None
"""Windows has no flock: nothing is locked or swept there."""
_TRIES = 8
"""How often to make a file again that vanishes while it is being locked."""
_SMALL, _MOST_SHRUNK = 2**28, 2000
"""Bytes of content that any file may claim, and the most for each of its bytes: zlib compresses
zeros by a factor of 1032."""


def checksum(data: bytes) -> int:
    """Return the CRC-32C of bytes: it reveals accidents, not forgery.

    Examples
    --------
    >>> hex(checksum(b"123456789"))  # the check value of RFC 3720, appendix B.4
    '0xe3069283'
    """
    import google_crc32c

    return int(google_crc32c.value(data))


def check_claim(path: Path, claimed: int) -> None:
    """Refuse a file whose header claims more bytes than it can hold, before making room.

    Raises
    ------
    StoreError
        If it does.
    """
    size = path.stat().st_size
    if claimed > max(_SMALL, _MOST_SHRUNK * size):
        message = (
            f"{path} is damaged: of {size} bytes, it cannot hold the {claimed:.3g} that its header "
            "claims"
        )
        raise StoreError(message)


# --- outputs ------------------------------------------------------------------------------------


def checked_target(path: str | Path, *suffixes: str) -> Path:
    """Return a path that a file can be written to.

    Raises
    ------
    InputError
        If it has none of the `suffixes`, is a folder, or its folder cannot be written to.

    Examples
    --------
    >>> checked_target("image.png", ".exr")
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: the path to write must end in .exr, got 'image.png'
    """
    target = local(path)
    if target.suffix.lower() not in suffixes:
        message = f"the path to write must end in {', '.join(suffixes)}, got {str(target)!r}"
        raise InputError(message)
    if not target.parent.is_dir():
        message = f"the folder {str(target.parent)!r} does not exist; create it first"
        raise InputError(message)
    if target.is_dir() or not os.access(target.parent, os.W_OK):
        message = f"{str(target)!r} cannot be written; give another path"
        raise InputError(message)
    return target


def unused(path: str | Path) -> Path:
    """Return a path to write to, or raise StoreError if something is there already."""
    target = local(path)
    if target.exists():
        message = f"{target} exists; nothing was overwritten. Give another path or move it away"
        raise StoreError(message)
    return target


@contextlib.contextmanager
def replacing(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yield a path beside another, which it replaces when it is written, or not at all.

    It keeps the suffix, by which some writers choose the format. With ``folder=True``, it is an
    empty folder, otherwise an empty file. Leftovers of killed processes beside `path` are removed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder, "found.json")) as partial:
    ...         written = partial.write_text("[]")
    ...     [path.name for path in Path(folder).iterdir()]
    ['found.json']
    """
    if is_remote(path):
        yield path
        return
    sweep(path.parent, path)
    with _partial(path, folder=folder) as partial:
        yield partial
        partial.replace(path)


@contextlib.contextmanager
def writing(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yield a path like `replacing`; a StoreError says why it cannot be written."""
    try:
        with replacing(path, folder=folder) as partial:
            yield partial
    except OSError as error:
        message = f"cannot write {path}: {error.strerror or error}"
        raise StoreError(message) from error


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield a temporary folder, removed at the end, or later if this process is killed.

    Examples
    --------
    >>> with scratch() as folder:
    ...     size = (folder / "page.typ").write_text("= Report")
    >>> folder.exists()
    False
    """
    place = Path(tempfile.gettempdir(), "chdstat")
    sweep(place.parent, place)
    with _partial(place, folder=True) as folder:
        yield folder


def sweep(folder: Path, path: Path | None = None) -> None:
    """Remove leftovers of killed processes from a folder: of one output, or of all, recursively.

    Locked files belong to a living process and stay.
    """
    if _fcntl is None or is_remote(folder):
        return
    if path is None:
        found = folder.rglob(".*.partial*")
    else:
        found = (
            folder / name
            for name in (os.listdir(folder) if folder.is_dir() else ())  # noqa: PTH208 - no glob
            if name.startswith(f".{path.stem}.") and name.endswith(f".partial{path.suffix}")
        )
    for leftover in list(found):
        held = _locked(leftover)
        if held is not None:
            remove(leftover)
            os.close(held)


@contextlib.contextmanager
def _partial(path: Path, *, folder: bool) -> Iterator[Path]:
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.partial{path.suffix}")
    held = _made(partial, folder=folder)
    try:
        yield partial
    finally:
        remove(partial)
        if held is not None:
            os.close(held)


def remove(path: Path) -> None:
    """Remove a file or folder, if it exists and can be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


# --- arrays -------------------------------------------------------------------------------------


def room(shape: tuple[int, ...], kind: npt.DTypeLike, folder: Path | None) -> npt.NDArray[Any]:
    """Return an array to fill: in memory, or in a nameless file of a folder.

    The system moves the content of a file out of memory if that is short, and so does `release`.

    Raises
    ------
    If the disk has no room for it.
        If the disk has no room for it.

    Examples
    --------
    >>> with scratch() as folder:
    ...     array = room((2, 3), "f4", folder)
    >>> array[:] = 1
    >>> release(array)
    >>> float(array.sum())
    6.0
    """
    size = math.prod(shape) * np.dtype(kind).itemsize
    if folder is None or not size:
        return np.empty(shape, kind)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            _reserve(file.fileno(), size)
            held = mmap.mmap(file.fileno(), size)
    except OSError as error:
        message = f"cannot keep {size / 1e6:.3g} MB of maps in {folder}: {error.strerror or error}"
        raise StoreError(message) from error
    return np.frombuffer(held, kind).reshape(shape)


def _reserve(file: int, size: int) -> None:
    """Reserve the size of a file on disk: writing to holes of a full disk is a bus error."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(file, 0, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                raise
        else:
            return
    os.truncate(file, size)


def release(array: npt.NDArray[Any]) -> None:
    """Release the memory of an array that `room` made in a file; its content stays."""
    base: Any = array
    while isinstance(base, np.ndarray | memoryview):
        base = base.base if isinstance(base, np.ndarray) else base.obj
    if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
        base.madvise(mmap.MADV_DONTNEED)


# --- locks --------------------------------------------------------------------------------------


class Lock:
    """Exclusive use of a place, marked by a file that the process keeps locked.

    A process that is killed leaves the file but not the lock, and the next one takes it.

    Parameters
    ----------
    path
        The file; it is removed when the lock is released.
    what
        What the lock protects, for the message.

    Raises
    ------
    StoreError
        If another process holds it.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> with scratch() as folder:
    ...     first = Lock(folder / ".lock", "this folder")
    ...     try:
    ...         Lock(folder / ".lock", "this folder")
    ...     except StoreError as error:
    ...         print(str(error).split(" by ")[0])
    ...     first.release()
    this folder is being written
    """

    def __init__(self, path: Path, what: object) -> None:
        self._path = path
        self._held = _made(path)
        if self._held is None and _fcntl is not None:
            with contextlib.suppress(OSError):
                holder = path.read_text(encoding="utf-8", errors="replace")
                message = (
                    f"{what} is being written by {holder or 'another process'}; "
                    "wait until that has ended, or give another path"
                )
                raise StoreError(message)
            message = f"{what} is being written by another process; run the command again"
            raise StoreError(message)
        path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")

    def release(self) -> None:
        """Release the lock."""
        if self._held is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._held)
            self._held = None

    def __del__(self) -> None:
        # A forgotten lock, such as after an exception.
        with contextlib.suppress(OSError, AttributeError):
            self.release()


def locked(folder: Path, name: str) -> Lock | None:
    """Take the lock of a folder, and remove leftovers of killed writers; None behind a URL."""
    if is_remote(folder):
        return None
    lock = Lock(folder / name, folder)
    sweep(folder)
    return lock


def _made(path: Path, *, folder: bool = False) -> int | None:
    """Make a file or folder and return the holder of its lock; None if another process has it."""
    for _ in range(_TRIES):  # who sweeps may have removed it between the two
        if folder:
            path.mkdir(exist_ok=True)
        else:
            path.touch()
        held = _locked(path)
        if held is not None or _fcntl is None:
            return held
    return None


def _locked(path: Path) -> int | None:
    """Return the holder of an existing file's lock; None if another process has it."""
    if _fcntl is None:
        return None
    try:
        held = os.open(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        _fcntl.flock(held, _fcntl.LOCK_EX | _fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(held), path.stat()):  # and not of a file removed since
            return held
    except OSError:
        pass
    os.close(held)
    return None


# --- the disk -----------------------------------------------------------------------------------


def free_disk(path: Path) -> int | None:
    """Return the free bytes of the disk of a path, which need not exist yet.

    None if there is no disk, as in /proc or behind a URL; writing there will show what is wrong.
    """
    if is_remote(path):
        return None
    existing = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    usage = shutil.disk_usage(existing)
    return usage.free if usage.total else None
