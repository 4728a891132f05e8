"""The directive ``paper-choices``: how a network may differ from the paper's, from the code."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from chdstat.estimators.elek2019 import CHOICES

__all__ = ["PaperChoices"]


class PaperChoices(SphinxDirective):
    """List each switch, what the paper does, and what is done otherwise."""

    def run(self) -> list[nodes.Node]:
        lines = [".. list-table::", "   :header-rows: 1", "   :widths: 12 34 44 10", ""]
        rows = [("switch", "the paper", "otherwise", "library")]
        rows += [
            (f"``{c.name}``", c.paper, c.other, "otherwise" if c.ours else "as the paper")
            for c in CHOICES.values()
        ]
        for row in rows:
            starts = ("   * - ", *["     - "] * (len(row) - 1))
            lines += [start + cell for start, cell in zip(starts, row, strict=True)]
        return self.parse_text_to_nodes("\n".join(lines))


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("paper-choices", PaperChoices)
    return {"parallel_read_safe": True}
