"""Typesetting: a document of text, tables and figures to PDF, with Typst.

`number`, `percent` and `between` write numbers as a reader wants them; `NAMES` has the names of
estimators, families and patterns in running text.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat._core.files import writing
from chdstat.errors import ChdstatError
from chdstat.viz import style
from chdstat.viz.estimators import NAMES
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["NAMES", "Document", "between", "number", "percent", "typeset"]


def number(value: float) -> str:
    """Return a number with three digits, and a real minus sign.

    Examples
    --------
    >>> number(0.012345), number(1234.5), number(-2.0), number(float("nan"))
    ('0.0123', '1230', '−2.00', '—')
    """
    if not math.isfinite(value):
        return "—"
    if value == 0:
        return "0"
    rounded = float(f"{value:.3g}")
    digits = max(0, 2 - math.floor(math.log10(abs(rounded))))
    text = f"{rounded:.{digits}f}" if abs(rounded) >= 1e-4 else f"{rounded:.1e}"
    return text.replace("-", "−")


def percent(share: float, *, sign: bool = False) -> str:
    r"""Return a share in per cent, which no line break splits.

    Examples
    --------
    >>> percent(0.574), percent(0.0012), percent(-0.031, sign=True), percent(0.0)
    ('57\xa0%', '0.1\xa0%', '−3.1\xa0%', '0\xa0%')
    """
    if not math.isfinite(share):
        return "—"
    digits = 0 if abs(share) >= 0.0995 or share == 0 else 1
    text = f"{100 * share:{'+' if sign and share else ''}.{digits}f}\N{NO-BREAK SPACE}%"
    return text.replace("-", "−")


def between(value: float, margin: float) -> str:
    """Return a value with its margin of error.

    Examples
    --------
    >>> between(0.31, 0.2)
    '0.31 ± 0.20'
    """
    if not (math.isfinite(value) and math.isfinite(margin)):
        return "—"
    return f"{value:.2f} ± {margin:.2f}".replace("-", "−")


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


def typeset(document: Document, folder: Path, target: Path) -> Path:
    """Write a document as PDF.

    Parameters
    ----------
    document
        What to typeset.
    folder
        An empty folder for the parts.
    target
        The PDF; it is replaced only when the new one is complete.

    Raises
    ------
    ChdstatError
        If Typst refuses the document, or the PDF cannot be written.
    """
    import typst

    for part in (resources.files("chdstat.reporting") / "templates").iterdir():
        (folder / part.name).write_text(part.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "content.json").write_text(
        json.dumps({**document.content, "figures": sorted(document.figures)}), encoding="utf-8"
    )
    with style(), spelt():
        for name, figure in document.figures.items():
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    try:
        with writing(target) as partial:
            typst.compile(folder / document.template, output=partial)
    except (RuntimeError, typst.TypstError) as error:
        message = f"typesetting the report failed: {error}"
        raise ChdstatError(message) from error
    return target
