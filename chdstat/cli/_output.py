"""Output: tables for people, JSON for scripts."""

from __future__ import annotations

import json
from typing import Any

import typer

__all__ = ["print_json", "print_rows", "print_table", "say_samples"]

_WIDE = 200


def say_samples(samples: Any, as_json: bool) -> None:
    """Say what samples there are."""
    if as_json:
        print_json({**samples.attrs, "path": str(samples.path), "spp": samples.spp})
    else:
        typer.echo(repr(samples))


def print_json(content: dict[str, Any]) -> None:
    """Print numbers for scripts."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False))


def print_table(content: dict[str, Any]) -> None:
    """Print names and values."""
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in content.items():
        table.add_row(name.replace("_", " "), _readable(value))
    Console(highlight=False).print(table)


def print_rows(
    rows: list[dict[str, Any]], columns: dict[str, str], *, apart: str | None = None
) -> None:
    """Print rows with the columns that they have; a line before the first that is `apart`."""
    from rich.console import Console
    from rich.table import Table

    shown = {key: title for key, title in columns.items() if key in rows[0]}
    table = Table(box=None, padding=(0, 2, 0, 0))
    for key, title in shown.items():
        side: Any = "left" if isinstance(rows[0][key], str) else "right"
        table.add_column(title, justify=side, no_wrap=True)
    before = False
    for row in rows:
        if apart is not None and row[apart] and not before:
            before = True
            table.add_row("with neighbours:", style="bold")
        table.add_row(*(_readable(row[key]) for key in shown))
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _WIDE  # whole lines for a pipe or a file
    console.print(table)


def _readable(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{k}: {_readable(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        nested = any(isinstance(v, (list, tuple)) for v in value)
        return ("\n" if nested else ", ").join(_readable(v) for v in value) or "none"
    if isinstance(value, float):
        return f"{value:.4g}"
    return "unknown" if value is None else str(value)
