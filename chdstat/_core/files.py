"""Files: written whole or not at all, by one process at a time, in a folder or behind a URL.

A file or folder is first written beside its place, under a name that ends in ``.partial`` before
its suffix, and moved when it is complete. Its writer holds a lock on it (``flock``), which the
system releases whenever the process ends. A locked file thus belongs to a living process. An
unlocked one was left by a process that was killed, and the next process that writes to the same
place removes it. A URL names a place that fsspec reaches, where nothing is locked.

A `Cache` keeps results in ``.npz`` files until the samples or the code change: arrays by number,
and a tree in JSON that says where they belong. The caches of joblib and diskcache are shorter, but
hold pickles, which run code when they are read. A folder of renders must be safe to pass on.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import glob
import hashlib
import importlib
import importlib.metadata
import json
import math
import mmap
import os
import re
import shutil
import socket
import tempfile
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeGuard, cast, get_origin
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
import platformdirs
from upath import UPath

import chdstat
from chdstat._core.arrays import Result
from chdstat.errors import InputError, StoreError

if TYPE_CHECKING:
    from cattrs import Converter


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


def is_file(path: Path) -> bool:
    """Return whether there is a file; text that cannot be a path is not a file."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte
        return False


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
    StoreError
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


def trim() -> None:
    """Return freed memory to the system, where the C library keeps it: glibc does for each thread.

    What comes next may take as much in other places, such as the libraries of a denoiser.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


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
            holder = ""
            with contextlib.suppress(OSError):  # it may have ended just now
                holder = path.read_text(encoding="utf-8", errors="replace")
            message = (
                f"{what} is being written by {holder or 'another process'}; "
                "wait until that has ended, or give another path"
            )
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


@contextlib.contextmanager
def locked(folder: Path, name: str) -> Iterator[Lock | None]:
    """Lock a folder and remove leftovers of killed writers; None behind a URL.

    The caller releases the lock. An error within releases it, even while a traceback is kept.
    """
    if is_remote(folder):
        yield None
        return
    lock = Lock(folder / name, folder)
    try:
        sweep(folder)
        yield lock
    except BaseException:
        lock.release()
        raise


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


_ARRAY = "array number"


def write_record(path: Path, value: Any) -> Path:
    """Write results; an existing file is replaced when the new one is complete.

    Parameters
    ----------
    path
        An ``.npz`` file.
    value
        A dataclass, or tuples and mappings of dataclasses. Single NumPy numbers become Python's.

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


def read_record(path: Path, kind: type[Result]) -> Result:
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
    except (OSError, EOFError, KeyError, ValueError, BadZipFile, BaseValidationError) as error:
        message = f"{path} is no record of {kind}: {error}"
        raise StoreError(message) from error


@functools.cache
def _converter() -> Converter:
    from cattrs import Converter

    # A type that cannot be in a record may still be the type of an empty mapping's values.
    converter = Converter(structure_fallback_factory=lambda _: _refused, forbid_extra_keys=True)
    # Arrays are found while the tree is read.
    converter.register_structure_hook_func(
        _is_array,
        lambda item, kind: item if isinstance(item, np.ndarray) else _refused(item, kind),
    )
    return converter


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _refused(item: Any, kind: Any) -> Any:
    message = f"expected {kind}, got {type(item).__name__}"
    raise ValueError(message)


_LIBRARIES = ("numpy", "scipy", "scikit-learn", "statsmodels", "torch", "pyoidn")
"""Packages whose numbers are kept; without the last one, a denoiser, some are missing."""


@functools.cache
def code_digest() -> str:
    """Return a digest of all code behind the numbers: results of other code are not read."""
    digest = hashlib.sha256(repr([installed(name) for name in _LIBRARIES]).encode())
    package = Path(chdstat.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def digest_of(value: object) -> str:
    """Return a short digest of a value with a `repr` that identifies it."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def installed(package: str) -> str:
    """Return the version of an installed package; "" if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def user_cache() -> Path:
    """Return the folder of the user's cache, whose content can be computed again."""
    return platformdirs.user_cache_path("chdstat", appauthor=False)


@contextlib.contextmanager
def checkpoints(
    folder: str | Path | None, identify: Callable[[], str], *inputs: object
) -> Iterator[Cache | None]:
    """Yield a keeper of the parts of a long computation; they are removed when it is complete.

    Parameters
    ----------
    folder
        Folder of the parts; None keeps nothing.
    identify
        Returns a text that identifies the samples.
    inputs
        Other inputs of the result, with a `repr` that identifies them.

    Examples
    --------
    >>> with scratch() as folder:
    ...     with checkpoints(folder / "parts", lambda: "box-32", 0.05) as kept:
    ...         found = kept.record("first", int, lambda: 1 + 1)
    ...     found, (folder / "parts").exists()
    (2, False)
    """
    if folder is None:
        yield None
        return
    # Workers of a cluster also write to it, from folders of their own.
    place = Path(folder).absolute()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot keep checkpoints in {place}: {error.strerror}; give another folder"
        raise StoreError(message) from error
    try:
        yield Cache(place, f"{_CHECKPOINT}{identify()}-{digest_of(inputs)}")
    except BaseException:
        with contextlib.suppress(OSError):
            place.rmdir()  # if nothing was kept
        raise
    if place not in _held:
        _clear(place)


_CHECKPOINT = "checkpoint-"
_held: set[Path] = set()
"""Folders whose checkpoints stay until the result is written."""


@contextlib.contextmanager
def kept_until_written(out: Path | None) -> Iterator[Path | None]:
    """Yield the folder of the checkpoints of an output, which stay while the context lasts."""
    place = None if out is None else beside(out).absolute()
    if place is None:
        yield None
        return
    _held.add(place)
    try:
        yield place
    except InputError:  # the same again would fail again
        _clear(place)
        raise
    finally:
        _held.discard(place)
    _clear(place)


def beside(out: Path) -> Path:
    """Return the folder of the checkpoints of a future file or folder."""
    return out.with_name(f"{out.name}.checkpoint")


def _clear(place: Path) -> None:
    """Remove checkpoints, and their folder unless it holds anything else."""
    for pattern in (f"{_CHECKPOINT}*.npz", f".{_CHECKPOINT}*.partial.npz"):
        for file in place.glob(pattern):
            remove(file)
    with contextlib.suppress(OSError):
        place.rmdir()


class Cache:
    """Results computed from one store, kept in a folder until the samples or the code change.

    A damaged result is computed again. A cache that cannot be written costs time and is not an
    error.

    Parameters
    ----------
    folder
        Folder of the results; None keeps nothing.
    key
        Text that identifies the samples; "", as for samples in memory, keeps nothing.
    most
        Most files in the folder; the oldest are deleted. None for any number.

    Examples
    --------
    >>> with scratch() as folder:
    ...     cache = Cache(folder, "box-32")
    ...     cache.record("sum", int, lambda: 1 + 1), cache.record("sum", int, lambda: 1 / 0)
    (2, 2)
    """

    def __init__(self, folder: Path | None, key: str, *, most: int | None = None) -> None:
        self.folder, self._key, self._most = folder if key else None, key, most

    def record(
        self,
        name: str,
        kind: type[Result],
        compute: Callable[[], Result],
        *,
        inputs: object = (),
        again: bool = False,
    ) -> Result:
        """Return a result of a kind that `write_record` takes; compute it if it is not there.

        Parameters
        ----------
        name, inputs
            Name of the result, and its other inputs, with a `repr` that identifies them.
        kind
            Type of the result, such as ``tuple[Finding, ...]``.
        compute
            Returns the result.
        again
            Compute it even if it is there.
        """
        found = None if again else self.recall(name, kind, inputs=inputs)
        if found is not None:
            return found
        value = compute()
        self.write(_file(name, inputs), lambda path: write_record(path, value))
        # As it will be read, so that its source does not matter.
        back = self.recall(name, kind, inputs=inputs)
        return value if back is None else back

    def recall(self, name: str, kind: type[Result], *, inputs: object = ()) -> Result | None:
        """Return what `record` kept; None if it is not there, or damaged."""
        return self.read(_file(name, inputs), lambda path: read_record(path, kind))

    def read(self, name: str, read: Callable[[Path], Result]) -> Result | None:
        """Read a result by its name with a suffix; None if it is not there, or damaged."""
        path = self._path(name)
        if path is None:
            return None
        try:
            return read(path)
        except (OSError, KeyError, ValueError, RuntimeError, StoreError):
            return None

    def write(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a result in place of an existing one, and of results of other code."""
        path = self._path(name)
        if path is None:
            return
        any_code = glob.escape(path.stem.removesuffix(code_digest()))
        for old in path.parent.glob(f"{any_code}*{path.suffix}"):
            remove(old)
        with contextlib.suppress(OSError, StoreError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
            files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda f: -f.stat().st_mtime)
            for old in files[self._most :] if self._most else ():
                remove(old)

    def _path(self, name: str) -> Path | None:
        if self.folder is None:
            return None
        file = PurePath(name)
        return self.folder / f"{self._key}-{file.stem}-{code_digest()}{file.suffix}"


def _file(name: str, inputs: object) -> str:
    return f"{name}-{digest_of(inputs)}.npz"
