"""Show the figure that a gallery cell ends with, as a notebook would."""

from __future__ import annotations

import weakref
from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

from chdstat.viz import style

__all__ = ["last_figure"]

_shown: weakref.WeakSet[Figure] = weakref.WeakSet()


def last_figure(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure that is the value of the cell, and return reST that shows it.

    The figures of `chdstat.viz` do not belong to pyplot, where sphinx-gallery's own scraper looks.
    """
    value = block_vars["example_globals"].get("___")
    # sphinx-gallery keeps the value of an earlier cell where a cell ends with a statement.
    if not isinstance(value, Figure) or value in _shown:
        return ""
    _shown.add(value)
    path = next(block_vars["image_path_iterator"])
    with style():
        value.savefig(path, dpi=200)
    return str(figure_rst([path], gallery_conf["src_dir"]))


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    return {"parallel_read_safe": True}
