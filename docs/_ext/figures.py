"""Show the figure that a gallery cell ends with, as a notebook would, and one panel as thumbnail.

``# sphinx_gallery_panel = 2, 1`` in an example takes the first panel of its second figure.
"""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from sphinx_gallery.py_source_parser import extract_file_config
from sphinx_gallery.scrapers import figure_rst

from chdstat.viz import style

__all__ = ["last_figure"]

_PANEL = 1.5, 1.15
"""Width and height of the axes in a thumbnail, in inches: so small that text stays readable."""

_shown: weakref.WeakSet[Figure] = weakref.WeakSet()


def last_figure(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure that is the value of the cell, and return reST that shows it.

    The figures of `chdstat.viz` do not belong to pyplot, where sphinx-gallery's own scraper looks.
    It makes the thumbnail of the first image: that is the panel, and is not on the page.
    """
    value = block_vars["example_globals"].get("___")
    # sphinx-gallery keeps the value of an earlier cell where a cell ends with a statement.
    if not isinstance(value, Figure) or value in _shown:
        return ""
    _shown.add(value)
    paths = block_vars["image_path_iterator"]
    config = extract_file_config(Path(block_vars["src_file"]).read_text(encoding="utf-8"))
    figure, panel = config.get("panel", (1, 1))
    with style():
        if not len(paths):
            value.savefig(next(paths))  # until the figure with the panel comes
        path, number = next(paths), len(paths) - 1
        value.savefig(path, dpi=200)
        if number == figure:
            _save_panel(value, panel - 1, paths.paths[0])
    return str(figure_rst([path], gallery_conf["src_dir"]))


def _save_panel(figure: Figure, panel: int, path: str) -> None:
    """Save one panel alone, so small that its text is large. The figure is not drawn again."""
    ax = figure.axes[panel]
    figure.set_layout_engine("none")
    _hide_all_but(ax, figure)
    if ax.get_legend():
        ax.get_legend().remove()
    parent = ax.get_figure(root=False).bbox
    width, height = (inches * figure.dpi for inches in _PANEL)
    ax.set_position((0.2, 0.2, width / parent.width, height / parent.height))
    figure.draw_without_rendering()
    box = ax.get_tightbbox().transformed(figure.dpi_scale_trans.inverted())
    figure.savefig(path, dpi=300, bbox_inches=box.padded(0.05))


def _hide_all_but(ax: Axes, figure: FigureBase) -> None:
    for child in figure.get_children():
        if isinstance(child, SubFigure):
            _hide_all_but(ax, child)
        elif child is not figure.patch:
            child.set_visible(child is ax)


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    return {"parallel_read_safe": True}
