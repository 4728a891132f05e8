"""Startup: what the server responds with until a source is open, its coarse image included.

The notice is HTML without Bokeh. It asks every moment how far the source is, shows as much of the
coarse image as is drawn, and gives way to the page itself. What it needs is imported in a moment,
where the page takes seconds.
"""

from __future__ import annotations

import base64
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.display import png
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.explorer.render_process import RenderProcess

if TYPE_CHECKING:
    from chdstat.explorer.shared import Shared

__all__ = ["COARSE", "Startup", "startup_handler"]


COARSE = 128
"""Pixels of the longer side of the coarse image."""
_BANDS = 4

Image = npt.NDArray[np.float32]


class Startup:
    """How far a source is.

    Parameters
    ----------
    name
        Of the store or scene.

    Attributes
    ----------
    text
        What is being done.
    image
        As much of the coarse image as is drawn, as the file of a PNG image in base64; empty for
        nothing.
    shared
        What all pages share; None until the source is open.
    drawn
        Whether that is all of it.
    done
        Whether pages can be served.

    Examples
    --------
    >>> Startup("fog").text
    'loading fog'
    """

    def __init__(self, name: str) -> None:
        self.name, self.text, self.image = name, f"loading {name}", ""
        self.drawn = self.done = False
        self.shared: Shared | None = None

    def draw(self, render: RenderProcess) -> Image:
        """Draw the coarse image of a scene, shape (y, x, channel), and tell how far it is.

        Raises
        ------
        SceneError, RenderError
            If the scene cannot be loaded or rendered.
        """
        drawn: list[Image] = []
        (width, height), _ = render.described
        for i in range(_BANDS):
            self.text = f"drawing {self.name}: {100 * i // _BANDS} % of the coarse image"
            drawn.append(render("preview", COARSE, 1, band=(i, _BANDS)))
            seen = np.concatenate(drawn)
            whole = np.zeros((max(1, round(height / width * seen.shape[1])), *seen.shape[1:]))
            whole[: len(seen)] = seen[: len(whole)]
            file = png(tonemap(whole, exposure=display_stops(seen)))
            self.image = base64.b64encode(file).decode("ascii")
        self.drawn = True
        self.text = f"opening the page of {self.name}"
        return seen


def startup_handler(startup: Startup) -> type[Any]:
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
                names = ("text", "image", "drawn", "done")
                self.finish({name: getattr(startup, name) for name in names})
            else:
                self.finish(template.render(style=style, name=startup.name, text=startup.text))

    return Notice
