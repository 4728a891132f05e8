"""What a PDF says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pypdfium2


def text_of(path: Path, last: int | None = None) -> str:
    """Return the words of a PDF, or of its first pages alone, one blank apart."""
    with pypdfium2.PdfDocument(path) as pdf:
        pages = [pdf[i].get_textpage().get_text_range() for i in range(len(pdf))]
    return " ".join(" ".join(pages[:last]).split())


HEADER, FOOTER = 0.06, 0.06
"""Shares of a page that hold its header and its number."""
_INK = 200
"""Grey from which a dot is ink."""


def white_shares(path: Path) -> list[tuple[float, float]]:
    """Return, of each page between header and number, the share below its last ink.

    With it, the share of the highest blank band above that.
    """
    with pypdfium2.PdfDocument(path) as pdf:
        grey = [pdf[i].render(scale=0.5).to_pil().convert("L") for i in range(len(pdf))]
    found = []
    for page in map(np.asarray, grey):
        body = page[round(HEADER * len(page)) : round((1 - FOOTER) * len(page))]
        inked = np.append(-1, np.flatnonzero((body < _INK).any(axis=1)))
        gap = np.diff(inked).max() if inked.size > 1 else 0
        found.append((1 - (inked[-1] + 1) / len(body), gap / len(body)))
    return found
