"""The directive ``of-docstring``: a section of a docstring, so that a page cannot contradict it.

And the descriptions of constants, which stand in the module that defines them, for the folder that
offers them.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from typing import Any

from docutils import nodes
from numpydoc.docscrape import NumpyDocString
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

__all__ = ["OfDocstring"]


class OfDocstring(SphinxDirective):
    """Show the extended summary of an object, or the section that is named after it."""

    required_arguments = 1
    optional_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        module, _, name = self.arguments[0].rpartition(".")
        section = self.arguments[1] if len(self.arguments) > 1 else "Extended Summary"
        described = getattr(importlib.import_module(module), name)
        lines = NumpyDocString(inspect.getdoc(described) or "")[section]
        if not any(lines):
            message = f"{self.arguments[0]} has no {section}"
            raise self.error(message)
        return self.parse_text_to_nodes("\n".join(lines))


def describe_constant(
    app: Any, what: str, name: str, described: Any, options: Any, lines: list[str]
) -> None:
    """Replace the docstring of the type of a constant by what stands below its definition."""
    if what != "data":
        return
    package, _, constant = name.rpartition(".")
    paths = getattr(importlib.import_module(package), "__path__", [])
    for module in (package, *(m.name for m in pkgutil.walk_packages(paths, f"{package}."))):
        comments = ModuleAnalyzer.for_module(module).find_attr_docs()
        if ("", constant) in comments:
            lines[:] = comments["", constant]
            return


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("of-docstring", OfDocstring)
    app.connect("autodoc-process-docstring", describe_constant)
    return {"parallel_read_safe": True}
