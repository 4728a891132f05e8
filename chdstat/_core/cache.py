"""Cache: results that were computed from a store, kept until the samples or the code change.

Records are results, dataclasses of numbers, words and arrays, in an ``.npz`` file: arrays by
number, and a tree in JSON that says where they belong. Unlike a pickle, nothing in it runs when it
is read: a folder of renders can be passed on. `code_digest` identifies the code and the libraries
that computed a result, so that a cache is not read by other code.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import hashlib
import importlib.metadata
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._core.files import remove, writing
from chdstat.errors import StoreError

if TYPE_CHECKING:
    from cattrs import Converter

__all__ = ["Cache", "beside", "checkpoints", "installed", "kept_until_written", "user_cache"]

T = TypeVar("T")

_ARRAY = "array number"


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
    converter.register_structure_hook_func(
        _is_array, lambda item, kind: item if isinstance(item, np.ndarray) else _refused(item, kind)
    )
    return converter


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _refused(item: Any, kind: Any) -> Any:
    message = f"expected {kind}, got {type(item).__name__}"
    raise ValueError(message)


_LIBRARIES = ("numpy", "scipy", "scikit-learn", "statsmodels", "torch", "pyoidn")
"""Whose numbers are kept; without the last one, a denoiser, some are missing."""


@functools.cache
def code_digest() -> str:
    """Return a digest of all code that numbers rest on: what other code computed is not read."""
    digest = hashlib.sha256(repr([installed(name) for name in _LIBRARIES]).encode())
    package = Path(chdstat.__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def installed(package: str) -> str:
    """Return the version of an installed package, "" of one that is not there."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def user_cache() -> Path:
    """Return the folder of the user's cache, which holds what may be computed again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "chdstat")


@contextlib.contextmanager
def checkpoints(
    folder: str | Path | None, identify: Callable[[], str], *inputs: object
) -> Iterator[Cache | None]:
    """Yield what keeps the parts of a long computation until it is whole, then removes them.

    Parameters
    ----------
    folder
        Where; None keeps nothing.
    identify
        Returns what identifies the samples.
    inputs
        What else the result depends on, with a `repr` that identifies it.

    Examples
    --------
    >>> from chdstat._core.files import scratch
    >>> with scratch() as folder:
    ...     with checkpoints(folder / "parts", lambda: "box-32", 0.05) as kept:
    ...         found = kept.record("first", int, lambda: 1 + 1)
    ...     found, (folder / "parts").exists()
    (2, False)
    """
    if folder is None:
        yield None
        return
    # Workers of a cluster write to it, too, from folders of their own.
    place, options = Path(folder).absolute(), hashlib.sha256(repr(inputs).encode()).hexdigest()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot keep checkpoints in {place}: {error.strerror}; give another folder"
        raise StoreError(message) from error
    try:
        yield Cache(place, f"{_CHECKPOINT}{identify()}-{options[:12]}")
    except BaseException:
        with contextlib.suppress(OSError):
            place.rmdir()  # if nothing was kept
        raise
    if place not in _held:
        _clear(place)


_CHECKPOINT = "checkpoint-"
_held: set[Path] = set()
"""Folders whose checkpoints stay until what was computed is written."""


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
    finally:
        _held.discard(place)
    _clear(place)


def beside(out: Path) -> Path:
    """Return the folder of the checkpoints of what becomes a file or folder."""
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
    >>> from chdstat._core.files import scratch
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
