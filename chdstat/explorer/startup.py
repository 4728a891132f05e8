"""Images as a browser shows them, and the notice that is there until a source is open.

The notice is HTML without Bokeh. It asks every moment how far the source is, shows as much of the
coarse image as is drawn, and gives way to the page itself. What it needs is imported in a moment,
where the page takes seconds.
"""

from __future__ import annotations

import base64
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, luminance
from chdstat._core.display import png
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.explorer.render_process import RenderProcess

if TYPE_CHECKING:
    from chdstat.explorer.shared import Shared

__all__ = ["COARSE", "Startup", "coarse_png", "isolated", "ramp", "rgba", "startup_handler"]

COARSE = 128
"""Pixels of the longer side of the coarse image."""
_BANDS = 4


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


# --- images as a browser shows them -------------------------------------------------------------

_FILMIC = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30)
_WHITE = 11.2


@cache
def ramp(name: str = "viridis") -> tuple[str, ...]:
    """Return 256 colours of one of Matplotlib's maps, distinct for the colour-blind."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return tuple(to_hex(color) for color in colormaps[name](range(256)))


def isolated(mean: Image, channel: str) -> Image:
    """Return an image of one channel, or of luminance, as a grey one; of "all" the image itself."""
    if channel == "all" or mean.shape[-1] == 1:
        return mean
    grey = luminance(mean, channel_axis=-1) if channel == "luminance" else mean[..., int(channel)]
    return np.repeat(grey[..., np.newaxis], mean.shape[-1], axis=-1).astype(np.float32)


def rgba(mean: Image, exposure: float, tone: str) -> npt.NDArray[np.uint32]:
    """Return an image as a browser wants it: packed RGBA, shape (y, x).

    Parameters
    ----------
    mean
        Linear radiance, shape (y, x, channel); what is not finite becomes magenta.
    exposure
        Stops.
    tone
        'srgb' clips, 'reinhard' maps v to v / (1 + v), 'filmic' is Hable's curve.

    References
    ----------
    Reinhard, Stark, Shirley and Ferwerda, "Photographic tone reproduction for digital images",
    2002, doi:10.1145/566654.566575, equation 3. Hable, "Uncharted 2: HDR lighting", Game Developers
    Conference 2010.

    Examples
    --------
    >>> hex(rgba(np.ones((1, 1, 3), np.float32), 0, "srgb")[0, 0])
    '0xffffffff'
    """
    with np.errstate(invalid="ignore", over="ignore"):
        value = mean * np.float32(2.0**exposure)
        if tone == "reinhard":
            value = np.where(np.isfinite(value), value / (1 + value), value)
        elif tone == "filmic":
            value = np.where(
                np.isfinite(value), _hable(2 * value) / _hable(np.float32(_WHITE)), value
            )
    shown = tonemap(value, exposure=0)
    packed = np.full((*shown.shape[:2], 4), 255, np.uint8)
    packed[..., :3] = np.round(255 * shown)
    return packed.view(np.uint32)[..., 0]


def coarse_png(mean: Image, exposure: float, tone: str) -> str:
    """Return an image with few pixels, as a PNG file in base64; parameters as for `rgba`."""
    step = -(-max(mean.shape[:2]) // COARSE)
    packed = np.ascontiguousarray(rgba(mean[::step, ::step], exposure, tone))
    colors = packed.view(np.uint8).reshape(*packed.shape, 4)[..., :3]
    return base64.b64encode(png(colors / 255)).decode("ascii")


def _hable(v: npt.NDArray[np.float32] | np.float32) -> npt.NDArray[np.float32]:
    a, b, c, d, e, f = _FILMIC
    v = np.minimum(v, np.float32(1e15))  # v squared stays within float32
    return np.asarray((v * (a * v + c * b) + d * e) / (v * (a * v + b) + d * f) - e / f, np.float32)
