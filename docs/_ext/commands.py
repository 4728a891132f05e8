"""The directive ``commands``: every command with its options, made from the command line itself."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from typer.main import get_command

from chdstat.cli import app as command_line

__all__ = ["Commands"]


class Commands(Directive):
    """Give every command a section: usage, what it does, arguments and options."""

    def run(self) -> list[nodes.Node]:
        commands: dict[str, Any] = getattr(get_command(command_line), "commands", {})
        return [_section(name, command) for name, command in commands.items()]


def _section(name: str, command: Any) -> nodes.section:
    section = nodes.section("", nodes.title("", name), ids=[nodes.make_id(f"chdstat {name}")])
    example = (command.epilog or "").removeprefix("Example: ")
    if example:
        section += nodes.literal_block(example, example, language="console")
    for paragraph in (command.help or "").split("\n\n"):
        section += nodes.paragraph("", " ".join(paragraph.split()))
    options = nodes.definition_list()
    for parameter in command.params:
        if parameter.help:
            options += _item(parameter)
    section += options
    return section


def _item(parameter: Any) -> nodes.definition_list_item:
    is_option = parameter.param_type_name == "option"
    spelled = ", ".join(parameter.opts) if is_option else parameter.metavar
    if is_option and not parameter.is_flag and parameter.metavar:
        spelled += f" {parameter.metavar}"
    term = nodes.term("", "", nodes.literal("", spelled))
    text = parameter.help
    if is_option and not parameter.is_flag and (default := _default(parameter)):
        text += f" Default: {default}."
    return nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph("", text)))


def _default(option: Any) -> str:
    """Return the default of an option as the help says it."""
    if isinstance(option.show_default, str):
        return option.show_default
    given = option.default
    if isinstance(given, list | tuple):
        return ", ".join(map(str, given))
    return "" if given is None else str(given)


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
