"""Runs commands in processes forked from one that has imported everything, for `test_kills`.

Each line of its input is JSON: ``arguments`` of the command, the ``folder`` to run it in, the
terminal ``tty`` of its error stream, and after how many ``events`` on files of the folder it kills
itself (none counts them). It answers with the number of the process and, when that has ended, of
the status that it left. Clocks stand still in it, so that equal results are equal files.
"""

import atexit
import contextlib
import importlib
import json
import os
import signal
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from chdstat.cli import main
from chdstat.estimators import PRESETS

# Not Mitsuba: its threads would not come along.
COSTLY = (
    *("OpenEXR", "cattrs", "dask.array", "rich.progress", "scipy.stats", "sklearn.mixture"),
    *(
        "sympy",
        "torch._dynamo",
        "xarray",
        "zarr",
        "chdstat.analysis",
        "chdstat.estimators.estimates",
    ),
    "chdstat.estimators.progressive.network",
)
TIMED = ("chdstat.rendering.renders", "chdstat.studies.studies")
EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir")


def prepare(arguments: list[str], folder: str, tty: str, events: int | None) -> None:
    """Make a forked process what a shell would have started."""
    os.chdir(folder)
    os.environ |= {"TMPDIR": f"{folder}/tmp", "XDG_CACHE_HOME": f"{folder}/cache"}
    tempfile.tempdir = None
    for number, place in enumerate((os.devnull, os.devnull, tty)):
        os.dup2(os.open(place, os.O_RDWR | os.O_NOCTTY), number)
    sys.argv = ["chdstat", *arguments]
    seen = 0
    inside = folder.encode()

    def count(event: str, details: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in EVENTS or isinstance(details[0], int):
            return
        if os.fsencode(os.path.abspath(details[0])).startswith(inside):  # noqa: PTH100
            seen += 1
            if seen == events:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    if events is None:
        atexit.register(lambda: Path(f"{folder}.events").write_text(str(seen)))


def serve() -> None:
    for name in COSTLY:
        importlib.import_module(name)
    for name in TIMED:
        importlib.import_module(name).time = SimpleNamespace(monotonic=lambda: 0.0)
    # The published network trains for a minute.
    object.__setattr__(PRESETS["elek2019"], "iterations", 100)
    for line in sys.stdin:
        child = os.fork()
        if not child:
            prepare(**json.loads(line))
            main()
        os.write(1, b"%d\n" % child)
        _, status = os.waitpid(child, 0)
        os.write(1, b"%d\n" % os.waitstatus_to_exitcode(status))


# Tests collect this file, too, and their clocks shall go on.
if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        serve()
