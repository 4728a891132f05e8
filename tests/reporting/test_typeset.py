"""Typesetting: figures keep the size in which they were drawn, and templates every letter."""

from __future__ import annotations

import re
import shutil
from importlib import resources
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from chdstat.errors import ChdstatError
from chdstat.reporting import documents
from chdstat.reporting.documents import Document, typeset
from tests.pdf import text_of

TEMPLATES = resources.files("chdstat.reporting") / "templates"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a folder of templates, for a test to add its own."""
    folder = Path(shutil.copytree(str(TEMPLATES), tmp_path / "templates"))
    monkeypatch.setattr(documents, "_TEMPLATES", folder)
    return folder


@pytest.mark.parametrize("width", [1.5, 6.5])
def test_a_figure_has_the_size_in_which_it_was_drawn(own, tmp_path, width):
    (own / "size.typ").write_text(
        '#import "parts.typ": *\n#context [#measure(drawing("drawn")[]).width]'
    )
    drawn = {"drawn": Figure(figsize=(width, 1))}
    path = typeset(Document("size.typ", {}, drawn), tmp_path / "size.pdf")
    assert text_of(path).split()[0] == f"{72 * width:g}pt"


@pytest.mark.parametrize("name", ["parts.typ", "scene_report.typ", "study.typ"])
def test_no_semicolon_of_a_sentence_ends_an_expression(name):
    # Typst takes the one after "#data.number" for the end of code; "\\;" is a letter.
    text = (TEMPLATES / name).read_text(encoding="utf-8")
    assert re.findall(r"#[\w.-]+(?:\([^()]*\))?;", text) == []


def test_an_old_document_survives_a_failed_one(own, tmp_path):
    (own / "wrong.typ").write_text("#nothing")
    target = tmp_path / "old.pdf"
    target.write_bytes(b"old")
    with pytest.raises(ChdstatError, match="typesetting the report failed: .*nothing"):
        typeset(Document("wrong.typ", {}, {}), target)
    assert target.read_bytes() == b"old"
