"""Doors: what results ask of outer rings of the package, which they do not import.

A result draws itself by `draw`; outer rings register how, for each type of result. The package,
which stands outside of all rings, says in its ``__init__`` which module does.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import chdstat
from chdstat.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")


class Door(Generic[T]):
    """A function of results, which an outer ring implements for each of their types.

    Parameters
    ----------
    name
        Name in `chdstat.DOORS`, which has the module that registers implementations: the first call
        imports it.
    done
        What is done to a result, for errors.

    Examples
    --------
    >>> weigh = Door("weigh", "weighed")
    >>> weigh.register(int, lambda number, *, unit: f"{number} {unit}")
    >>> weigh(3, unit="kg")
    '3 kg'
    >>> weigh("feathers")
    Traceback (most recent call last):
    chdstat.errors.InputError: expected what can be weighed, a result int, got str
    """

    def __init__(self, name: str, done: str) -> None:
        self._name, self._done = name, done
        self._known = functools.singledispatch(self._refused)

    def register(self, kind: type, function: Callable[..., T]) -> None:
        """Register what a type of results is given to."""
        self._known.register(kind, function)

    def __call__(self, result: object, *given: Any, **options: Any) -> T:
        """Call what is registered for the type of a result.

        Raises
        ------
        InputError
            If nothing is.
        """
        if self._name in chdstat.DOORS:
            importlib.import_module(f"chdstat.{chdstat.DOORS[self._name]}")
        return self._known(result, *given, **options)

    def _refused(self, result: object, *_: Any, **__: Any) -> T:
        kinds = sorted(kind.__name__ for kind in self._known.registry if kind is not object)
        message = (
            f"expected what can be {self._done}, a result {', '.join(kinds)}, "
            f"got {type(result).__name__}"
        )
        raise InputError(message)


draw: Door[Figure] = Door("draw", "drawn")
"""Draw a result; takes its options, and returns the figure."""
report: Door[Path] = Door("report", "typeset as a report")
"""Typeset a result as PDF; takes the path, and returns it."""
read_reference: Door[Any] = Door("read_reference", "read as a reference")
"""Return the `chdstat.inference.Reference` in a file; takes the options of `Reference.read`."""
pixel_of: Door[Any] = Door("pixel_of", "looked at pixel by pixel")
"""Return the `chdstat.patterns.Pixel` of samples at row y and column x."""
regions_of: Door[Any] = Door("regions_of", "looked at region by region")
"""Return the `chdstat.patterns.Regions` of samples at places by name."""
classified: Door[Any] = Door("classified", "classified")
"""Return the dataset of `chdstat.classify` of samples."""
untrusted: Door[Any] = Door("untrusted", "looked at for variances that cannot be trusted")
"""Return where the variance of the luminance of samples cannot be trusted, shape (y, x)."""
