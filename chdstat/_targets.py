"""Targets: files to write, refused before the work where they cannot be, replaced as a whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from chdstat.errors import InputError

__all__ = ["checked_target", "replacing"]


def checked_target(path: str | Path, suffix: str) -> Path:
    """Return a path that a file can be written to.

    Raises
    ------
    InputError
        If it does not end in `suffix`, is a folder, or lies in none that can be written to.

    Examples
    --------
    >>> checked_target("picture.png", ".exr")
    Traceback (most recent call last):
        ...
    chdstat.errors.InputError: the path to write must end in .exr, got 'picture.png'
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


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside another, which it replaces when it is written, or not at all.

    It keeps the suffix, by which some writers tell what to write.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with replacing(Path(folder, "found.json")) as partial:
    ...         written = partial.write_text("[]")
    ...     [path.name for path in Path(folder).iterdir()]
    ['found.json']
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
