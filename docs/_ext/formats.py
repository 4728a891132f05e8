"""The directive ``formats``: what is read, from the tables of formats and of their readers."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from typing import Any

from docutils import nodes
from numpydoc.docscrape import NumpyDocString
from sphinx.util.docutils import SphinxDirective

from chdstat.io.other_references import KINDS
from chdstat.io.reading import FORMATS, Format

__all__ = ["Formats", "fate"]

_OPTIONS = {"axes": "``--axes``", "variable": "``--variable``", "features": "features by name"}


class Formats(SphinxDirective):
    """List the formats; with ``details``, what becomes of their content; or ``references``."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        lines = {"details": _details, "references": _references, "": _overview}[
            "".join(self.arguments)
        ]()
        return self.parse_text_to_nodes("\n".join(lines))


def fate(known: Format) -> dict[str, str]:
    """Return what is read, converted, warned of, ignored and refused, from the reader itself."""
    notes = "\n".join(NumpyDocString(inspect.getdoc(known.opener) or "")["Notes"])
    found = re.findall(r"^(\S.*)\n((?: {4}.*\n?)+)", notes, re.MULTILINE)
    return {title: " ".join(text.split()) for title, text in found}


def _overview() -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "   :widths: 14 22 36 28", "")
    yield from _row("``--format``", "Files", "What they hold", "What the caller may name")
    for known in FORMATS:
        suffixes = " ".join(f"``{suffix}``" for suffix in known.suffixes)
        options = ", ".join(_OPTIONS[option] for option in known.takes)
        yield from _row(f"``{known.name}``", suffixes, known.title, options)


def _details() -> Iterator[str]:
    for known in FORMATS:
        yield from (f".. list-table:: ``{known.name}``", "   :widths: 14 86", "   :stub-columns: 1")
        yield ""
        for row in fate(known).items():
            yield from _row(*row)
        yield ""


def _references() -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "   :widths: 46 54", "")
    yield from _row("In the file, or beside it", "What is read")
    for files, reader in KINDS.items():
        said = (
            (inspect.getdoc(reader) or "").partition(".\n")[0].removeprefix("Return ").rstrip(".")
        )
        yield from _row(files, f"{said[0].upper()}{said[1:]}.")


def _row(*cells: str) -> Sequence[str]:
    starts = ("   * - ", *["     - "] * (len(cells) - 1))
    return [start + cell for start, cell in zip(starts, cells, strict=True)]


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("formats", Formats)
    return {"parallel_read_safe": True}
