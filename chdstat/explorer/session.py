"""Session: one page, its commands, and the image that it shows.

Every command is checked, and what it cannot do becomes a message on the page. A `Worker` computes
what there is to say about the selection, an `ImageDisplay` shows the image or a map.
"""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from bokeh.document import Document

from chdstat.errors import ChdstatError, InputError
from chdstat.explorer.estimators import fixed_names
from chdstat.explorer.exports import File, exported
from chdstat.explorer.images import Overall, SceneSource, rgba
from chdstat.explorer.maps import IMAGES, MAPS, map_kind, of_overall
from chdstat.explorer.page import EXPORTS, Page, PageConnection, colorbar
from chdstat.explorer.palette import PIXEL_COLORS
from chdstat.explorer.shared import Shared
from chdstat.explorer.sources import StoreSource
from chdstat.explorer.view import View, box_between, check_pixel, parse_view
from chdstat.explorer.worker import Worker

__all__ = ["ImageDisplay", "Session"]


class ImageDisplay:
    """Shows images and maps on a page, as a view wants them.

    Parameters
    ----------
    page
        Where to.
    shared
        Where they come from.
    """

    def __init__(self, page: Page, shared: Shared) -> None:
        self._page, self._shared = page, shared

    @property
    def overall(self) -> Overall:
        """The image so far."""
        source = self._shared.source
        return self._shared.overall or Overall.empty(*source.size, len(source.channels))

    def exposure(self, view: View) -> float:
        """Return the stops that the image is shown with."""
        return self.overall.exposure if view.exposure is None else view.exposure

    def image(self, view: View) -> None:
        """Show the image, or both."""
        exposure, mean = self.exposure(view), self.overall.mean
        if not np.isfinite(mean).any():  # nothing is drawn yet, which is no error
            mean = np.zeros_like(mean)
        self._page.show_image(0, rgba(mean, exposure, view.tone), mean)
        other = self._shared.other_overall
        if other is not None:
            self._page.show_image(1, rgba(other.mean, exposure, view.tone), other.mean)

    def want_map(self, name: str) -> None:
        """See to it that a map gets computed.

        Raises
        ------
        InputError
            If there is no such map, or no store to make it of.
        """
        if isinstance(self._shared.source, SceneSource):
            if (kind := map_kind(name)).name in IMAGES:
                return
            message = (
                f"{kind.title!r} needs a store: render the scene with "
                "'chdstat render SCENE -o STORE'"
            )
            raise InputError(message)
        self._shared.want(name)

    def map(self, view: View) -> None:
        """Show what there is of the map, or take it away."""
        found = None
        if view.map != "image":
            overall = self._shared.overall
            found = of_overall(overall, view.map) if overall is not None else None
            found = found or self._shared.maps.get(view.map)
        self._page.show_map(found)
        self._page.send({"kind": "colorbar", "bar": colorbar(found)})


class Session:
    """One page.

    Parameters
    ----------
    document
        The Bokeh document of the page.
    shared
        What it has in common with others.
    arguments
        The query of its address: values by name.
    """

    def __init__(
        self, document: Document, shared: Shared, arguments: Mapping[str, list[str]]
    ) -> None:
        self._shared = shared
        page = _page(document, shared)
        self._size = shared.source.size
        self.view, self._notes = parse_view(arguments, *self._size)
        self._connection = PageConnection(document, page, self._gone)
        self._worker = Worker(shared, self._connection)
        self._display = ImageDisplay(page, shared)
        page.inbox.on_change("value", self._received)
        self._ends = shared.listen(lambda what: self._connection.next(partial(self._heard, what)))
        document.on_session_destroyed(lambda _: self._connection.close())

    def _gone(self) -> None:
        self._worker.close()
        self._ends()

    # --- commands -------------------------------------------------------------------------------

    def _received(self, _attribute: str, _old: str, new: str) -> None:
        try:
            message = json.loads(new)
            command, seq = str(message.pop("command")), int(message.pop("seq"))
            handle = self._commands[command]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            self._connection.alert("the page sent something that is no command; reload it")
            return
        try:
            handle(self, seq, **message)
        except ChdstatError as error:
            self._connection.alert(str(error))
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            self._connection.alert(f"the command {command!r} was not understood: {error}")

    def _ready(self, seq: int) -> None:
        source, other = self._shared.source, self._shared.other
        parts = [source.describe()]
        if other is not None:
            parts.append(f"against {other.name}: {other.describe()}")
        self._connection.send({"kind": "described", "text": "  |  ".join(parts)})
        self._display.image(self.view)
        notes = list(self._notes)
        if self.view.map != "image":
            try:
                self._display.want_map(self.view.map)
            except InputError as error:
                notes.append(str(error))
                self.view = self.view.changed(map="image")
        self._display.map(self.view)
        if notes:
            self._connection.alert("; ".join(notes))
        self._heard("working")
        self._go(seq, self.view)

    def _pick(self, seq: int, *, y: int, x: int, add: bool = False) -> None:
        y, x = int(y), int(x)
        check_pixel(y, x, *self._size)
        self._go(seq, self.view.pick(y, x, add=bool(add)))

    def _box(self, seq: int, *, box: list[float]) -> None:
        top, left, bottom, right = (float(v) for v in box)
        self._go(seq, self.view.box(box_between((top, left), (bottom, right), *self._size)))

    def _move(self, seq: int, *, dy: int, dx: int) -> None:
        self._go(seq, self.view.move(int(dy), int(dx)).clipped(*self._size))

    def _activate(self, seq: int, *, index: int) -> None:
        self._go(seq, self.view.activate(int(index)))

    def _drop(self, seq: int, *, index: int) -> None:
        self._go(seq, self.view.drop(int(index)))

    def _set(self, seq: int, *, option: str, value: Any) -> None:
        option = str(option)
        if option == "map":
            if value != "image":
                self._display.want_map(str(value))
            self.view = self.view.changed(map=str(value))
            self._display.map(self.view)
            self._show_view()
            return
        view = self.view.changed(**{option: value})
        if option not in {"exposure", "tone"}:
            self._go(seq, view)
            return
        self.view = view
        self._display.image(view)
        self._show_view()

    def _export(self, seq: int, *, format: str) -> None:  # noqa: A002 - its name on the page
        del seq
        if format not in EXPORTS:
            message = f"exports are {', '.join(EXPORTS)}; got {format!r}"
            raise InputError(message)
        if self._worker.shown is None:
            message = "nothing is selected: click a pixel before exporting"
            raise InputError(message)
        self._connection.send({"kind": "working", "text": f"exporting {format}"})
        overall, exposure = self._display.overall, self._display.exposure(self.view)
        work = partial(exported, format, self._worker.shown, self.view, overall, exposure)
        future = self._shared.exports.submit(work)
        future.add_done_callback(lambda f: self._connection.next(partial(self._exported, f)))

    def _pause(self, seq: int) -> None:
        del seq
        self._worker.pause()

    def _seen(self, seq: int, *, on: bool) -> None:
        del seq
        self._worker.see(bool(on))

    def _try_fits(self, seq: int) -> None:
        del seq
        self._worker.try_fits()

    def _near(self, seq: int, *, y: int, x: int) -> None:
        """Read what is pointed at, so that it is there when it is clicked."""
        del seq
        source = self._shared.source
        if isinstance(source, StoreSource):
            with contextlib.suppress(RuntimeError):  # the explorer is closing
                self._shared.exports.submit(source.pixel, int(y), int(x))

    _commands: Mapping[str, Callable[..., None]] = {
        "ready": _ready,
        "pick": _pick,
        "box": _box,
        "move": _move,
        "near": _near,
        "activate": _activate,
        "drop": _drop,
        "set": _set,
        "export": _export,
        "pause": _pause,
        "visible": _seen,
        "goodness": _try_fits,
    }

    # --- what they change -----------------------------------------------------------------------

    def _go(self, seq: int, view: View) -> None:
        """Show the selection at once, and its results when they are computed."""
        self.view = view
        self._show_view()
        self._worker.compute(view, seq)

    def _heard(self, what: str) -> None:
        """Show news of the passes over the image, or of the source."""
        if what == "working":
            self._connection.send({"kind": "working", "text": self._shared.working})
            if self._shared.failed:
                self._connection.alert(self._shared.failed)
        elif what == "image":
            self._display.image(self.view)
            self._show_view()
            self._display.map(self.view)
        elif what == "source":
            self._connection.send({"kind": "described", "text": self._shared.source.describe()})
            self._show_view()
            self._worker.compute(self.view)
        elif what == self.view.map:
            self._display.map(self.view)

    def _show_view(self) -> None:
        self._connection.send(
            {
                "kind": "view",
                "view": asdict(self.view),
                "query": self.view.query(),
                "exposure": self._display.exposure(self.view),
                "colors": PIXEL_COLORS,
            }
        )

    def _exported(self, future: Future[File]) -> None:
        self._connection.send({"kind": "working", "text": ""})
        if future.cancelled():
            return
        if error := future.exception():
            self._connection.alert(f"the export failed: {error}")
            return
        file = future.result()
        data = base64.b64encode(file.content).decode("ascii")
        self._connection.send({"kind": "file", "name": file.name, "type": file.type, "data": data})


def _page(document: Document, shared: Shared) -> Page:
    source, other = shared.source, shared.other
    rendered = isinstance(source, StoreSource)
    titles = [source.name] if other is None else [source.name, other.name]
    return Page(
        document,
        titles=titles,
        size=source.size,
        channels=source.channels,
        heading=" and ".join(titles),
        maps=[kind for kind in MAPS.values() if rendered or kind.name in IMAGES],
        errors=fixed_names() if rendered else (),
    )
