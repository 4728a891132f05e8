"""Errors that a user can act on, and codes of the reasons why a pixel has no number.

Every error that chdstat raises on purpose derives from `ChdstatError`. Its message says what was
expected, what was given, and what to do. The command line prints it without a traceback.

A pixel that cannot be computed is not an error: its result is NaN, with a `Reason`.
"""

from __future__ import annotations

import difflib
import enum
import re
from collections.abc import Iterable

_LONGEST = 600
_MANY = 12
"""Most names that a message lists in full."""
_SEPARATOR = re.compile("[ -]")


class ChdstatError(Exception):
    """Base of all errors that chdstat raises on purpose."""


class ClusterError(ChdstatError):
    """A Dask cluster is lost, has no workers, or has workers of other versions."""


class InputError(ChdstatError, ValueError):
    """An argument has the wrong shape, type or range."""


class InputWarning(UserWarning):
    """Samples or files are not quite what they seem: repeated, converted, or read in part."""


class LeftOutWarning(UserWarning):
    """More than 1 % of the samples were left out of a result: bad or negative ones."""


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
    """There are fewer usable samples than the method needs."""
    CONSTANT = 3
    """The usable samples are equal, or too nearly equal for floating point."""
    NOT_CONVERGED = 4
    """An iteration ended before its tolerance was met."""
    ALL_BAD = 5
    """Every sample is NaN or infinite."""
    AT_LIMIT = 6
    """The likelihood has no maximum: it rises towards a limit of the family, for Burr a Weibull
    distribution."""
    NONE_POSITIVE = 7
    """No sample is positive and some are negative, so that there are no logarithms."""
    TIED = 8
    """Samples share values: the largest was clamped or rounded, or all samples are a few values."""
    UNTESTED = 9
    """No test was asked for: there is a statistic but no p-value."""
    FEW_REPLICATES = 10
    """Fewer than half of the bootstrap replicates could be fitted: too few for a p-value."""
    AT_PARETO_LIMIT = 11
    """A power law that begins at the smallest sample is likelier than any Burr distribution."""
    UNIDENTIFIED = 12
    """The samples do not decide: the tail may be too heavy for an answer."""
    NOT_REGULAR = 13
    """The likelihood is not regular or has no curvature there: there are no standard errors."""
    OUTSIDE = 14
    """Most samples lie outside of the support of the histogram, and their shape with them."""
    EDGE = 15
    """The edge of a mode lies among the largest samples: no tail index describes them."""


def brief(error: BaseException) -> str:
    """Return another library's error and its cause, for a message that quotes it.

    The middle of a long text is left out: the cause stands at its end.

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


def check_option(
    name: str, given: object, choices: Iterable[str], *, more: str = "its documentation"
) -> None:
    """Refuse an option that is not one of the choices; the message names the closest one.

    Parameters
    ----------
    name
        Name of the option.
    given, choices
        Its value, and the choices.
    more
        Where to find all choices, if they are too many for a message.

    Raises
    ------
    InputError
        If the value is not one of the choices.

    Examples
    --------
    >>> check_option("scale", "cubic", ("linear", "log"))
    Traceback (most recent call last):
    chdstat.errors.InputError: scale must be one of linear, log, got 'cubic'
    >>> check_option("scale", "lin", ("linear", "log"))
    Traceback (most recent call last):
    chdstat.errors.InputError: scale must be one of linear, log, got 'lin'; did you mean 'linear'?
    """
    known = tuple(choices)
    if given in known:
        return
    message = f"{name} must be one of {', '.join(known)}, got {given!r}"
    near = did_you_mean(given, known)
    if len(known) > _MANY:
        message = f"no {name} is called {given!r}"
        near = near or f"; {more} shows all {len(known)}"
    message += near
    raise InputError(message)


def did_you_mean(given: object, choices: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the closest known names, if any.

    Examples
    --------
    >>> did_you_mean("Trimmed mean", ["mean", "trimmed_mean"]), did_you_mean("x", ["mean"])
    ("; did you mean 'trimmed_mean'?", '')
    """
    named = {_SEPARATOR.sub("_", name.casefold()): name for name in choices}
    text = _SEPARATOR.sub("_", str(given)[:_LONGEST].casefold())
    near = difflib.get_close_matches(text, named, n=1, cutoff=0.65)
    near = near or [name for name in named if text in name and len(text) > 2]
    shown = " or ".join(repr(named[name]) for name in near[:3])
    return f"; did you mean {shown}?" if near else ""


def check_probability(**options: float) -> None:
    """Refuse options that do not lie between 0 and 1.

    Raises
    ------
    InputError
        If one does not; the message gives its name.

    Examples
    --------
    >>> check_probability(alpha=0.05, level=0.95)
    """
    for name, value in options.items():
        if not 0 < value < 1:
            message = f"{name} must lie between 0 and 1, got {value}"
            raise InputError(message)
