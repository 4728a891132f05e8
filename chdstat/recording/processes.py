"""Renderers in processes of their own: what one of them prints, holds or dies of stays there.

A process stays for many passes. It runs `chdstat.recording.worker_loop`, which calls functions of a
worker file. Requests are its standard input and replies its standard output; what the renderer
prints is kept aside, for messages.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from chdstat._core.arrays import Image
from chdstat.errors import RenderError, SceneError, brief
from chdstat.recording import worker_loop
from chdstat.recording.worker_loop import GRACE, HEAD, MAGIC, READY

_START = 300.0
"""Seconds until a renderer must have started; large installations on slow disks take a minute."""
_KEPT = 8192
"""Bytes kept of what a renderer prints last."""
_SHOWN = 5
"""Lines of it that a message shows."""
_LONGEST_HEADER = 2**26


class RendererProcess:
    """Calls functions of a worker file in a process that stays.

    The process ends with this object, with this process, and when this process is killed. Ctrl-C
    in a terminal reaches this process only, which stops a call by ending the renderer.

    Parameters
    ----------
    command
        Program and options that run a Python file, whose path is appended: ``[python]``, or
        ``[blender, "--background", "--python"]``.
    worker
        Path of the worker file.
    renderer
        What messages call the renderer.
    variables
        Environment variables to set for it.

    Raises
    ------
    RenderError
        If it does not start, within a generous time.
    """

    def __init__(
        self,
        command: Sequence[str],
        worker: str | Path,
        *,
        renderer: str,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self._renderer, self._lock = renderer, threading.Lock()
        try:
            self._child = subprocess.Popen(  # noqa: S603 - the user's renderer and our own code
                [*command, worker_loop.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **(variables or {})},
                start_new_session=True,  # out of reach of Ctrl-C
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        except OSError as error:
            message = (
                f"{renderer} cannot be started by {command[0]}: {error.strerror or error}; give "
                "the path of a program that runs"
            )
            raise RenderError(message) from error
        self._prints = _Prints(self._child.stderr)
        self._end = weakref.finalize(self, _ended, self._child)
        with self._unbroken("at its start"):
            self._start(str(worker))

    @property
    def is_running(self) -> bool:
        """Whether it can be called."""
        return self._end.alive and self._child.poll() is None

    def call(self, name: str, **options: Any) -> tuple[dict[str, Any], dict[str, Image]]:
        """Return what a function of the worker returns: values, and arrays of float32 by name.

        Raises
        ------
        SceneError
            If the worker says that something is wrong with the scene.
        RenderError
            If the function raises anything else, or the process has ended or ends meanwhile.
        """
        with self._lock:
            if not self._end.alive:
                message = f"the process of {self._renderer} was ended; make a new one"
                raise RenderError(message)
            with self._unbroken(f"during {name!r}"):
                self._send({"call": name, "options": options})
                reply, arrays = self._received()
        if "fault" in reply:
            raise SceneError(reply["fault"])
        if "error" in reply:
            message = self._told(f"raised {brief(RuntimeError(reply['error']))}")
            raise RenderError(message)
        return reply, arrays

    def close(self) -> None:
        """End the process."""
        self._end()

    def _start(self, worker: str) -> None:
        stream = self._stream(self._child.stdout)
        timer = threading.Timer(_START, self._child.kill)
        timer.daemon = True
        timer.start()
        try:
            line = b" "
            while line and line != READY:
                line = stream.readline(_KEPT)
                self._prints.add(line.replace(READY, b""))
            self._send({"worker": worker})
            reply, _ = self._received()
        except (EOFError, OSError):
            if not timer.finished.is_set():
                raise
            message = self._told(f"did not start in {_START:.0f} s")
            raise RenderError(message) from None
        finally:
            timer.cancel()
        for why in reply.values():
            message = self._told(f"cannot be used: {brief(RuntimeError(why))}")
            raise RenderError(message)

    def _told(self, why: str) -> str:
        return f"{self._renderer} {why}; {self._prints.last()}"

    def _send(self, request: dict[str, Any]) -> None:
        stream, about = self._stream(self._child.stdin), json.dumps(request).encode()
        stream.write(HEAD.pack(MAGIC, len(about)) + about)
        stream.flush()

    def _received(self) -> tuple[dict[str, Any], dict[str, Image]]:
        magic, length = HEAD.unpack(self._exactly(bytearray(HEAD.size)))
        if magic != MAGIC or length > _LONGEST_HEADER:
            message = f"begins with {magic!r}"
            raise ValueError(message)
        about = json.loads(self._exactly(bytearray(length)))
        arrays = {name: np.empty(shape, "<f4") for name, shape in about["shapes"].items()}
        for array in arrays.values():
            self._exactly(array.reshape(-1).view(np.uint8))
        return about["reply"], arrays

    def _exactly(self, buffer: Any) -> Any:
        """Fill a buffer of bytes from the replies, and return it."""
        stream, rest = self._stream(self._child.stdout), memoryview(buffer)
        while len(rest):
            if not (count := stream.readinto(rest)):  # type: ignore[attr-defined]
                raise EOFError
            rest = rest[count:]
        return buffer

    @staticmethod
    def _stream(stream: IO[bytes] | None) -> IO[bytes]:
        assert stream is not None, "all streams are pipes"
        return stream

    @contextlib.contextmanager
    def _unbroken(self, when: str) -> Iterator[None]:
        """End the process if a message is cut short: what follows could not be understood."""
        try:
            yield
        except (EOFError, OSError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(GRACE)  # it has closed its pipes, and is about to end
            status = self._child.poll()
            self.close()
            message = self._told(f"has ended {when}{_status(status)}")
            raise RenderError(message) from error
        except (ValueError, KeyError, TypeError) as error:
            self._child.kill()
            self.close()
            message = self._told(f"sent what is not understood ({brief(error)})")
            raise RenderError(message) from error
        except BaseException:
            self._child.kill()
            self.close()
            raise


class _Prints:
    """The last of what a process prints, read as it comes, so that the process never waits."""

    def __init__(self, stream: IO[bytes] | None) -> None:
        self._tail = b""
        self._reader = threading.Thread(target=self._read, args=(stream,), daemon=True)
        self._reader.start()

    def _read(self, stream: Any) -> None:
        with contextlib.suppress(OSError, ValueError), stream:
            while chunk := stream.read1(_KEPT):
                self.add(chunk)

    def add(self, text: bytes) -> None:
        self._tail = (self._tail + text)[-_KEPT:]

    def last(self) -> str:
        """Return the last lines in words."""
        self._reader.join(0.2)
        lines = [line.strip() for line in self._tail.decode(errors="replace").splitlines()]
        shown = " / ".join([line for line in lines if line][-_SHOWN:])
        return f"it printed last: {brief(RuntimeError(shown))}" if shown else "it printed nothing"


def _status(status: int | None) -> str:
    """Return how a process has ended."""
    if status is None:
        return ""
    if status >= 0:
        return f" (exit code {status})"
    with contextlib.suppress(ValueError):
        return f" ({signal.Signals(-status).name})"
    return f" (signal {-status})"


def _ended(child: subprocess.Popen[bytes]) -> None:
    """Let a process end by itself, which takes away its temporary files, or else kill it."""
    with contextlib.suppress(OSError):
        child.stdin.close()  # type: ignore[union-attr]
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(2 * GRACE)
    child.kill()
    child.wait()
    with contextlib.suppress(OSError):
        child.stdout.close()  # type: ignore[union-attr]
