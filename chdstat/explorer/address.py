"""Address: the view that the query of a page's address asks for.

`View.query` writes it. What cannot be followed is said, and the rest is followed nevertheless.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from chdstat.errors import InputError
from chdstat.explorer.view import OPTIONS, View, check_pixel

__all__ = ["parse_view"]


def parse_view(
    arguments: Mapping[str, Sequence[str]], height: int, width: int
) -> tuple[View, list[str]]:
    """Return the view that an address asks for, and what of it could not be followed.

    Parameters
    ----------
    arguments
        The values of each name in the query.
    height, width
        Size of the image in pixels.

    Examples
    --------
    >>> parse_view({"p": ["1,2", "99,2"], "n": ["64"]}, 8, 8)[1]
    ['pixel (y=99, x=2) is outside the image of 8 x 8 pixels']
    """
    view, notes = View(), list[str]()
    for step in _steps(arguments, height, width):
        try:
            view = step(view)
        except InputError as error:
            notes.append(str(error))
    unknown = arguments.keys() - OPTIONS.keys() - {"p", "r", "a"}
    notes += [f"the address has {name!r}, which means nothing here" for name in sorted(unknown)]
    return view, notes


def _steps(
    arguments: Mapping[str, Sequence[str]], height: int, width: int
) -> Iterator[Callable[[View], View]]:
    """Yield the steps that lead to the view of an address; each may refuse."""
    for text in arguments.get("p", ()):
        yield partial(_picked, text=text, height=height, width=width)
    for text in arguments.get("r", ())[:1]:
        yield partial(_boxed, text=text, height=height, width=width)
    for text in arguments.get("a", ())[:1]:
        yield partial(_activated, text=text)
    for key in sorted(arguments.keys() & OPTIONS.keys()):
        yield partial(_set, name=OPTIONS[key], text=arguments[key][0])


def _picked(view: View, *, text: str, height: int, width: int) -> View:
    y, x = _integers(text, 2)
    check_pixel(y, x, height, width)
    return view if (y, x) in view.pixels else view.pick(y, x, add=True)


def _boxed(view: View, *, text: str, height: int, width: int) -> View:
    top, left, bottom, right = _integers(text, 4)
    if not (0 <= top < bottom <= height and 0 <= left < right <= width):
        message = f"region {text} is not inside the image of {width} x {height} pixels"
        raise InputError(message)
    return view.box((top, left, bottom, right))


def _activated(view: View, *, text: str) -> View:
    return view.activate(_integers(text, 1)[0])


def _set(view: View, *, name: str, text: str) -> View:
    return view.changed(**{name: _read(name, text)})


def _integers(text: str, count: int) -> tuple[int, ...]:
    parts = text.split(",")
    if len(parts) != count or not all(p.strip().isascii() and p.strip().isdigit() for p in parts):
        message = f"expected {count} whole number(s) in the address, got {text!r}"
        raise InputError(message)
    if any(len(p.strip()) > 9 for p in parts):
        message = f"expected numbers of at most 9 digits in the address, got {text!r}"
        raise InputError(message)
    return tuple(int(p) for p in parts)


def _read(name: str, text: str) -> Any:
    if name == "families":
        return tuple(part for part in text.split(",") if part)
    if name == "batch":
        return _integers(text, 1)[0]
    if name == "exposure":
        try:
            return float(text)
        except ValueError:
            message = f"exposure must be a number of stops, got {text!r}"
            raise InputError(message) from None
    return text
