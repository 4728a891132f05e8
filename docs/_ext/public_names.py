"""Let any name of an object link to its page: ``render``, ``chdstat.render``, or by its module."""

from __future__ import annotations

import inspect
import pydoc
from typing import Any

from docutils import nodes

__all__ = ["resolve"]

_names: dict[int, str] = {}
"""Under which name an object is documented, by its identity."""


def resolve(app: Any, env: Any, node: nodes.Element, text: nodes.Element) -> nodes.Element | None:
    """Return the link for a name of the package that is documented under another one."""
    if node.get("refdomain") != "py":
        return None
    target = node.get("reftarget", "")
    python = env.get_domain("py")
    if not _names:
        for name in python.objects:
            _names.setdefault(id(_public(name)), name)
    found = [_public(name) for name in (target, f"chdstat.{target}") if name.startswith("chdstat.")]
    named = {_names[id(one)] for one in found if id(one) in _names}
    named = named or {name for name in _names.values() if name.endswith(f".{target}")}
    if len(named) != 1:
        return None
    linked: nodes.Element | None = python.resolve_xref(
        env, node["refdoc"], app.builder, "obj", named.pop(), node, text
    )
    return linked


def _public(name: str) -> Any:
    """Return a function, class, method or property; other values have no identity of their own."""
    found = pydoc.locate(name)
    known = inspect.isroutine(found) or inspect.isclass(found) or isinstance(found, property)
    return found if known else None


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True}
