"""What runs in a renderer's process: it calls functions of a worker file on request.

`chdstat.recording.processes.RendererProcess` starts this file in the Python of the renderer, which
need not have chdstat: only the standard library is used. A worker file is plain functions
``name(**options) -> dict | (dict, {name: array})``, with values ready for JSON and arrays of
numbers. `SceneFault` is among its globals: what it says of a scene reaches the user as it stands.
"""

from __future__ import annotations

import sys
from pathlib import Path

# Files beside this one must not hide modules that the renderer imports by their names.
sys.path[:] = [folder for folder in sys.path if Path(folder or ".") != Path(__file__).parent]

import json  # noqa: E402
import os  # noqa: E402
import queue  # noqa: E402
import runpy  # noqa: E402
import struct  # noqa: E402
import threading  # noqa: E402
import time  # noqa: E402
from typing import Any, BinaryIO  # noqa: E402

READY = b"chdstat: the worker speaks from here on\n"
"""Line after which the standard output of a renderer's process is replies."""
HEAD = struct.Struct("<4sQ")
"""Begin of a message: `MAGIC`, and the length of its JSON."""
MAGIC = b"chd\x01"
GRACE = 2.0
"""Seconds that a process has to clean up after its parent has ended."""


class SceneFault(Exception):  # noqa: N818 - not an error of the worker
    """Something is wrong with the scene; the text says what, and what to do."""


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Call what is asked for until the requests end."""
    waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests, waiting), daemon=True).start()
    worker: dict[str, Any] = {}
    while (request := waiting.get()) is not None:
        try:
            if "worker" in request:
                names = {"SceneFault": SceneFault}
                worker = runpy.run_path(request["worker"], names, "chdstat_worker")
                found: Any = {}
            else:
                found = worker[request["call"]](**request["options"])
            reply, arrays = found if isinstance(found, tuple) else (found, {})
        except SceneFault as fault:
            reply, arrays = {"fault": str(fault)}, {}
        except Exception as error:  # noqa: BLE001 - told in the parent
            reply, arrays = {"error": f"{type(error).__name__}: {error}"}, {}
        _send(replies, reply, arrays)


def _listen(requests: BinaryIO, waiting: queue.SimpleQueue[Any]) -> None:
    """Queue requests; end the process, also amid a pass, once there can be no more."""
    while len(head := requests.read(HEAD.size)) == HEAD.size:
        waiting.put(json.loads(requests.read(HEAD.unpack(head)[1])))
    waiting.put(None)
    time.sleep(GRACE)
    os._exit(0)


def _send(replies: BinaryIO, reply: dict[str, Any], arrays: dict[str, Any]) -> None:
    kept = {name: array.astype("<f4", order="C", copy=False) for name, array in arrays.items()}
    shapes = {name: list(array.shape) for name, array in kept.items()}
    about = json.dumps({"reply": reply, "shapes": shapes}).encode()
    replies.write(HEAD.pack(MAGIC, len(about)) + about)
    for array in kept.values():
        replies.write(array.data)
    replies.flush()


def _main() -> None:
    # The renderer's own prints go where errors go, so that they never come between replies.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    if sys.platform == "win32":
        import msvcrt

        for stream in (sys.stdin, replies):
            msvcrt.setmode(stream.fileno(), os.O_BINARY)
    replies.write(b"\n" + READY)
    replies.flush()
    serve(sys.stdin.buffer, replies)


if __name__ == "__main__":
    _main()
