"""What a PDF says."""

from __future__ import annotations

from pathlib import Path

import pypdfium2


def text_of(path: Path, last: int | None = None) -> str:
    """Return the words of a PDF, or of its first pages alone, one blank apart."""
    with pypdfium2.PdfDocument(path) as pdf:
        pages = [pdf[i].get_textpage().get_text_range() for i in range(len(pdf))]
    return " ".join(" ".join(pages[:last]).split())
