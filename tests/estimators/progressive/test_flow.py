"""Flow: how many files and classes a reader meets from `Progressive.train` to `estimate`.

Run with ``-s`` to see their names.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import chdstat as chd
from chdstat.estimators import Progressive

FOLDER = Path(chd.estimators.__file__).parent
PACKAGE = "chdstat.estimators."


def met(call: Callable[[], Any]) -> tuple[set[str], set[str]]:
    """Return the files of estimators whose functions run, and their classes that are made."""
    files, classes = set(), set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        if Path(code.co_filename).is_relative_to(FOLDER):
            files.add(str(Path(code.co_filename).relative_to(FOLDER)))
        if code.co_name in ("__init__", "__new__") and code.co_argcount:
            made = frame.f_locals[code.co_varnames[0]]
            kind = made if isinstance(made, type) else type(made)
            if kind.__module__.startswith(PACKAGE):
                classes.add(f"{kind.__module__}.{kind.__qualname__}".removeprefix(PACKAGE))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return files, classes


def flow(samples: chd.Samples) -> tuple[set[str], set[str]]:
    def run() -> None:
        model.train(samples, iterations=2, progress=False)
        model.estimate(samples)

    model = Progressive(with_features=True)
    run()  # what is imported on the way is imported now
    found = met(run)
    for kind, names in zip(("files", "classes"), found, strict=True):
        print(f"\n{len(names)} {kind}: {', '.join(sorted(names))}")
    return found


def test_few_files_and_classes_lie_between_training_and_estimates(image):
    files, classes = flow(image(24, 64, seed=0).samples)
    assert {"progressive/model.py", "progressive/network.py", "training.py"} <= files
    assert {"progressive.network.Network", "registry.Estimates"} <= classes
    assert len(files) <= 8
    assert len(classes) <= 6
