"""Errors that a user can act on.

Every error that chdstat raises on purpose derives from `ChdstatError`: its message states what was
expected, what came, and what to do. The command line prints it without a traceback.
"""

from __future__ import annotations

__all__ = [
    "ChdstatError",
    "InputError",
    "LeftOutWarning",
    "RenderError",
    "SceneError",
    "StoreError",
    "brief",
]

_LONGEST = 600


class ChdstatError(Exception):
    """Base of all errors that chdstat raises on purpose."""


class InputError(ChdstatError, ValueError):
    """An argument has the wrong shape, type or range."""


class LeftOutWarning(UserWarning):
    """More than 1 % of the samples were left out of a result: bad ones, or negative ones."""


class SceneError(ChdstatError):
    """A scene cannot be found, read or understood."""


class RenderError(ChdstatError):
    """A scene was understood but cannot be rendered as asked."""


class StoreError(ChdstatError):
    """A sample store is missing, damaged, incomplete or belongs to something else."""


def brief(error: BaseException) -> str:
    """Return the first lines of what another library says, for a message that quotes it.

    Examples
    --------
    >>> brief(RuntimeError("no such plugin"))
    'no such plugin'
    """
    text = " ".join(line.strip() for line in str(error).splitlines()[:3])
    return (
        text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    )
