r"""Change the package in random places, one at a time, and count the changes that a test notices.

    pip install coverage pytest-cov
    pytest --cov=chdstat --cov-context=test --cov-report= \
        --junitxml=times.xml -o junit_family=xunit1
    python tools/mutants.py --count 300 --seed 1 chdstat/fit chdstat/analysis.py

The first run of the tests writes which of them executes which line (`.coverage`), and how long each
takes (`times.xml`). A mutant then runs only tests that execute its line, the quickest first, until
one fails or their time is spent; a line that runs when its module is imported has the tests of the
whole module. Without names of files or folders, all of the package is changed. Tests of the
package's own text (`tests/test_package.py`) are left out, since they would notice any change. All
of it happens in a copy of the checkout.

cosmic-ray and mutmut draw no sample, and run one command for all mutants of a file.

A mutant that survives is a missing test, unless it is equivalent: only a reader can tell.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from coverage import CoverageData
from scipy.stats import binomtest

PACKAGE = "chdstat"
LEFT_OUT = ("tests/test_package.py", "benchmarks/")
OTHER = {
    "+": "-", "-": "+", "*": "/", "/": "*", "//": "/", "%": "*", "**": "*", "&": "|", "|": "&",
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "is": "is not",
    "is not": "is", "in": "not in", "not in": "in", "and": "or", "or": "and",
}  # fmt: skip
OPERATOR = re.compile(r"is not|not in|is|in|and|or|//|\*\*|[<>=!]=|[-+*/%&|<>]")


@dataclass(frozen=True)
class Mutant:
    """A file with other code from byte `start` to `stop`."""

    file: str
    line: int
    column: int
    start: int
    stop: int
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.old} -> {self.new}"


class Source:
    """A module, and where its expressions lie."""

    def __init__(self, path: Path) -> None:
        self.text = path.read_bytes()
        self.tree = ast.parse(self.text)
        self.lines = [0]
        for line in self.text.splitlines(keepends=True):
            self.lines.append(self.lines[-1] + len(line))

    def ends(self, node: ast.expr) -> tuple[int, int]:
        """Return the first byte of an expression and the first after it."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        first = self.lines[node.lineno - 1] + node.col_offset
        return first, self.lines[node.end_lineno - 1] + node.end_col_offset

    def between(self, left: ast.expr, right: ast.expr) -> Iterator[tuple[int, int, str]]:
        """Yield the operator between two expressions, and what replaces it."""
        start = self.ends(left)[1]
        found = OPERATOR.search(self.text[start : self.ends(right)[0]].decode())
        if found and found[0] in OTHER:
            yield start + found.start(), start + found.end(), OTHER[found[0]]

    def changes(self, node: ast.AST) -> Iterator[tuple[int, int, str]]:
        """Yield where a node can be changed, and to what."""
        match node:
            case ast.BinOp(left=left, right=right):
                yield from self.between(left, right)
            case ast.Compare(left=left, comparators=[right]):
                yield from self.between(left, right)
            case ast.BoolOp(values=[left, right, *_]):
                yield from self.between(left, right)
            case ast.UnaryOp(op=ast.USub() | ast.Not() as op):
                start = self.ends(node)[0]
                yield start, start + (1 if isinstance(op, ast.USub) else 3), ""
            case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
                start, stop = self.ends(test)
                yield start, stop, f"not ({self.text[start:stop].decode()})"
            case ast.Return(value=ast.expr() as value):
                yield *self.ends(value), "None"
            case ast.Constant(value=bool() as value):
                yield *self.ends(node), str(not value)
            case ast.Constant(value=int() | float() as value):
                yield *self.ends(node), repr(value + 1)

    def mutated(self, file: str) -> Iterator[Mutant]:
        """Yield all mutants, but of annotations and of what is written into texts."""
        skipped = set()
        for node in ast.walk(self.tree):
            parts = (getattr(node, "annotation", None), getattr(node, "returns", None))
            for part in (*parts, node if isinstance(node, ast.JoinedStr) else None):
                skipped |= {id(inner) for inner in ast.walk(part)} if part else set()
        for node in ast.walk(self.tree):
            for start, stop, new in () if id(node) in skipped else self.changes(node):
                old = self.text[start:stop].decode()
                if new != old:
                    line = self.text.count(b"\n", 0, start) + 1
                    column = start - self.lines[line - 1] + 1
                    yield Mutant(file, line, column, start, stop, old, new)


class Tests:
    """Which tests run which lines, and for how long."""

    def __init__(self, coverage: Path, times: Path) -> None:
        self.data = CoverageData(str(coverage))
        self.data.read()
        self.files = {f[f.rindex(f"/{PACKAGE}/") + 1 :]: f for f in self.data.measured_files()}
        self.seconds = {
            f"{case.get('file')}::{case.get('name')}": float(case.get("time", 0))
            for case in ET.parse(times).iter("testcase")  # noqa: S314 - written by us
            if not {child.tag for child in case} & {"failure", "error", "skipped"}
        }

    def of(self, mutant: Mutant, longest: float) -> list[str]:
        """Return the quickest tests of a line, or of its module where it runs with an import."""
        lines = self.data.contexts_by_lineno(self.files.get(mutant.file, mutant.file))
        contexts = set(lines.get(mutant.line, ())) - {""}
        if not contexts:
            contexts = {name for names in lines.values() for name in names}
        names = {context.split("|")[0] for context in contexts}
        chosen, spent = [], 0.0
        for name in sorted(names & self.seconds.keys(), key=self.seconds.__getitem__):
            spent += self.seconds[name]
            if spent > longest and chosen:
                break
            if not name.startswith(LEFT_OUT):
                chosen.append(name)
        return chosen


def copy(root: Path, folder: Path) -> None:
    """Copy what git knows of a checkout."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)  # noqa: S603
    for name in filter(None, listed.stdout.split("\0")):
        if (root / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((root / name).read_bytes())


def fate(mutant: Mutant, tests: list[str], folder: Path, longest: float) -> str:
    """Run tests of a mutant, and return what became of it."""
    path = folder / mutant.file
    source = path.read_bytes()
    (folder / "chosen.txt").write_text("\n".join(tests))
    seconds = int(3 * longest + 60)
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider"]
    try:
        path.write_bytes(source[: mutant.start] + mutant.new.encode() + source[mutant.stop :])
        done = subprocess.run(  # noqa: S603
            [*command, "@chosen.txt"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}"},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5)),
            check=False,
            capture_output=True,
            text=True,
            timeout=3 * seconds,
        )
    except subprocess.TimeoutExpired:
        return "out of time"
    finally:
        path.write_bytes(source)
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            compiled.unlink()
    if done.returncode <= 0:
        return "out of time" if done.returncode else f"survived: {len(tests)} tests"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return f"killed: {failed[1] if failed else 'no import'}"


def main() -> None:
    """Draw mutants, run their tests, print what became of each, and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=[PACKAGE], help="files or folders to change")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--coverage", type=Path, default=Path(".coverage"))
    parser.add_argument("--times", type=Path, default=Path("times.xml"))
    parser.add_argument("--longest", type=float, default=60, help="seconds of tests of a mutant")
    options = parser.parse_args()
    tests = Tests(options.coverage, options.times)
    given = [options.root / name for name in options.names]
    paths = sorted(
        {p for path in given for p in ([path] if path.is_file() else path.rglob("*.py"))}
    )
    every = [m for p in paths for m in Source(p).mutated(p.relative_to(options.root).as_posix())]
    drawn = random.Random(options.seed).sample(every, options.count)  # noqa: S311
    chosen = {mutant: tests.of(mutant, options.longest) for mutant in drawn}
    first = next((mutant for mutant in drawn if chosen[mutant]), None)
    if first is None:
        parser.error(f"expected tests in {options.coverage} that run a line to change, got none")
    same = replace(first, new=first.old)
    counts = Counter[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy(options.root, folder)
        control = fate(same, chosen[first], folder, options.longest)
        if not control.startswith("survived"):
            parser.error(f"a test of what is not changed must pass: {control}")
        for mutant in drawn:
            found = "survived: 0 tests"
            if chosen[mutant]:
                found = fate(mutant, chosen[mutant], folder, options.longest)
            counts[found.split(":")[0]] += 1
            print(f"{found}\t{mutant}".replace("\n", " "), flush=True)  # noqa: T201
    noticed = binomtest(options.count - counts["survived"], options.count)
    low, high = noticed.proportion_ci(0.95)
    print(f"{len(every)} mutants; of {options.count} {dict(counts)}")  # noqa: T201
    print(f"noticed: {noticed.statistic:.0%}, 95 % interval {low:.0%} to {high:.0%}")  # noqa: T201


if __name__ == "__main__":
    main()
