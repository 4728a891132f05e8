"""The directive ``run``: pages show what their code gave, and code that fails is noticed."""

from __future__ import annotations

from pathlib import Path

import pytest
from docutils import nodes
from sphinx.testing.util import SphinxTestApp

EXTENSIONS = Path(__file__).parents[2] / "docs" / "_ext"


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that builds one page and returns its document."""
    monkeypatch.syspath_prepend(str(EXTENSIONS))
    (tmp_path / "conf.py").write_text('extensions = ["run"]\n', encoding="utf-8")

    def build(page: str) -> nodes.document:
        (tmp_path / "index.rst").write_text(f"Page\n====\n\n{page}", encoding="utf-8")
        app = SphinxTestApp("html", srcdir=tmp_path, freshenv=True)
        try:
            app.build()
            return app.env.get_doctree("index")
        finally:
            app.cleanup()

    return build


def texts(document: nodes.document) -> list[str]:
    return [block.astext() for block in document.findall(nodes.literal_block)]


def test_printed_lines_and_the_last_value_are_shown_and_variables_live_on(pages):
    page = ".. run::\n\n   x = 6\n   print('six', x)\n   x * 7\n\n.. run::\n\n   y = x + 1\n   y\n"
    assert texts(pages(page))[1::2] == ["six 6\n42", "7"]


def test_commands_are_shown_with_their_output(pages):
    assert texts(pages(".. run:: console\n\n   echo null\n")) == ["$ echo null", "null"]


def test_figures_and_axes_are_shown_as_images(pages):
    page = (
        ".. run::\n   :alt: A map.\n\n   from chdstat import viz\n   viz.value_map([[0.0, 1.0]])\n"
    )
    (image,) = pages(page).findall(nodes.image)
    assert image["alt"] == "A map."


@pytest.mark.parametrize("page", [".. run::\n\n   1 / 0\n", ".. run:: console\n\n   false\n"])
def test_what_fails_fails_the_build(pages, page):
    with pytest.raises(Exception, match="division by zero|false"):
        pages(page)
