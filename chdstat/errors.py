"""Errors that a user can act on, and codes of the reasons why a pixel has no number.

Every error that chdstat raises on purpose derives from `ChdstatError`: its message states what was
expected, what came, and what to do. The command line prints it without a traceback.

A pixel that cannot be computed is data: NaN in the result and a `Reason` beside it.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable

__all__ = [
    "ChdstatError",
    "ClusterError",
    "InputError",
    "InputWarning",
    "LeftOutWarning",
    "OtherSceneWarning",
    "Reason",
    "RenderError",
    "SceneError",
    "StoreError",
    "brief",
    "check_option",
    "check_probability",
]

_LONGEST = 600


class ChdstatError(Exception):
    """Base of all errors that chdstat raises on purpose."""


class ClusterError(ChdstatError):
    """A Dask cluster is lost, has no workers, or has workers of other versions."""


class InputError(ChdstatError, ValueError):
    """An argument has the wrong shape, type or range."""


class InputWarning(UserWarning):
    """Samples or files are not quite what they seem: repeated, converted, or read in part."""


class LeftOutWarning(UserWarning):
    """More than 1 % of the samples were left out of a result: bad ones, or negative ones."""


class OtherSceneWarning(UserWarning):
    """A model estimates samples that are not known to be of a scene that trained it."""


class SceneError(ChdstatError):
    """A scene cannot be found, read or understood."""


class RenderError(ChdstatError):
    """A scene was understood but cannot be rendered as asked."""


class StoreError(ChdstatError):
    """A sample store is missing, damaged, incomplete or belongs to something else."""


class Reason(enum.IntEnum):
    """Why a value is missing; `OK` where it is not."""

    OK = 0
    ALL_NULL = 1
    """Every good sample is null: there is nothing to fit."""
    TOO_FEW = 2
    """Fewer usable samples than the method needs."""
    CONSTANT = 3
    """The usable samples are equal, or too nearly so for the numbers at hand."""
    NOT_CONVERGED = 4
    """An iteration ended before its tolerance was met."""
    ALL_BAD = 5
    """Every sample is NaN or infinite."""
    AT_LIMIT = 6
    """The likelihood has no maximum: it rises towards a limit of the family. Of Burr, that is the
    Weibull distribution; of the generalised Pareto, one that ends at the largest sample."""
    NONE_POSITIVE = 7
    """No sample is positive, and some are negative: they have no logarithm."""
    TIED = 8
    """Samples share values: the largest, being clamped or rounded, or all, being a few atoms."""
    UNTESTED = 9
    """No test was asked for: there is a statistic and no p-value."""
    FEW_REPLICATES = 10
    """Fewer than half of the bootstrap replicates could be fitted: they are no p-value."""
    AT_PARETO_LIMIT = 11
    """No Burr distribution is as likely as a power law that begins at the smallest sample."""
    UNIDENTIFIED = 12
    """The samples do not decide: the answer rests on a tail that may be too heavy for it."""
    NOT_REGULAR = 13
    """The likelihood is not regular there, or has no curvature: there are no standard errors."""


def brief(error: BaseException) -> str:
    """Return what another library says, and why, for a message that quotes it.

    Of a long text, the middle is left out: the cause stands at its end.

    Examples
    --------
    >>> brief(RuntimeError("no such plugin"))
    'no such plugin'
    """
    text = " ".join(line.strip() for line in str(error).splitlines() if line.strip())
    text = text or type(error).__name__
    if error.__cause__ is not None and (why := brief(error.__cause__)) not in text:
        text = f"{text}: {why}"
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} ... {text[-half:]}"


def check_option(name: str, given: object, choices: Iterable[str]) -> None:
    """Refuse an option that is none of the choices there are.

    Raises
    ------
    InputError
        If it is none of them.

    Examples
    --------
    >>> check_option("scale", "cubic", ("linear", "log"))
    Traceback (most recent call last):
    chdstat.errors.InputError: scale must be one of linear, log, got 'cubic'
    """
    known = tuple(choices)
    if given not in known:
        message = f"{name} must be one of {', '.join(known)}, got {given!r}"
        raise InputError(message)


def check_probability(**options: float) -> None:
    """Refuse options, by name, that do not lie between 0 and 1.

    Raises
    ------
    InputError
        If one does not.

    Examples
    --------
    >>> check_probability(alpha=0.05, level=0.95)
    """
    for name, value in options.items():
        if not 0 < value < 1:
            message = f"{name} must lie between 0 and 1, got {value}"
            raise InputError(message)
