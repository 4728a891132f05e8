"""Let ``chdstat.render`` and ``render`` link to where the function is documented."""

from __future__ import annotations

from typing import Any

from docutils import nodes

import chdstat

__all__ = ["resolve"]


def resolve(app: Any, env: Any, node: nodes.Element, text: nodes.Element) -> nodes.Element | None:
    """Return the link for a name of `chdstat.__all__`; the API page has it by its module."""
    name = node.get("reftarget", "").removeprefix("chdstat.")
    if node.get("refdomain") != "py" or name not in chdstat.__all__:
        return None
    target = getattr(chdstat, name)
    if not hasattr(target, "__module__"):
        return None
    python = env.get_domain("py")
    # What a package offers is documented there, not in the module that it comes from.
    for module in (target.__module__, target.__module__.rpartition(".")[0]):
        linked: nodes.Element | None = python.resolve_xref(
            env, node["refdoc"], app.builder, "obj", f"{module}.{target.__name__}", node, text
        )
        if linked is not None:
            return linked
    return None


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True}
