"""The directive ``markdown``: a page of the repository that is written in simple Markdown.

Headings, lists, code and links are turned into reStructuredText; that is all these pages use.
"""

from __future__ import annotations

import re
from pathlib import Path

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

__all__ = ["Markdown", "as_rst"]

_RULES = ("=", "-", "~")


class Markdown(SphinxDirective):
    """Include a file of the repository below its own title."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        path = Path(self.env.srcdir).parent / self.arguments[0]
        self.env.note_dependency(str(path))
        _, text = path.read_text(encoding="utf-8").split("\n", 1)
        return self.parse_text_to_nodes(as_rst(text), allow_section_headings=True)


def as_rst(text: str) -> str:
    """Return reStructuredText for Markdown; a second-level heading becomes a section."""
    text = re.sub(r"\[([^]]+)\]\((https?:[^)]+)\)", r"`\1 <\2>`__", text)
    text = re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", text)
    text = re.sub(r"(?<!`)`([^`<>]+)`(?!`|_)", r"``\1``", text)
    # Code that is indented by four spaces stands below its own mark.
    text = re.sub(r"\n\n(?=    \S)", "\n\n::\n\n", text)
    return re.sub(r"^#(#+) (.*)$", _heading, text, flags=re.MULTILINE)


def _heading(match: re.Match[str]) -> str:
    return f"{match[2]}\n{_RULES[len(match[1])] * len(match[2])}"


def setup(app: object) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("markdown", Markdown)
    return {"parallel_read_safe": True}
