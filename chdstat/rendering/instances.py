"""Integrators that are given as objects of Mitsuba's, for renders in this process."""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, cast

import numpy as np

from chdstat.errors import InputError
from chdstat.rendering.backend import BACKENDS, Backend, Verdict
from chdstat.scenes.plugins import code_of

__all__ = ["IntegratorObject", "own_backend", "told"]

_UNLIMITED = 2**32 - 1
"""What Mitsuba's integrators print of a max_depth of -1."""
_LONGEST = 16
"""Numbers of an array that are told; of longer ones, a digest is."""
_PLAIN = (str, bool, int, float)
_ELSEWHERE = (
    "an integrator that is an object can only render in this process; for other ones, give it as a "
    "dict, and register a class of your own in a plugin (chdstat.scenes.load_plugin)"
)


@dataclass(frozen=True, eq=False)
class IntegratorObject:
    """An integrator that was made by Mitsuba, or of a class of the user's own.

    It is pickled to no other process.

    Attributes
    ----------
    value
        The object.
    """

    value: Any

    @classmethod
    def of(cls, value: Any, backend: str, color: str, max_depth: int | None) -> IntegratorObject:
        """Return an integrator that can render with a backend, "auto" for its own.

        Raises
        ------
        InputError
            If it is of another variant, or its path length is asked to be changed.
        """
        made = cls(value)
        own_backend(f"integrator is a {made.kind}", value, backend, color)
        if max_depth is not None:
            message = (
                f"max_depth={max_depth} cannot be given to a {made.kind} that is there already; "
                "make the integrator with it, or give it as a dict"
            )
            raise InputError(message)
        return made

    @property
    def kind(self) -> str:
        """Name of its class."""
        return type(self.value).__qualname__ if self.in_python else str(self.value.class_name())

    @property
    def in_python(self) -> bool:
        """Whether its class is written in Python."""
        return not type(self.value).__module__.startswith("mitsuba")

    @property
    def backend(self) -> str:
        """The backend of its variant."""
        return str(self.value.variant_name()).partition("_")[0]

    @property
    def code(self) -> dict[str, str]:
        """Digest of its code by the name of its class, where that is written in Python."""
        return code_of([self.value]) if self.in_python else {}

    @property
    def description(self) -> dict[str, Any]:
        """Its class and settings, ready for JSON: those that it prints, traverses and holds."""
        import mitsuba as mi

        settings: dict[str, Any] = {"type": self.kind}
        if self.in_python:
            settings |= vars(self.value)
        else:
            settings |= {name: _number(text) for name, text in _printed(str(self.value))}
        with contextlib.suppress(RuntimeError, TypeError):  # a class that does not say
            settings |= dict(mi.traverse(self.value))
        return told(settings)

    def __reduce__(self) -> NoReturn:
        raise InputError(_ELSEWHERE)


def own_backend(what: str, value: Any, backend: str, color: str) -> Backend:
    """Return the backend of the variant in which an object of Mitsuba's was made.

    Raises
    ------
    InputError
        If another one than that is asked for, or another colour.
    """
    own = str(value.variant_name())
    wanted = Verdict(own.partition("_")[0] if backend == "auto" else backend, True, "", color=color)
    if wanted.backend not in BACKENDS or own != wanted.variant:
        message = (
            f"{what} of the variant {own}, which cannot render with the {wanted.backend} backend "
            f"in {color}; make it in the variant of these (see mitsuba.set_variant), give backend "
            "and color of its own, or give it as a dict"
        )
        raise InputError(message)
    return cast("Backend", wanted.backend)


def _printed(text: str) -> list[tuple[str, str]]:
    r"""Return the settings that an object of Mitsuba's prints.

    Examples
    --------
    >>> _printed("PathIntegrator[\n  max_depth = 4,\n  rr_depth = 5\n]")
    [('max_depth', '4'), ('rr_depth', '5')]
    """
    return re.findall(r"^\s*(\w+) = (.*?),?$", text, re.MULTILINE)


def _number(text: str) -> str | int | float:
    if text.isdecimal():
        return -1 if int(text) == _UNLIMITED else int(text)
    with contextlib.suppress(ValueError):
        return float(text)
    return text


def told(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings ready for JSON: texts, numbers and arrays; parts with others are left out."""
    found = {name: _told(value) for name, value in settings.items()}
    return {name: value for name, value in found.items() if value is not None}


def _told(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, _PLAIN):
        return value
    with contextlib.suppress(TypeError, ValueError, RuntimeError):
        array = np.asarray(value.matrix if "Transform" in type(value).__name__ else value)
        if array.dtype.kind in "biuf":
            if array.size <= _LONGEST and np.isfinite(array).all():
                return array.tolist()
            return "SHA-256 " + hashlib.sha256(array.tobytes()).hexdigest()[:16]
    return None
