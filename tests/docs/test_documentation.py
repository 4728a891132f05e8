"""What the documentation promises: its commands are run, and every public name is explained."""

from __future__ import annotations

import ast
import pydoc
import re
import runpy
import shlex
import textwrap
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import chdstat as chd
from chdstat.rendering.recipes import PHENOMENA, load_recipe

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def code_blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in pins}


def test_both_commands_are_single_lines_for_a_fresh_clone() -> None:
    run, test = code_blocks(README, "sh")[:2]
    for command in (run, test):
        assert command.count("\n") == 1
        assert command.startswith("python3.11 -m venv .venv && . .venv/bin/activate && pip install")
    assert run.rstrip().endswith("chdstat report bathroom -o report.pdf")
    assert test.rstrip().endswith("pytest")


def test_ci_runs_the_test_command_of_the_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- ci: test -->" in script
    assert "pip install" not in script  # else the two could drift apart
    after_marker = README.split("<!-- ci: test -->")[1]
    assert code_blocks(after_marker, "sh")[0] == code_blocks(README, "sh")[1]


def test_python_in_the_readme_is_python_and_its_names_exist() -> None:
    block = "\n".join(code_blocks(README, "python"))
    used = [
        node.attr
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "chd"
    ]
    assert used
    assert set(used) <= set(chd.__all__)


def commands() -> set[str]:
    """Return all that the documentation, and the help itself, tells people to type."""
    from typer.main import get_command

    from chdstat.cli import app

    lines = [line for block in code_blocks(README, "sh") for line in re.split("&&|\n", block)]
    for page in (ROOT / "docs").rglob("*.rst"):
        lines += re.findall(r"^ +\$ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    for command in get_command(app).commands.values():
        lines.append((command.epilog or "").removeprefix("Example: "))
    for path in (*(ROOT / "docs" / "examples").glob("*.py"), *(ROOT / "docs").glob("*.rst")):
        lines += re.findall(r"``(chdstat [^`]+ [^`]+)``", path.read_text(encoding="utf-8"))
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
        known["explore"].make_context("explore", ["one.zarr", "two.zarr"])


@pytest.mark.parametrize("name", sorted(set(chd.__all__) - {"__version__"}))
def test_every_public_name_has_a_sentence_on_the_api_page(name: str) -> None:
    page = (ROOT / "docs" / "api.rst").read_text(encoding="utf-8")
    assert re.search(rf"^- `{name}`: [A-Z].*\.$", page, re.MULTILINE)


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs").glob("*.rst")))
def test_names_on_the_pages_exist(page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for name in re.findall(r"(?<!`)`(chdstat\.[\w.]+)`(?!`)", text):
        assert pydoc.locate(name) is not None, name


def test_code_on_the_page_of_methods_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "methods.rst").read_text(encoding="utf-8")
    blocks = re.findall(r"^\.\. code-block:: python\n\n((?:   .*\n|\n)+)", text, re.MULTILINE)
    script = tmp_path / "methods.py"
    script.write_text("\n".join(textwrap.dedent(block) for block in blocks), encoding="utf-8")
    runpy.run_path(str(script))
    assert len(capsys.readouterr().out.splitlines()) >= len(blocks) > 5


def test_recipe_and_code_on_the_page_of_studies_are_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "studies.rst").read_text(encoding="utf-8")
    kinds = {}
    for kind, block in re.findall(
        r"^\.\. code-block:: (\w+)\n\n((?:   .*\n|\n)+)", text, re.MULTILINE
    ):
        kinds[kind] = tmp_path / f"block.{kind}"
        kinds[kind].write_text(textwrap.dedent(block), encoding="utf-8")
    assert len(load_recipe(kinds["toml"]).regions) == 2
    runpy.run_path(str(kinds["python"]))
    assert "supported" in capsys.readouterr().out
    assert set(re.findall(r"^([a-z-]+)  +\d", text, re.MULTILINE)) < set(PHENOMENA)


def test_commands_on_the_page_of_methods_name_tests_that_exist() -> None:
    text = (ROOT / "docs" / "methods.rst").read_text(encoding="utf-8")
    named = set(re.findall(r"tests/[\w/.]+", text))
    assert len(named) > 5
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_every_dependency_is_pinned_within_its_range() -> None:
    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    versions = pinned()
    for text in [*project["dependencies"], *extras["test"], *extras["docs"]]:
        requirement = Requirement(text)
        version = versions[re.sub(r"[-_.]+", "-", requirement.name).lower()]
        assert requirement.specifier.contains(version), f"{text} is pinned to {version}"


def test_versions_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"version: {chd.__version__}\n" in citation
    assert f"## {chd.__version__}" in changelog
    assert metadata.version("chdstat") == chd.__version__
