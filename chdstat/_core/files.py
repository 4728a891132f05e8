"""Files: written whole or not at all, by one process at a time, and known by their checksums.

A file or folder is written beside its place, under a name that ends in ``.partial`` but for its
suffix, and moved there when it is complete. Its writer holds a lock on it (``flock``), which the
system releases when a process ends in whatever way. So a locked file belongs to a living process;
one that is not is left over from a process that was killed, and the next one that writes to the
same place removes it.

Records are results, dataclasses of numbers, words and arrays, in an ``.npz`` file: arrays by
number, and a tree in JSON that says where they belong. Unlike a pickle, nothing in it runs when it
is read: a folder of renders can be passed on. `Cache` keeps records, and results in other formats,
until the samples or the code change, which `code_digest` identifies together with the libraries.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import hashlib
import importlib
import importlib.metadata
import json
import os
import shutil
import socket
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat.errors import InputError, StoreError

if TYPE_CHECKING:
    from cattrs import Converter

__all__ = [
    "Cache",
    "Lock",
    "checked_target",
    "checksum",
    "free_disk",
    "read_record",
    "replacing",
    "scratch",
    "sweep",
    "unused",
    "user_cache",
    "write_record",
    "writing",
]

T = TypeVar("T")

_fcntl: Any = importlib.import_module("fcntl") if os.name == "posix" else None
"""Windows has no flock: nothing is locked there, and nothing swept."""
_ARRAY = "array number"
_TRIES = 8
"""How often a file that vanishes while it is being locked is made again."""


def checksum(data: bytes) -> int:
    """Return the CRC-32C of bytes: it tells of accidents, not of forgery.

    Examples
    --------
    >>> hex(checksum(b"123456789"))  # the check value of RFC 3720, appendix B.4
    '0xe3069283'
    """
    import google_crc32c

    return int(google_crc32c.value(data))


# --- outputs ------------------------------------------------------------------------------------


def checked_target(path: str | Path, suffix: str) -> Path:
    """Return a path that a file can be written to.

    Raises
    ------
    InputError
        If it does not end in `suffix`, is a folder, or lies in none that can be written to.

    Examples
    --------
    >>> checked_target("image.png", ".exr")
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: the path to write must end in .exr, got 'image.png'
    """
    target = Path(path)
    if target.suffix.lower() != suffix:
        message = f"the path to write must end in {suffix}, got {str(target)!r}"
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
    target = Path(path)
    if target.exists():
        message = f"{target} exists; nothing was overwritten. Give another path or move it away"
        raise StoreError(message)
    return target


@contextlib.contextmanager
def replacing(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yield a path beside another, which it replaces when it is written, or not at all.

    It keeps the suffix, by which some writers tell what to write. With ``folder=True`` it is an
    empty folder, else an empty file. What killed processes left beside `path` is removed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder, "found.json")) as partial:
    ...         written = partial.write_text("[]")
    ...     [path.name for path in Path(folder).iterdir()]
    ['found.json']
    """
    sweep(path.parent, path)
    with _partial(path, folder=folder) as partial:
        yield partial
        partial.replace(path)


@contextlib.contextmanager
def writing(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yield a path as `replacing` does; a StoreError says why it cannot be written."""
    try:
        with replacing(path, folder=folder) as partial:
            yield partial
    except OSError as error:
        message = f"cannot write {path}: {error.strerror or error}"
        raise StoreError(message) from error


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield a temporary folder, removed at the end, or by the next one if this process is killed.

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
    """Remove what killed processes left in a folder: of one output, or of all, also further down.

    What is locked belongs to a process that is alive, and stays.
    """
    if _fcntl is None:
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
            _remove(leftover)
            os.close(held)


@contextlib.contextmanager
def _partial(path: Path, *, folder: bool) -> Iterator[Path]:
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.partial{path.suffix}")
    held = _made(partial, folder=folder)
    try:
        yield partial
    finally:
        _remove(partial)
        if held is not None:
            os.close(held)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


# --- locks --------------------------------------------------------------------------------------


class Lock:
    """Exclusive use of a place, told by a file that the process holds locked while it is there.

    A process that is killed leaves the file but not the lock, and the next one takes it.

    Parameters
    ----------
    path
        The file; it is removed when the lock is released.
    what
        What it keeps, for the message.

    Raises
    ------
    StoreError
        If another holds it.
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
        """Let others have it."""
        if self._held is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._held)
            self._held = None

    def __del__(self) -> None:
        # One that was forgotten, by an exception on its way up.
        with contextlib.suppress(OSError, AttributeError):
            self.release()


def _made(path: Path, *, folder: bool = False) -> int | None:
    """Make a file or folder, and return what holds its lock; None where another process has it."""
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
    """Return what holds the lock of a file that is there; None where another process has it."""
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
    """Return the free bytes of the disk that a path, which need not exist yet, would be on.

    None where there is no disk, as in /proc: whoever writes there learns what is wrong.
    """
    existing = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    usage = shutil.disk_usage(existing)
    return usage.free if usage.total else None


# --- records ------------------------------------------------------------------------------------


def write_record(path: Path, value: Any) -> Path:
    """Write results; what was there is replaced when the new file is complete.

    Parameters
    ----------
    path
        An ``.npz`` file.
    value
        A dataclass, or tuples and mappings of such. Numbers of NumPy that stand alone become
        Python's.

    Raises
    ------
    StoreError
        If it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from chdstat._core.resampling import Interval
    >>> found = Interval(*np.arange(6.0).reshape(3, 2))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_record(Path(folder, "found.npz"), {"mse": found})
    ...     read_record(path, dict[str, Interval[npt.NDArray[Any]]])["mse"].high
    array([4., 5.])
    """
    arrays: list[npt.NDArray[Any]] = []

    def written(item: Any) -> Any:
        if isinstance(item, np.ndarray) and not item.dtype.hasobject:
            arrays.append(item)
            return {_ARRAY: len(arrays) - 1}
        if isinstance(item, np.generic):
            return item.item()
        message = f"a record holds numbers, words and arrays, not {type(item).__name__}"
        raise TypeError(message)

    tree = json.dumps(_converter().unstructure(value), default=written)
    with writing(path) as partial, partial.open("wb") as file:
        np.savez(file, *arrays, tree=np.array(tree))
    return path


_DAMAGED = (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile)
"""What reading arrays raises where a file is damaged."""


def read_record(path: Path, kind: type[T]) -> T:
    """Read results of a kind, such as ``tuple[Finding, ...]``.

    Raises
    ------
    StoreError
        If the file is missing or damaged, or holds something else.
    """
    from cattrs.errors import BaseValidationError

    try:
        with np.load(path, allow_pickle=False) as file:

            def found(item: dict[str, Any]) -> Any:
                return file[f"arr_{item[_ARRAY]}"] if item.keys() == {_ARRAY} else item

            tree = json.loads(str(file["tree"]), object_hook=found)
        return _converter().structure(tree, kind)
    except (*_DAMAGED, BaseValidationError) as error:
        message = f"{path} is no record of {kind}: {error}"
        raise StoreError(message) from error


@functools.cache
def _converter() -> Converter:
    from cattrs import Converter

    # What cannot be in a record can still be a type of what an empty mapping would hold.
    converter = Converter(structure_fallback_factory=lambda _: _refused)
    # Arrays are found while the tree is read.
    converter.register_structure_hook_func(_is_array, _checked)
    return converter


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _checked(item: Any, kind: Any) -> Any:
    return item if isinstance(item, np.ndarray) else _refused(item, kind)


def _refused(item: Any, kind: Any) -> Any:
    message = f"expected {kind}, got {type(item).__name__}"
    raise ValueError(message)


_LIBRARIES = ("numpy", "scipy", "scikit-learn", "statsmodels", "torch", "pyoidn")
"""Whose numbers are kept; without the last one, a denoiser, some are missing."""


@functools.cache
def code_digest() -> str:
    """Return a digest of all code that numbers rest on: what other code computed is not read."""
    digest = hashlib.sha256(repr([_version(name) for name in _LIBRARIES]).encode())
    package = Path(chdstat.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return ""


# --- the cache ----------------------------------------------------------------------------------


def user_cache() -> Path:
    """Return the folder of the user's cache, which holds what may be computed again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "chdstat")


class Cache:
    """Results computed from one store, kept in a folder until the samples or the code change.

    A result that is damaged is computed again. A cache that cannot be written costs time and is no
    error.

    Parameters
    ----------
    folder
        Where results are kept; None keeps nothing.
    key
        What identifies the samples; "", as of samples in memory, keeps nothing.
    most
        Files in the folder, at most: the oldest are deleted. None for any number.

    Examples
    --------
    >>> with scratch() as folder:
    ...     cache = Cache(folder, "box-32")
    ...     cache.record("sum", int, lambda: 1 + 1), cache.record("sum", int, lambda: 1 / 0)
    (2, 2)
    """

    def __init__(self, folder: Path | None, key: str, *, most: int | None = None) -> None:
        self._folder, self._key, self._most = folder if key else None, key, most

    def record(
        self,
        name: str,
        kind: type[T],
        compute: Callable[[], T],
        *,
        inputs: object = (),
        again: bool = False,
    ) -> T:
        """Return a result of a kind that `write_record` takes, computed where it is not there.

        Parameters
        ----------
        name, inputs
            What it is, and what else it depends on, with a `repr` that identifies it.
        kind
            Its type, such as ``tuple[Finding, ...]``.
        compute
            Returns it.
        again
            Compute it though it is there.
        """
        name = f"{name}-{hashlib.sha256(repr(inputs).encode()).hexdigest()[:12]}.npz"
        found = None if again else self.read(name, lambda path: read_record(path, kind))
        if found is not None:
            return found
        value = compute()
        self.write(name, lambda path: write_record(path, value))
        # As it will be read, so that it does not matter where it comes from.
        back = self.read(name, lambda path: read_record(path, kind))
        return value if back is None else back

    def read(self, name: str, read: Callable[[Path], T]) -> T | None:
        """Read a result by its name with a suffix; None where it is not there, or damaged."""
        path = self._path(name)
        if path is None:
            return None
        try:
            return read(path)
        except (OSError, KeyError, ValueError, RuntimeError, StoreError):
            return None

    def write(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a result in place of what is there, and of what other code kept."""
        path = self._path(name)
        if path is None:
            return
        any_code = glob.escape(path.stem.removesuffix(code_digest()))
        for old in path.parent.glob(f"{any_code}*{path.suffix}"):
            _remove(old)
        with contextlib.suppress(OSError, StoreError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
            files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda f: -f.stat().st_mtime)
            for old in files[self._most :] if self._most else ():
                _remove(old)

    def _path(self, name: str) -> Path | None:
        if self._folder is None:
            return None
        file = PurePath(name)
        return self._folder / f"{self._key}-{file.stem}-{code_digest()}{file.suffix}"
