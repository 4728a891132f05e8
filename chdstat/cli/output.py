"""Output: sentences and tables for readers, JSON for scripts, and what to do next."""

from __future__ import annotations

import json
import logging
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import typer

from chdstat._core.files import checked_target, writing
from chdstat.samples.dependence import sequence_of
from chdstat.scenes.scene import RENDERERS

if TYPE_CHECKING:
    from chdstat.cli.arguments import CommonOptions
    from chdstat.inference import Contrast
    from chdstat.samples import Samples

_WIDE = 200
"""Columns of a pipe or a file, so that lines are not wrapped."""


def say_samples(samples: Samples, *, as_json: bool, quiet: bool) -> None:
    """Describe samples, how large their error is, and what to do with them."""
    from chdstat.rendering.adaptive import errors_told

    path, counts, errors = samples.path, samples.counts, errors_told(samples.attrs)
    if as_json:
        told = {name: error.to_dict() for name, error in errors.items()}
        mean = float(counts.mean()) if samples.unequal else samples.spp
        print_json({**samples.attrs, "path": str(path), "spp": mean, **told})
    else:
        height, width = samples.shape[:2]
        number = f"{samples.spp} sample{'s' * (samples.spp > 1)} per pixel"
        if samples.unequal:
            number += f" at most, {samples.fewest} at least, {counts.mean():.0f} on average"
        typer.echo(f"{path}: {_scene_of(samples)}, {width} x {height} pixels, {number}")
        for name, error in errors.items():
            typer.echo(f"{name.replace('_', ' ')}: {error}")
    say_next(quiet, *after_render(samples.attrs, path))


def _scene_of(samples: Samples) -> str:
    """Return the name of a scene, with its file if that is called otherwise."""
    file = Path(str(samples.attrs.get("scene_source", "")))
    same = file.suffix not in RENDERERS or file.stem == samples.name
    return samples.name if same else f"{samples.name} ({file.parent.name}/{file.name})"


def after_render(attrs: Mapping[str, Any], path: Path | None) -> Iterator[tuple[object, ...]]:
    """Yield commands that take a store; for dependent samples, not all do."""
    yield ("analyze", path) if sequence_of(attrs) == 1 else ("contrast", "OTHER.zarr", path)
    yield "explore", path


@contextmanager
def saying_passes(*, quiet: bool) -> Iterator[None]:
    """Say on stderr what the library tells of each pass, unless the output is quiet."""
    log = logging.getLogger("chdstat")
    level = log.level
    log.setLevel(level if quiet else logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)


def say_written(path: Path, *, as_json: bool, **numbers: Any) -> None:
    """Say what was written, with numbers about it."""
    if as_json:
        print_json({"path": str(path), **numbers})
        return
    about = "".join(
        f", {value} {(name.removesuffix('s') if value == 1 else name).replace('_', ' ')}"
        for name, value in numbers.items()
    )
    typer.echo(f"wrote {path}{about}")


def say_next(quiet: bool, *commands: Iterable[object]) -> None:
    """Say which commands to type next, on stderr: it does not get into a pipe."""
    if not quiet:
        told = [shlex.join(["chdstat", *map(str, words)]) for words in commands]
        typer.echo(f"next: {'  or  '.join(told)}", err=True)


def print_json(content: Mapping[str, Any] | Sequence[Any]) -> None:
    """Print numbers for scripts."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False))


def print_sentences(sentences: Iterable[str], *, bullet: str = "") -> None:
    """Print sentences as a paragraph, or one by one behind a bullet."""
    width = _columns() or sys.maxsize
    indent = " " * len(bullet)
    for text in sentences if bullet else [" ".join(sentences)]:
        typer.echo(fill(text, width, initial_indent=bullet, subsequent_indent=indent))


def print_table(content: Mapping[str, Any]) -> None:
    """Print names and values."""
    rows = [{"name": name, "value": _readable(value)} for name, value in content.items()]
    print_rows(rows, {"name": "", "value": ""}, text=["value"])


def print_notes(notes: Mapping[str, str]) -> None:
    """Print notes below a table."""
    if notes:
        typer.echo()
        texts = (f"{name}: {text.rstrip('.')}." for name, text in notes.items())
        print_sentences(texts, bullet="- ")


def print_rows(
    rows: Sequence[Mapping[str, Any]],
    columns: Mapping[str, str],
    *,
    text: Sequence[str] = (),
) -> None:
    """Print rows with the columns that they have.

    Parameters
    ----------
    rows
        Values by name of the column; the first column is aligned left, others right.
    columns
        Titles by name; without any, there is no header.
    text
        Other columns that are aligned left.
    """
    from rich.console import Console
    from rich.table import Table

    shown = {key: title for key, title in columns.items() if key in rows[0]}
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=any(shown.values()))
    for index, (key, title) in enumerate(shown.items()):
        side: Any = "left" if index == 0 or key in text else "right"
        table.add_column(title, justify=side, no_wrap=index == 0)
    for row in rows:
        table.add_row(*(_readable(row[key]) for key in shown))
    console = Console(highlight=False, markup=False, width=_WIDE)
    if columns_there := _columns():  # lines get longer rather than cut a number
        console.width = max(columns_there, console.measure(table).minimum)
    with console.capture() as captured:
        console.print(table)
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _columns() -> int | None:
    """Return how long lines may be; None for a pipe or a file, unless COLUMNS is set."""
    known = (sys.stdout and sys.stdout.isatty()) or "COLUMNS" in os.environ
    return shutil.get_terminal_size().columns if known else None


def _readable(value: Any) -> str:
    if isinstance(value, Mapping):
        return "\n".join(f"{k}: {_readable(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return ", ".join(_readable(v) for v in value) or "none"
    return "unknown" if value is None else str(value)


# --- JUnit XML ------------------------------------------------------------------------------------

_JUNIT = "<testsuites"
"""What files of results begin with, behind the XML declaration."""
_NO_XML = re.compile(r"[^\t\n\r\x20-\uD7FF\uE000-\uFFFD\U00010000-\U0010FFFF]")
"""Characters that XML cannot hold."""


def junit_target(path: Path, asked: CommonOptions) -> Path:
    """Return a file to write results to; those of an earlier run are replaced.

    Raises
    ------
    InputError, StoreError
        As `CommonOptions.target`: other files are kept, such as scenes.
    """
    target = checked_target(path, ".xml")
    earlier = target.is_file() and _JUNIT in target.read_text("utf-8", "replace")[:200]
    return target if earlier else asked.target(path, ".xml")


def write_junit(path: Path, found: Mapping[str, Contrast], seconds: Mapping[str, float]) -> None:
    """Write results as JUnit XML, a test for each render.

    One that differs has failed, and one of which the samples cannot tell was skipped.
    """
    outcomes = [of.outcome for of in found.values()]
    counts = {
        "tests": f"{len(found)}",
        "failures": f"{outcomes.count('differ')}",
        "skipped": f"{outcomes.count('cannot tell')}",
        "errors": "0",
        "time": f"{sum(seconds.values()):.3f}",
    }
    suites = Element("testsuites", counts)
    suite = SubElement(suites, "testsuite", {"name": "chdstat contrast", **counts})
    for name, of in found.items():
        about = {"classname": "chdstat contrast", "name": _xml(name)}
        case = SubElement(suite, "testcase", about | {"time": f"{seconds[name]:.3f}"})
        table = _xml("\n".join(f"{key}: {value}" for key, value in of.table().items()))
        if of.outcome == "differ":
            failure = {"message": _xml(of.conclusion), "type": of.outcome}
            SubElement(case, "failure", failure).text = table
        elif of.outcome == "cannot tell":
            SubElement(case, "skipped", {"message": _xml(of.conclusion)})
        SubElement(case, "system-out").text = f"{_xml(of.conclusion)}\n{table}"
    indent(suites)
    with writing(path) as partial:
        partial.write_bytes(tostring(suites, "utf-8", xml_declaration=True) + b"\n")


def _xml(text: str) -> str:
    return _NO_XML.sub("?", text)
