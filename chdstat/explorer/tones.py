"""Tones and colours: an image as a browser shows it, and the colours of maps."""

from __future__ import annotations

import base64
from functools import cache

import numpy as np
import numpy.typing as npt

from chdstat import viz
from chdstat._core.arrays import luminance
from chdstat._core.display import png
from chdstat.explorer.startup import COARSE

__all__ = ["coarse_png", "isolated", "ramp", "rgba"]

_FILMIC = (0.15, 0.50, 0.10, 0.20, 0.02, 0.30)
_WHITE = 11.2

Image = npt.NDArray[np.float32]


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
    shown = viz.tonemap(value, exposure=0)
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
