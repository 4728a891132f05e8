"""Server: the explorer on the loopback interface, from start to stop.

The server starts at once. Until the scene or store is open and its first image is drawn, it shows a
notice without Bokeh, with the progress and the finished part of a coarse image. So this module
imports Bokeh and the page only where they are used, while another process loads the scene.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import errno
import gc
import logging
import signal
import socket
import threading
import webbrowser
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.display import png
from chdstat._core.files import is_exr, place_of
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import InputError
from chdstat.explorer.render_process import COARSE, RenderProcess
from chdstat.rendering.jobs import Job
from chdstat.samples import Samples, is_store
from chdstat.scenes import Scene, load_scene
from chdstat.scenes.scene import MITSUBA

if TYPE_CHECKING:
    from bokeh.application.handlers.handler import Handler
    from bokeh.document import Document
    from bokeh.server.server import Server
    from tornado.httputil import HTTPServerRequest

    from chdstat.estimators.training import TrainedModel
    from chdstat.explorer.workspace import Workspace

DEFAULT_PORT = 5006
"""Default port of the command line, so that the address stays the same."""
_ADDRESS = "127.0.0.1"
_Explored = str | Path | dict[str, Any] | Scene | Samples
"""A store or its path, samples in memory, a scene, or the path of an EXR image."""
_HOSTS = (_ADDRESS, "localhost", "[::1]", "::1")
"""Names of this machine in the header of a request."""
_EVERY = 3000
"""Milliseconds between two checks of a store that is still being written."""
_PASSES = 256
"""Samples of each pixel that are drawn of a scene of another renderer than Mitsuba."""
_BANDS = 4
"""Number of parts in which the coarse image is drawn."""


class Startup:
    """Progress of opening a source.

    Parameters
    ----------
    name
        Name of the store or scene.

    Attributes
    ----------
    text
        What is being done.
    image
        The finished part of the coarse image, as a PNG file in base64; empty for nothing.
    workspace
        State that all pages share; None until the source is open.
    done
        Whether pages can be served.

    Examples
    --------
    >>> Startup("fog").text
    'loading fog'
    """

    def __init__(self, name: str) -> None:
        self.name, self.text, self.image = name, f"loading {name}", ""
        self.done = False
        self.workspace: Workspace | None = None

    def draw(self, render: RenderProcess) -> npt.NDArray[np.float32]:
        """Draw the coarse image of a scene, shape (y, x, channel), and tell how far it is.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be loaded or rendered.
        """
        drawn: list[npt.NDArray[np.float32]] = []
        (width, height), _ = render.described
        for i in range(_BANDS):
            self.text = f"drawing {self.name}: {100 * i // _BANDS} % of the coarse image"
            drawn.append(render("preview", COARSE, 1, band=(i, _BANDS)))
            seen = np.concatenate(drawn)
            whole = np.zeros((max(1, round(height / width * seen.shape[1])), *seen.shape[1:]))
            whole[: len(seen)] = seen[: len(whole)]
            file = png(tonemap(whole, exposure=display_stops(seen)))
            self.image = base64.b64encode(file).decode("ascii")
        self.text = f"opening the page of {self.name}"
        return seen


class Explorer(contextlib.AbstractContextManager["Explorer"]):
    """A running explorer, returned by `explore`; a notebook shows its page.

    Use it in a ``with`` block, call `stop` when done, or `wait` in a script that does nothing else.

    Attributes
    ----------
    port
        Port of the server.
    url
        Address of the page.
    """

    def __init__(self, port: int, name: str) -> None:
        self._startup = Startup(name)
        started: Future[tuple[Any, Any]] = Future()
        self._thread = threading.Thread(
            target=_serve, args=(self._startup, port, started), name="chdstat-explorer", daemon=True
        )
        self._thread.start()
        self._loop, self._server = started.result()
        self.port = int(self._server.port)
        self.url = f"http://{_ADDRESS}:{self.port}/"

    def _show(self, workspace: Workspace) -> None:
        """Serve pages in the place of the notice."""
        self._startup.workspace = workspace
        workspace.start()
        self._startup.done = True

    def stop(self) -> None:
        """Stop serving and end all threads; a second call does nothing."""
        if self._thread.is_alive():
            self._loop.add_callback(self._end)
            self._thread.join(timeout=10)
        if self._startup.workspace is not None:
            self._startup.workspace.stop()

    def wait(self) -> None:
        """Serve until Ctrl-C or SIGTERM; call it in the main thread."""
        # From here on, the process only serves. Garbage collection over everything that is loaded
        # would delay a click by a tenth of a second.
        gc.collect()
        gc.freeze()
        stopped = threading.Event()
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, lambda *_: stopped.set()) for number in numbers}
        try:
            while not stopped.wait(0.2) and self._thread.is_alive():
                pass
        finally:
            gc.unfreeze()
            for number, handler in before.items():
                signal.signal(number, handler)
            self.stop()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        state = f"at {self.url}" if self._thread.is_alive() else "stopped"
        return f"<Explorer of {self._startup.name!r} {state}>"

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{self.url}" title="chdstat explorer" width="100%" height="820" '
            'style="border: 0"></iframe>'
        )

    def _end(self) -> None:
        """Tell all pages, give them a moment to hear it, and leave the loop."""
        for page in list(self._server._tornado._clients):
            page._socket.close(1001, "the explorer has stopped")
        self._loop.call_later(0.1, self._loop.stop)


def _serve(startup: Startup, port: int, started: Future[tuple[Any, Any]]) -> None:
    """Own the loop of the server from its start to its end."""
    from tornado.ioloop import IOLoop

    try:
        asyncio.set_event_loop(asyncio.new_event_loop())
        loop = IOLoop.current()
        server = _bound(startup, port)
        server.start()
    except BaseException as error:  # noqa: BLE001 - handed to the thread that waits
        started.set_exception(error)
        return
    started.set_result((loop, server))
    try:
        loop.start()
    finally:
        with contextlib.suppress(Exception):
            server.stop()
        loop.close()


def explore(
    source: _Explored | Sequence[_Explored],
    *,
    models: Sequence[TrainedModel[Any] | str | Path] = (),
    maps: str | Path | None = None,
    port: int = 0,
    browser: bool = False,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    max_depth: int | None = None,
) -> Explorer:
    """Serve a page on which a click on a pixel shows its distribution.

    Only this machine can open the page. The server runs in a thread, so the call returns at once.
    In a notebook, the last expression of a cell shows the page.

    Parameters
    ----------
    source
        A store or its path, samples in memory, or anything that `chdstat.load_scene` takes: a scene
        is drawn coarsely, and a pixel is sampled when it is selected; one of another renderer than
        Mitsuba is first rendered with 256 samples per pixel. Several sources of the same
        size are contrasted: stores, EXR images, and a scene as the first. If two stores have the
        same seed, and so the same random numbers, their samples are compared in pairs.
    models
        Trained estimators, or their files, shown among the estimates, with their certainty if
        they have one.
    maps
        Maps from ``chdstat analyze -o``, added to the menu.
    port
        Port of the server; 0 takes a free one.
    browser
        Open the page in the web browser.
    size, seed, max_depth
        For a scene only, as for `chdstat.render`.

    Returns
    -------
    Explorer
        With the page's ``url``, and ``stop()``.

    Raises
    ------
    InputError
        If the port is taken, the sources do not fit each other, or there are more than nine.
    StoreError, SceneError, RenderError
        If the source or a model cannot be read, or the scene cannot be rendered.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> samples = chd.Samples.from_array(np.ones((4, 6, 3, 32)), scene="flat")
    >>> with chd.explore([samples, "reference.exr"]) as explorer:  # doctest: +SKIP
    ...     print(explorer.url)
    http://127.0.0.1:38671/
    """
    sources: list[Any] = [source]
    if isinstance(source, Sequence) and not isinstance(source, str):
        sources = list(source)
    if len(sources) != 1:  # a scene alone is drawn while all else is imported
        from chdstat.explorer.address import check_sources

        check_sources(sources)
    render = explorer = coarse = None
    first = sources[0]
    if isinstance(first, Samples):
        name = first.name
    elif is_exr(first) or is_store(first):
        name = place_of(first).name
    elif (scene := load_scene(first)).renderer != MITSUBA:
        sources[0] = _recorded(scene, size, seed, max_depth)
        name = scene.name
    else:
        job = Job.of(first, size=size, seed=seed, max_depth=max_depth, backend="scalar")
        render, name = RenderProcess(job), job.scene.name
    drawing = ThreadPoolExecutor(1, thread_name_prefix="chdstat-startup")
    try:
        explorer = Explorer(port, name)
        if browser:
            webbrowser.open(explorer.url)
        if render is not None:
            coarse = drawing.submit(explorer._startup.draw, render)
        # It takes seconds, in which the scene is loaded and its first image drawn.
        from chdstat.explorer.image_sources import SceneSource
        from chdstat.explorer.workspace import opened

        if render is not None and coarse is not None:
            sources[0] = SceneSource(render, coarse.result())
        explorer._show(opened(sources, models, maps=maps))
    except BaseException:
        if render is not None:
            render.close()
        if explorer is not None:
            explorer.stop()
        raise
    finally:
        drawing.shutdown(wait=False)
    return explorer


def _recorded(
    scene: Scene, size: tuple[int, int] | None, seed: int, max_depth: int | None
) -> Samples:
    """Return samples of a small image of another renderer, which cannot draw single pixels."""
    from chdstat.rendering import render
    from chdstat.rendering.recipes import recipe_of

    view = recipe_of(scene, spp=_PASSES, seed=seed).settings()
    return render(scene, **view | {"size": size or view["size"], "max_depth": max_depth})


# --- Bokeh --------------------------------------------------------------------------------------


def _bound(startup: Startup, port: int) -> Server:
    """Return a server that is bound to its port.

    Only pages that it served itself may open a websocket: Bokeh refuses every other origin.
    """
    from bokeh.application.application import Application
    from bokeh.server.server import Server

    logging.getLogger("bokeh").setLevel(logging.ERROR)
    _check_port(port)
    server = Server(
        {"/": Application(_pages(startup))},
        port=port,
        address=_ADDRESS,
        check_unused_sessions_milliseconds=5000,
        unused_session_lifetime_milliseconds=15000,
        session_token_expiration=600,
    )
    # The port that was found is the one that pages come from.
    server._tornado.websocket_origins.update(
        {f"{_ADDRESS}:{server.port}", f"localhost:{server.port}"}
    )
    _serve_startup(server._tornado, startup)
    return server


def _pages(startup: Startup) -> Handler:
    """Return what fills new pages one at a time, in a thread: the pages that are there go on."""
    from bokeh.application.handlers.handler import Handler

    class Pages(Handler):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self._turn = asyncio.Lock()

        async def on_session_created(self, session_context: Any) -> None:
            async with self._turn:
                await asyncio.to_thread(_open, session_context._document, startup.workspace)

        def modify_document(self, doc: Document) -> None:
            """Do nothing: it is filled by now."""

    return Pages()


def _serve_startup(application: Any, startup: Startup) -> None:
    """Respond only to names of this machine, and with a notice while there is nothing to show.

    A page elsewhere may let its own name point here (DNS rebinding): to its browser, what is read
    from here is then its own.
    """
    from tornado.httputil import split_host_and_port
    from tornado.web import ErrorHandler

    find, notice = application.find_handler, _notice(startup)

    def find_here(request: HTTPServerRequest) -> Any:
        if split_host_and_port(request.host.lower())[0] not in _HOSTS:
            return application.get_handler_delegate(request, ErrorHandler, {"status_code": 403})
        if request.path == "/progress" or (request.path == "/" and not startup.done):
            return application.get_handler_delegate(request, notice)
        return find(request)

    application.find_handler = find_here


def _notice(startup: Startup) -> type[Any]:
    """Return Tornado's handler of the notice, and of ``/progress``, which it asks."""
    from bokeh.core.templates import get_env
    from tornado.web import RequestHandler

    web = resources.files("chdstat.explorer") / "web"
    page, style = ((web / name).read_text("utf-8") for name in ("startup.html", "page.css"))
    template = get_env().from_string(page)

    class Notice(RequestHandler):
        def get(self) -> None:
            self.set_header("Cache-Control", "no-store")
            if self.request.path == "/progress":
                names = ("text", "image", "done")
                self.finish({name: getattr(startup, name) for name in names})
            else:
                self.finish(template.render(style=style, name=startup.name, text=startup.text))

    return Notice


def _check_port(port: int) -> None:
    """Try the port before the server does, which would leave its socket open."""
    if not 0 <= port < 2**16:
        message = f"port must be between 0 and {2**16 - 1}, got {port}"
        raise InputError(message)
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_ADDRESS, port))
        except OSError as error:
            why = "is taken" if error.errno == errno.EADDRINUSE else f"fails: {error.strerror}"
            message = f"port {port} {why}; give another with --port, or 0 for any that is free"
            raise InputError(message) from error


def _open(document: Document, workspace: Workspace | None) -> None:
    """Fill the document of a new page."""
    from chdstat.explorer.image_sources import StoreSource
    from chdstat.explorer.session import Session

    assert workspace is not None, "no page is opened before there is something to show"
    # What Bokeh hands out has more than its type says.
    context: Any = document.session_context
    request = context.request if context else None
    arguments = {
        name: [value.decode("utf-8", "replace") for value in values]
        for name, values in (request.arguments if request else {}).items()
        if not name.startswith("bokeh")
    }
    Session(document, workspace, arguments)
    if any(isinstance(one, StoreSource) and not one.complete for one in workspace.sources):
        document.add_periodic_callback(workspace.refresh, _EVERY)
