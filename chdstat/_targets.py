"""Targets: files that are to be written, refused before the work where they cannot be."""

from __future__ import annotations

import os
from pathlib import Path

from chdstat.errors import InputError

__all__ = ["checked_target"]


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
