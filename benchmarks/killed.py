"""Runs a command of chdstat that may kill itself, for `test_kills`.

Arguments: before how many accesses to files of this folder it kills itself (0: it writes their
number into the file beside the folder), and the command. Clocks stand still in it, so that equal
results are equal files.
"""

import atexit
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from chdstat.cli import main
from chdstat.estimators import PRESETS
from chdstat.rendering import renders
from chdstat.studies import studies

EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir")


def killed_at(most: int, folder: Path) -> None:
    """Count accesses to files of a folder, and end the process before one of them."""
    seen = 0

    def count(event: str, details: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in EVENTS or isinstance(details[0], int):
            return
        if os.fsencode(os.path.abspath(details[0])).startswith(os.fsencode(folder)):  # noqa: PTH100
            seen += 1
            if seen == most:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    if not most:
        atexit.register(lambda: folder.with_name("events").write_text(str(seen)))


# Tests collect this file, too.
if __name__ == "__main__":
    for module in (renders, studies):
        module.time = SimpleNamespace(monotonic=lambda: 0.0)
    # The published network trains for a minute.
    object.__setattr__(PRESETS["elek2019"], "iterations", 100)
    killed_at(int(sys.argv.pop(1)), Path.cwd())
    main()
