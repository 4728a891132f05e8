"""Typesetting: a document of text, tables and figures to PDF, with Typst."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

from chdstat._core.files import scratch, writing
from chdstat.errors import ChdstatError
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Document", "pages_of", "typeset"]

_TEMPLATES = resources.files("chdstat.reporting") / "templates"
_FONTS = Path(mpl.get_data_path(), "fonts", "ttf")
"""Text has the family of the figures' lettering, which Matplotlib brings along."""


@dataclass(frozen=True)
class Document:
    """What a template is filled with.

    Parameters
    ----------
    template
        Name of a file in ``templates/``.
    content
        Text, numbers and tables, ready for JSON.
    figures
        Figures by name; the template finds them as ``<name>.svg``.
    """

    template: str
    content: Mapping[str, Any]
    figures: Mapping[str, Figure]


def typeset(document: Document, target: Path) -> Path:
    """Write a document as PDF.

    Parameters
    ----------
    document
        What to typeset.
    target
        The PDF; it is replaced only when the new one is complete.

    Raises
    ------
    ChdstatError
        If Typst refuses the document, or the PDF cannot be written.
    """
    import typst

    with scratch() as folder:
        for part in _TEMPLATES.iterdir():
            (folder / part.name).write_text(part.read_text(encoding="utf-8"), encoding="utf-8")
        content = {**document.content, "figures": sorted(document.figures)}
        (folder / "content.json").write_text(json.dumps(content), encoding="utf-8")
        with spelt():
            for name, figure in document.figures.items():
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        try:
            with writing(target) as partial:
                typst.compile(folder / document.template, output=partial, font_paths=[_FONTS])
        except (RuntimeError, typst.TypstError) as error:
            message = f"typesetting the report failed: {error}"
            raise ChdstatError(message) from error
    return target


def pages_of(path: Path) -> int:
    """Return the number of pages of a PDF that `typeset` has written."""
    return len(re.findall(rb"/Type\s*/Page\b", path.read_bytes()))
