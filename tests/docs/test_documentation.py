"""What the documentation promises: its commands are run, and every public name is explained."""

from __future__ import annotations

import importlib
import inspect
import os
import pydoc
import re
import runpy
import shlex
import textwrap
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from docutils import nodes
from PIL import Image
from sphinx.testing.util import SphinxTestApp

import chdstat as chd
from chdstat.patterns import PATTERNS, Label
from chdstat.rendering.recipes import PHENOMENA, load_recipe

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {
    str(path.relative_to(DOCS)): path.read_text(encoding="utf-8")
    for path in sorted(DOCS.rglob("*.rst"))
    if not {"_build", "_templates", "examples", "gallery", "generated"}
    & {*path.relative_to(DOCS).parts}
}
EXAMPLES = {
    str(path.relative_to(DOCS / "examples")): path.read_text(encoding="utf-8")
    for path in sorted((DOCS / "examples").rglob("plot_*.py"))
}
README = (ROOT / "README.md").read_text(encoding="utf-8")


def code_blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pins}


def test_both_commands_are_single_lines() -> None:
    run, test = code_blocks(README, "sh")[:2]
    for command in (run, test):
        assert command.count("\n") == 1
        assert command.startswith("python3 -m venv .venv && . .venv/bin/activate && pip install")
    assert run.rstrip().endswith("chdstat report bathroom -o report.pdf")
    assert test.rstrip().endswith("pytest")


def test_ci_runs_the_test_command_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- ci: test -->" in script
    # Nothing but renderers is installed besides, else the two could drift apart.
    installed = re.findall(r"^.*pip install.*$", script, re.MULTILINE)
    assert [line.strip().split(" || ")[0] for line in installed] == [
        'pip install --quiet --no-deps "$wheel"'
    ]
    after_marker = README.split("<!-- ci: test -->")[1]
    assert code_blocks(after_marker, "sh")[0] == code_blocks(README, "sh")[1]


def commands() -> set[str]:
    """Return all that the documentation, and the help itself, tells people to type."""
    from typer.main import get_command

    from chdstat.cli import app

    lines = [line for block in code_blocks(README, "sh") for line in re.split("&&|\n", block)]
    for page in PAGES.values():
        lines += re.findall(r"^ +\$ (.*)$", page, re.MULTILINE)
    for command in get_command(app).commands.values():
        lines.append((command.epilog or "").removeprefix("Example: "))
    for text in (*EXAMPLES.values(), *PAGES.values()):
        lines += re.findall(r"``(chdstat [^`]+ [^`]+)``", text)
    return {line.strip() for line in lines if line.strip().startswith("chdstat ")}


def test_commands_in_the_documentation_can_be_typed() -> None:
    from typer.main import get_command

    from chdstat.cli import app

    known, used = get_command(app).commands, commands()
    assert len(used) > 20
    for line in used:
        _, name, *arguments = shlex.split(line, comments=True)
        known[name].make_context(name, arguments)  # refuses what it does not know
    with pytest.raises(Exception, match="unexpected extra argument"):
        known["analyze"].make_context("analyze", ["one.zarr", "two.zarr"])


PUBLIC = [f"chdstat.{name}" for name in chd.__all__ if inspect.ismodule(getattr(chd, name))]


@pytest.mark.parametrize("module", [*PUBLIC, "chdstat.studies.claims", "chdstat.explorer"])
def test_every_public_name_is_in_the_reference(module: str) -> None:
    pages = "\n".join(page for name, page in PAGES.items() if name.startswith("reference/"))
    listed = {chd_name(name) for name in re.findall(r"^   ([\w.]+)$", pages, re.MULTILINE)}
    listed |= {chd_name(name) for name in re.findall(r"autodata:: ([\w.]+)", pages)}
    lists = runpy.run_path(str(DOCS / "_ext" / "listed.py"))["LISTS"]
    for of_kind in re.findall(r"^\.\. listed:: (.+)$", pages, re.MULTILINE):
        listed |= set(map(chd_name, lists[of_kind]))
    documented = [pydoc.locate(name) for name in listed]
    offered = vars(importlib.import_module(module))
    own = (n for n, value in offered.items() if getattr(value, "__module__", None) == module)
    names = offered.get("__all__") or [name for name in own if not name.startswith("_")]
    assert names
    missing = [
        name
        for name in names
        if f"{module}.{name}" not in listed
        and not any(pydoc.locate(f"{module}.{name}") is one for one in documented)
    ]
    assert missing == []


def chd_name(name: str) -> str:
    return f"chdstat.{name.removeprefix('chdstat.')}"


@pytest.mark.parametrize("example", EXAMPLES)
def test_links_between_examples_lead_somewhere(example: str) -> None:
    page = DOCS / "gallery" / example
    linked = re.findall(r"<([\w./-]+)\.html>", EXAMPLES[example].replace("\n#", ""))
    assert linked
    for link in linked:
        target = Path(os.path.normpath(page.parent / link))
        source = (
            DOCS / "examples" / target.relative_to(DOCS / "gallery")
            if (target.is_relative_to(DOCS / "gallery"))
            else target
        )
        assert source.with_suffix(".py").exists() or source.with_suffix(".rst").exists(), link


PARTS = r"(?<!one )\b(third|quarter|fifth|sixth|seventh|eighth|ninth|tenth)s?\b"
"""Fractions, which are measured where they are written in words."""


@pytest.mark.parametrize("example", EXAMPLES)
def test_numbers_in_text_are_those_of_the_code(example: str) -> None:
    """What was measured is printed by the page; its text has only numbers that its code sets."""
    lines = re.sub(r'^"""(.*?)"""', r"", EXAMPLES[example], flags=re.DOTALL).splitlines()
    text = "\n".join(x for x in lines if x.startswith("#") and "sphinx_gallery" not in x)
    code = "\n".join(line for line in lines if not line.startswith("#"))
    text = re.sub(r"``[^`]+``|<[^>]+>", "", text).replace(",", "")
    known = set(re.findall(r"\d+(?:\.\d+)?", code)) | SETTLED
    named = set(re.findall(r"(?<![\w.-])\d+(?:\.\d+)?(?![\w-])", text))
    assert sorted(named - known) == []
    assert re.findall(PARTS, text) == []


SETTLED = {"2018", "2019", "0", "1", "2", "100", "95", "2048", "6400", "30000"}
"""Years, ends of ranges, levels, and what a publication says of itself."""


def test_every_example_says_what_it_proves() -> None:
    for name, text in EXAMPLES.items():
        assert re.search(r"^ *sentence = ", text, re.MULTILINE), name
        assert "print(sentence)" in text, name


@pytest.mark.parametrize("page", PAGES)
def test_names_on_the_pages_exist(page: str) -> None:
    for name in re.findall(r"(?<!`)`(chdstat\.[\w.]+)`(?!`)", PAGES[page]):
        assert pydoc.locate(name) is not None, name


def test_all_python_on_the_pages_is_run() -> None:
    assert [name for name, page in PAGES.items() if "code-block:: python" in page] == []
    assert sum(page.count(".. run::") for page in PAGES.values()) > 40


def test_every_pattern_has_its_place() -> None:
    found = set(re.findall(r"^\.\. _([\w-]+):$", PAGES["understand/noise.rst"], re.MULTILINE))
    assert {label.name.lower().replace("_", "-") for label in Label} <= found
    for pattern in PATTERNS:
        page, anchor = pattern.page.split("#")
        assert page == "understand/noise.html"
        assert anchor in found
        assert f".. pattern:: {pattern.name}\n" in PAGES["understand/noise.rst"]


def test_recipe_on_the_page_of_studies_is_good(tmp_path: Path) -> None:
    text = PAGES["how-to/studies.rst"]
    block = re.search(r"^\.\. code-block:: toml\n\n((?:   .*\n|\n)+)", text, re.MULTILINE)
    assert block
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(textwrap.dedent(block[1]), encoding="utf-8")
    assert len(load_recipe(recipe).regions) == 2
    assert set(re.findall(r"^([a-z-]+)  +\d", text, re.MULTILINE)) < set(PHENOMENA)


def test_commands_on_the_pages_name_tests_that_exist() -> None:
    named = {
        path
        for page in PAGES.values()
        for path in re.findall(r"(?<![\w/-])(?:tests|benchmarks)/[\w/.]+\w", page)
    }
    assert len(named) > 15
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_every_dependency_is_pinned_within_its_range() -> None:
    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    versions = pinned()
    for text in [*project["dependencies"], *(text for extra in extras.values() for text in extra)]:
        requirement = Requirement(text)
        if requirement.name == "chdstat":  # one extra takes another in
            continue
        version = versions[re.sub(r"[-_.]+", "-", requirement.name).lower()]
        assert requirement.specifier.contains(version), f"{text} is pinned to {version}"


def test_versions_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"version: {chd.__version__}\n" in citation
    assert f"## {chd.__version__}" in changelog
    assert metadata.version("chdstat") == chd.__version__


# --- the directive ``run`` ------------------------------------------------------------------------


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


def test_printed_lines_and_values_are_shown(pages):
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


def test_files_beside_the_page_are_there_and_shown(pages, tmp_path):
    Image.new("RGB", (3, 2)).save(tmp_path / "red.png")
    page = ".. run::\n   :files: red.png\n\n   from PIL import Image\n   Image.open('red.png')\n"
    (image,) = pages(page).findall(nodes.image)
    with Image.open(tmp_path / image["uri"].lstrip("/")) as shown:
        assert shown.size == (3, 2)


def test_pages_that_code_writes_are_shown_in_a_frame(pages, tmp_path):
    code = "from pathlib import Path\nPath('a.html').write_text('six')\nPath('a.html')"
    page = pages(f".. run::\n   :hide:\n\n{textwrap.indent(code, '   ')}\n")
    (frame,) = page.findall(nodes.raw)
    assert texts(page) == []
    source = re.search('src="([^"]+)"', frame.astext())[1]
    assert Path(tmp_path, "_build", "html", source).read_text() == "six"


def test_commands_may_have_another_exit_code(pages):
    assert texts(pages(".. run:: console\n   :exit: 1\n\n   false\n")) == ["$ false"]
    with pytest.raises(Exception, match="exit code 0"):
        pages(".. run:: console\n   :exit: 1\n\n   true\n")


@pytest.mark.parametrize("page", [".. run::\n\n   1 / 0\n", ".. run:: console\n\n   false\n"])
def test_what_fails_fails_the_build(pages, page):
    with pytest.raises(Exception, match="division by zero|false"):
        pages(page)
