"""The directive ``certified-schema``: the variables of certified pixels, made from the code."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from numpydoc.docscrape import NumpyDocString
from sphinx.util.docutils import SphinxDirective

from chdstat.certification.certifying import COORDINATES, SCHEMA
from chdstat.certification.reduction import Numbers

__all__ = ["CertifiedSchema"]


class CertifiedSchema(SphinxDirective):
    """List coordinates, what is known of each pixel, and the certified numbers with their notes."""

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes("\n".join(_lines()))


def _lines() -> Iterator[str]:
    yield from _table("Coordinate", "Values", "Meaning")
    for name, (values, label, _) in COORDINATES.items():
        shown = [value if isinstance(value, str) else f"{value:g}" for value in values]
        yield from _row(f"``{name}``", ", ".join(shown), label)
    yield ""
    yield from _table("Of each pixel", "Dims", "Meaning")
    for name, (dims, label, unit) in SCHEMA.items():
        yield from _row(f"``{name}``", ", ".join(dims), label + _in(unit))
    yield ""
    yield from _table("Certified", "Dims", "Meaning")
    for name, (_, about) in Numbers.declared().items():
        dims = ", ".join(("pixel", *about.dims))
        yield from _row(f"``{name}``", dims, about.label + _in(about.unit))
    yield ""
    for field in NumpyDocString(inspect.getdoc(Numbers) or "")["Attributes"]:
        yield f"{', '.join(f'``{name}``' for name in field.name.split(', '))}"
        yield from (f"   {line}" for line in field.desc)


def _in(unit: str) -> str:
    return f", in {unit}" if unit not in ("", "1") else ""


def _table(*titles: str) -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "   :widths: 26 34 40", "")
    yield from _row(*titles)


def _row(*cells: str) -> list[str]:
    starts = ("   * - ", *["     - "] * (len(cells) - 1))
    return [start + cell for start, cell in zip(starts, cells, strict=True)]


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("certified-schema", CertifiedSchema)
    return {"parallel_read_safe": True}
