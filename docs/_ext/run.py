"""The directive ``run``: code or commands, run while the page is built, with what they gave below.

A figure that explains a page comes first, and its code is folded: that on the page with the option
``figure``, that in a file beside it with ``file``.

All blocks of a page share their variables, and all pages one working folder, so that a store that
is rendered on one page is there on the next, which must not append to it. Code that fails fails the
build.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import io
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL.Image import Image
from sphinx.util.docutils import SphinxDirective

from chdstat.viz import style

__all__ = ["Run"]

_COLUMNS = "88"


class Run(SphinxDirective):
    """Show Python, or with the argument ``console`` commands, and their output.

    The output is what was printed, then the value of the last expression: a picture as an image,
    the path of a page in a frame, anything else by its ``repr``. The option ``alt`` describes the
    image, ``figure`` folds the code below it (``open``: unfolded), ``hide`` leaves it out, ``file``
    takes it from a file. ``files`` names files beside the page that are copied first; ``exit`` is
    the exit code of a command.
    """

    has_content = True
    optional_arguments = 1
    option_spec: ClassVar = {
        "alt": directives.unchanged,
        "exit": directives.nonnegative_int,
        "figure": directives.unchanged,
        "file": directives.path,
        "files": directives.unchanged,
        "hide": directives.flag,
    }

    def run(self) -> list[nodes.Node]:
        page = Path(self.env.doc2path(self.env.docname))
        code = "\n".join(self.content)
        if "file" in self.options:
            file = page.parent / self.options["file"]
            self.env.note_dependency(str(file))
            code = file.read_text(encoding="utf-8").rstrip()
        for name in self.options.get("files", "").split():
            self.env.note_dependency(str(page.parent / name))
            shutil.copy(page.parent / name, _folder().name)
        with contextlib.chdir(_folder().name):
            if self.arguments == ["console"]:
                output = _command(code, self.options.get("exit", 0))
                return [_literal(f"$ {code}", "console"), *_shown(output)]
            new = {"__name__": "__main__", "__file__": str(page)}
            variables = self.env.temp_data.setdefault("run_variables", new)
            printed, value = _execute(code, variables, page.name)
        value = value.figure if isinstance(value, Axes) else value
        if "hide" in self.options:
            image = self._page if isinstance(value, Path) else self._image
            return [*_shown(printed), *([] if value is None else [image(value)])]
        if self.options.keys() & {"figure", "file"}:
            return [self._image(value), *self._folded(code)]
        shown = [_literal(code, "python")]
        if isinstance(value, Figure | Image):
            return [*shown, *_shown(printed), self._image(value)]
        if isinstance(value, Path):
            return [*shown, *_shown(printed), self._page(value)]
        return [*shown, *_shown(printed if value is None else f"{printed}{value!r}")]

    def _folded(self, code: str) -> list[nodes.Node]:
        opened = "   :open:\n" if self.options.get("figure") == "open" else ""
        block = f".. code-block:: python\n\n{textwrap.indent(code, '   ')}"
        return self.parse_text_to_nodes(
            f".. dropdown:: Code of this figure\n   :class-container: figure-code\n{opened}\n"
            f"{textwrap.indent(block, '   ')}"
        )

    def _page(self, page: Path) -> nodes.raw:
        """Return a frame that shows a page, which is copied to the built documentation."""
        name = f"{self.env.docname.replace('/', '-')}-{page.name}"
        (pages := Path(self.env.srcdir, "_run")).mkdir(exist_ok=True)
        with contextlib.chdir(_folder().name):
            shutil.copy(page, pages / name)
        up, title = "../" * self.env.docname.count("/"), self.options.get("alt", page.name)
        frame = f'<iframe src="{up}_run/{name}" title="{title}" class="page" loading="lazy">'
        return nodes.raw("", f"{frame}</iframe>", format="html")

    def _image(self, shown: Figure | Image) -> nodes.image:
        serial = self.env.new_serialno("run")
        name = f"{self.env.docname.replace('/', '-')}-{serial}.png"
        path = Path(self.env.srcdir, "_run", name)
        path.parent.mkdir(exist_ok=True)
        if isinstance(shown, Image):
            shown.save(path)
        else:
            with style():
                shown.savefig(path, dpi=200)
        return nodes.image(uri=f"/_run/{name}", alt=self.options.get("alt", ""), classes=["result"])


def _execute(code: str, variables: dict[str, Any], name: str) -> tuple[str, Any]:
    """Run code, and return what it printed and the value of its last line, if it has one."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed, progress = io.StringIO(), io.StringIO()
    with style(), contextlib.redirect_stdout(printed), contextlib.redirect_stderr(progress):
        exec(compile(tree, name, "exec"), variables)  # noqa: S102 - the documentation's own code
        value = last and eval(compile(ast.Expression(last.value), name, "eval"), variables)  # noqa: S307
    return printed.getvalue(), value


def _command(line: str, expected: int) -> str:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": _COLUMNS, "NO_COLOR": "1"}
    done = subprocess.run(  # noqa: S603 - the documentation's own commands
        shlex.split(line), capture_output=True, text=True, env=environment, check=False
    )
    if done.returncode != expected:
        message = f"{line}\n{done.stdout}{done.stderr}exit code {done.returncode}"
        raise RuntimeError(message)
    return done.stdout


def _shown(output: str) -> list[nodes.Node]:
    for folder in (os.path.realpath(_folder().name), _folder().name):  # its name says nothing
        output = output.replace(f"{folder}{os.sep}", "").replace(folder, "a folder")
    return [_literal(output.rstrip(), "text", "output")] if output.strip() else []


def _literal(text: str, language: str, *classes: str) -> nodes.literal_block:
    return nodes.literal_block(text, text, language=language, classes=list(classes))


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


def _clean_up(app: Any, _: Any) -> None:
    for page in Path(app.srcdir, "_run").glob("*.html"):
        target = Path(app.outdir, "_run")
        target.mkdir(exist_ok=True)
        shutil.copy(page, target)
    _folder().cleanup()
    _folder.cache_clear()


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.setup_extension("sphinx_design")  # folds
    app.add_directive("run", Run)
    app.connect("build-finished", _clean_up)
    return {"parallel_read_safe": False}
