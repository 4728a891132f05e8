"""Calls that are counted, or stopped as if the user pressed Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def counted(
    target: Any, name: str, *, most: float = float("inf"), when: Callable[..., bool] | None = None
) -> Iterator[list[Any]]:
    """Yield the arguments of each call of a function, which is interrupted after so many calls.

    With `when`, only calls whose arguments it holds for count; all others go on as usual.
    """
    function, calls = getattr(target, name), list[Any]()

    def called(*arguments: Any, **options: Any) -> Any:
        if when is None or when(*arguments):
            if len(calls) >= most:
                raise KeyboardInterrupt
            calls.append(arguments)
        return function(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(target, name, called)
        yield calls


@contextmanager
def stopped(
    target: Any, name: str, after: int = 0, *, when: Callable[..., bool] | None = None
) -> Iterator[list[Any]]:
    """Interrupt what is done within after so many calls of a function; the interrupt gets out."""
    with counted(target, name, most=after, when=when) as calls, pytest.raises(KeyboardInterrupt):
        yield calls
