"""The directive ``family-table``: the families of fits, made from the table in the code."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from chdstat.fit import FAMILIES, Family

__all__ = ["FamilyTable"]


class FamilyTable(SphinxDirective):
    """List the density of each family, its tail, its standard errors, and from when these hold."""

    def run(self) -> list[nodes.Node]:
        head = ("family", "density for :math:`x > 0`", "tail index", "standard errors", "hold from")
        lines = [".. list-table::", "   :header-rows: 1", "   :widths: 16 34 14 24 12", ""]
        for row in (head, *map(_row, FAMILIES.values())):
            starts = ("   * - ", *["     - "] * (len(row) - 1))
            lines += [start + cell for start, cell in zip(starts, row, strict=True)]
        return self.parse_text_to_nodes("\n".join(lines))


def _row(family: Family) -> tuple[str, ...]:
    holds = ", ".join(f"``{name}`` {n}" for name, n in family.errors_from.items())
    density = f":math:`{family.density}`"
    name = f"`{family.name} <chdstat.fit.{family.name}>`"
    return name, density, family.tail_index, family.error_formula, holds or "the least"


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("family-table", FamilyTable)
    return {"parallel_read_safe": True}
