"""Wire: how other threads reach a page, which only its own thread may touch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from bokeh.document import Document

from chdstat.explorer.page import Page

__all__ = ["Wire"]


class Wire:
    """One page, until it is gone.

    Parameters
    ----------
    document, page
        The page; what is said and shown goes there.
    gone
        Called once, when the page turns out to be gone, or `close` is called.
    """

    def __init__(self, document: Document, page: Page, gone: Callable[[], None]) -> None:
        self._document, self._page, self._gone = document, page, gone
        self.closed = False

    def close(self) -> None:
        """Carry nothing more."""
        if not self.closed:
            self.closed = True
            self._gone()

    def say(self, *items: Mapping[str, Any]) -> None:
        """Say something; in the page's own thread."""
        self._page.say(*items)

    def alert(self, text: str) -> None:
        """Say what went wrong; in the page's own thread."""
        self.say({"kind": "alert", "text": text})

    def next(self, callback: Callable[[], None]) -> None:
        """Call something in the page's own thread, soon."""
        self._add(self._document.add_next_tick_callback, callback)

    def later(self, callback: Callable[[], None], milliseconds: int) -> None:
        """Call something in the page's own thread, after a while."""
        self._add(self._document.add_timeout_callback, callback, milliseconds)

    def _add(self, add: Callable[..., Any], callback: Callable[[], None], *when: int) -> None:
        if self.closed:
            return
        try:
            add(callback, *when)
        except (RuntimeError, AttributeError):  # the page is gone, and its document taken apart
            self.close()
