"""Show the figures that gallery cells end with, as a notebook would; open the page with one.

``# sphinx_gallery_panel = 2, 1`` in an example takes the first panel of its second figure as
thumbnail, and that figure to the top of the page. Below it stands what the example calls
``sentence``: what the picture proves, with numbers of this run.
"""

from __future__ import annotations

import json
import re
import weakref
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from sphinx.errors import ExtensionError
from sphinx_gallery.py_source_parser import extract_file_config
from sphinx_gallery.scrapers import figure_rst

from chdstat._core import progress
from chdstat.viz import style

__all__ = ["last_figure", "without_progress"]

_PANEL = 1.5, 1.15
"""Width and height of the axes in a thumbnail, in inches: so small that text stays readable."""

_shown: weakref.WeakSet[Figure] = weakref.WeakSet()


def last_figure(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure that is the value of the cell, and return reST that shows it.

    The figures of `chdstat.viz` do not belong to pyplot, where sphinx-gallery's own scraper looks.
    It makes the thumbnail of the first image: that is the panel, and is not on the page.
    """
    variables, paths = block_vars["example_globals"], block_vars["image_path_iterator"]
    value = variables.get("___")
    if isinstance(variables.get("sentence"), str):
        _tell(paths, sentence=variables["sentence"])
    # sphinx-gallery keeps the value of an earlier cell where a cell ends with a statement.
    if not isinstance(value, Figure) or value in _shown:
        return ""
    _shown.add(value)
    config = extract_file_config(Path(block_vars["src_file"]).read_text(encoding="utf-8"))
    figure, panel = config.get("panel", (1, 1))
    with style():
        if not len(paths):
            value.savefig(next(paths))  # until the figure with the panel comes
        path, number = next(paths), len(paths) - 1
        value.savefig(path, dpi=200)
        if number == figure:
            _tell(paths, image=Path(path).name)
            _save_panel(value, panel - 1, paths.paths[0])
            return "\n.. rst-class:: at-top\n\nThe picture at the top of this page.\n\n"
    return str(figure_rst([path], gallery_conf["src_dir"]))


def typeset(sentence: str) -> str:
    """Return a sentence with spaces before per cent and real minus signs.

    >>> typeset("58% of -1")
    '58\\N{NO-BREAK SPACE}% of \\N{MINUS SIGN}1'
    """
    spaced = re.sub(r"(?<=\d) ?%", "\N{NO-BREAK SPACE}%", sentence)
    return re.sub(r"(?<!\w)-(?=\d)", "\N{MINUS SIGN}", spaced)


def _told(image: str) -> Path:
    """Return the file of what opens a page, beside its images."""
    folder, name = Path(image).parent, Path(image).name
    return folder / re.sub(r"^sphx_glr_(.*)_\d+\.png$", r"\1.json", name)


def _tell(paths: Any, **parts: str) -> None:
    """Add parts to what opens a page."""
    file = _told(paths.image_path.format(1))
    held = json.loads(file.read_text("utf-8")) if file.exists() else {}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(held | parts), encoding="utf-8")


def _open(app: Any, docname: str, source: list[str]) -> None:
    """Put picture and sentence below the title of a page of the gallery."""
    folder, _, name = docname.rpartition("/")
    if not (docname.startswith("gallery/") and name.startswith("plot_")):
        return
    file = Path(app.srcdir, folder, "images", f"{name}.json")
    told = json.loads(file.read_text("utf-8")) if file.exists() else {}
    if told.keys() != {"image", "sentence"}:
        message = f"{docname} must have a figure with its panel and a sentence, got {sorted(told)}"
        raise ExtensionError(message)
    sentence = re.sub(r"([*`|_\\])", r"\\\1", typeset(told["sentence"]))
    opening = (
        f".. image:: images/{told['image']}\n   :alt: {sentence}\n   :class: opening\n\n"
        f".. rst-class:: opening\n\n{sentence}\n"
    )
    # The first underline is that of the title.
    source[0] = re.sub(
        r"^={4,}$", lambda line: f"{line[0]}\n\n{opening}", source[0], count=1, flags=re.MULTILINE
    )


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


def without_progress(gallery_conf: dict[str, Any], script: str) -> None:
    """Let examples write no lines of progress, which would say how busy the machine was."""
    progress._LINE_EVERY = 1e6


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.connect("source-read", _open)
    return {"parallel_read_safe": True}
