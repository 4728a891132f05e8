"""A renderer in a process of its own: while Mitsuba loads or renders, the page's server goes on.

The child is a fresh interpreter, not a `multiprocessing` one, which would run the user's script
again. Requests and results are pickles on its standard input and output. It loads nothing but the
renderer, and begins while this process still imports what the page needs.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, partial
from typing import Any

from chdstat.errors import RenderError
from chdstat.rendering.backend import activate
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer

COARSE = 128
"""Pixels of the longer side of a coarse image."""

_CODE = "from chdstat.explorer.render_process import serve; serve()"
_ENDED = "the process that renders the scene has ended; explore the scene again"


class RenderProcess:
    """Calls methods of a `chdstat.rendering.mitsuba_renderer.MitsubaRenderer` in a child process.

    A job that cannot travel, or a scene that only this process can build because its plugins were
    registered here, is rendered here.

    Parameters
    ----------
    job
        What to render.

    Attributes
    ----------
    job
        What it renders.

    Notes
    -----
    The scene is loaded meanwhile: who asks for its size waits for it.
    """

    def __init__(self, job: Job) -> None:
        self._lock = threading.Lock()
        self.job = job
        self._child: subprocess.Popen[bytes] | None = subprocess.Popen(  # noqa: S603 - our own code
            [sys.executable, "-c", _CODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._end = weakref.finalize(self, _killed, self._child)
        try:
            self._send(job)
        except Exception:  # noqa: BLE001 - it is built here
            self._child = None

    @cached_property
    def described(self) -> tuple[tuple[int, int], str]:
        """(width, height) in pixels, and Mitsuba's name of the integrator.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be loaded or rendered.
        """
        if self._child is not None:
            with suppress(Exception):  # what is wrong with the scene is raised below
                size, integrator = self._received()
                return size, integrator
        if not self._end.alive:
            raise RenderError(_ENDED)
        self.close()
        self._child, self._renderer = None, MitsubaRenderer(self.job)
        return _described(self._renderer)

    def __call__(self, method: str, *arguments: Any, **options: Any) -> Any:
        """Return what a method of the renderer returns.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be loaded, or the process has ended.
        """
        with self._lock:
            _ = self.described
            if self._child is None:
                with activate(self.job.backend):
                    return getattr(self._renderer, method)(*arguments, **options)
            try:
                self._send((method, arguments, options))
                return self._received()
            except (OSError, EOFError, ValueError) as error:
                raise RenderError(_ENDED) from error

    def close(self) -> None:
        """End the process."""
        self._end()

    def _send(self, request: Any) -> None:
        assert self._child is not None
        assert self._child.stdin is not None
        self._child.stdin.write(pickle.dumps(request))
        self._child.stdin.flush()

    def _received(self) -> Any:
        assert self._child is not None
        assert self._child.stdout is not None
        done, result = pickle.load(self._child.stdout)  # noqa: S301 - of our own process
        if not done:
            raise result
        return result


def _killed(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()
    for pipe in (child.stdin, child.stdout):
        with suppress(OSError):
            pipe.close()  # type: ignore[union-attr]


def _described(renderer: MitsubaRenderer) -> tuple[tuple[int, int], str]:
    return renderer.size, str(renderer.integrator["type"])


def serve() -> None:
    """Do what is read from standard input until it ends; for the child process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what Mitsuba prints must not come between

    def reply(work: Callable[[], Any]) -> None:
        try:
            found = True, work()
        except Exception as error:  # noqa: BLE001 - raised again in the parent
            found = False, error
        with suppress(BrokenPipeError):  # the parent has ended, and the next request is the end
            results.write(pickle.dumps(found))
            results.flush()

    job: Job = pickle.load(sys.stdin.buffer)  # noqa: S301 - of our own parent
    built: list[MitsubaRenderer] = []
    yields = False

    def build() -> tuple[tuple[int, int], str]:
        built.append(MitsubaRenderer(job))
        return _described(built[0])

    with activate(job.backend):
        reply(build)
        while built:
            try:
                method, arguments, options = pickle.load(sys.stdin.buffer)  # noqa: S301
            except EOFError:
                return
            if method != "preview" and not yields:
                yields = True
                with suppress(AttributeError, OSError):
                    os.nice(5)  # once there is an image, the page goes first
            reply(partial(getattr(built[0], method), *arguments, **options))
