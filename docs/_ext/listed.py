"""The directive ``listed``: an ``autosummary`` of what the code has of a kind, with their pages."""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.ext.autosummary import Autosummary
from sphinx.ext.autosummary.generate import generate_autosummary_docs

import chdstat
from chdstat import estimators, fit, inference

__all__ = ["LISTS", "Listed"]


def _inference(of_kind: Any) -> Iterable[str]:
    found = [name for name in inference.__all__ if of_kind(getattr(inference, name))]
    return (name if name in chdstat.__all__ else f"inference.{name}" for name in found)


def _estimators(*, neighbours: bool) -> Iterable[str]:
    entries = map(estimators.lookup, estimators.names("fixed"))
    return (f"estimators.{e.name}" for e in entries if e.uses_neighbours == neighbours)


LISTS = {
    "families": tuple(f"fit.{name}" for name in fit.FAMILIES),
    "tests": tuple(_inference(inspect.isroutine)),
    "results of tests": tuple(_inference(inspect.isclass)),
    "estimators of one pixel": tuple(_estimators(neighbours=False)),
    "estimators with neighbours": tuple(_estimators(neighbours=True)),
}
"""Names below `chdstat`, by what pages call the list."""


class Listed(Autosummary):
    """Show one of `LISTS`."""

    required_arguments = 1
    final_argument_whitespace = True
    has_content = False

    def run(self) -> list[nodes.Node]:
        self.options |= {"toctree": "generated", "nosignatures": None}
        self.content = StringList(LISTS[self.arguments[0]], source=self.env.docname)
        return super().run()


def _write_pages(app: Any) -> None:
    """Write a page for each name, as Sphinx does for those of an ``autosummary`` on a page."""
    names = "\n".join(f"   chdstat.{name}" for of_kind in LISTS.values() for name in of_kind)
    folder = Path(app.srcdir, "reference", "generated")
    with tempfile.NamedTemporaryFile("w", suffix=".rst") as page:
        page.write(f".. autosummary::\n   :toctree: {folder}\n\n{names}\n")
        page.flush()
        generate_autosummary_docs([page.name], base_path=app.srcdir, app=app)


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("listed", Listed)
    app.connect("builder-inited", _write_pages)
    return {"parallel_read_safe": True}
