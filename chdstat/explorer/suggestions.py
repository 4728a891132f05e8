"""Suggestions: pixels worth a first look, found before anyone has clicked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from chdstat.explorer.scene_source import Source
from chdstat.explorer.sources import Overall
from chdstat.explorer.view import Pixel
from chdstat.patterns import Thresholds
from chdstat.patterns.classification import luminance_part, patterns_of
from chdstat.patterns.pixel_statistics import PixelFits, firefly_limit

__all__ = ["first_pixel", "suggest"]

_GRID = 12
"""Pixels along the longer side of the image that are looked at."""
_SPP = 512
_AT_ONCE = 12
_SUGGESTED = (("long tail", ("long_tail",)), ("bimodal", ("bimodal", "multimodal")),
              ("null-heavy", ("null_heavy",)))  # fmt: skip
"""Names, and the patterns that they stand for."""

Floats = npt.NDArray[np.float64]


def first_pixel(overall: Overall) -> Pixel:
    """Return the pixel with the brightest firefly, or the centre of an image without any.

    Examples
    --------
    >>> first_pixel(Overall.empty(5, 9, 3))
    (2, 4)
    """
    count = np.nan_to_num(overall.good_count).astype(np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = overall.extreme / (overall.extreme + overall.others)
        is_firefly = share > firefly_limit(count, Thresholds())
    height, width = share.shape
    if not is_firefly.any():
        return height // 2, width // 2
    brightest = int(np.argmax(np.where(is_firefly, overall.extreme, -np.inf)))
    return brightest // width, brightest % width


def suggest(source: Source, step: Callable[[float], None]) -> list[tuple[str, Pixel]]:
    """Return a pixel with a long tail, one with several modes and one that is null-heavy.

    Of a grid of pixels, those whose pattern is surest: the lower end of the interval of its
    statistic is the largest. What no pixel of the grid has is left out.

    Parameters
    ----------
    source
        Where samples come from; the first 512 of each pixel are read or drawn.
    step
        Called with the share that is done; whatever it raises ends the search.
    """
    pixels = _grid(*source.size)
    sure: dict[str, list[Floats]] = {name: [] for name, _ in _SUGGESTED}
    for i in range(0, len(pixels), _AT_ONCE):
        step(i / len(pixels))
        part = luminance_part(source.some(pixels[i : i + _AT_ONCE], _SPP))
        found = patterns_of(PixelFits(part))
        for name, patterns in _SUGGESTED:
            lower = [
                np.where(found.flags[p] & (part.n > 0), found.intervals[p][..., 0], -np.inf)
                for p in patterns
            ]
            sure[name].append(np.fmax.reduce([*lower, np.full(len(part.n), -np.inf)]))
    chosen: dict[str, Pixel] = {}
    for name, parts in sure.items():
        score = np.concatenate(parts)
        score[[pixels.index(p) for p in chosen.values()]] = -np.inf
        if score.max() > -np.inf:
            chosen[name] = pixels[int(score.argmax())]
    return list(chosen.items())


def _grid(height: int, width: int) -> list[Pixel]:
    """Return pixels in the middle of cells of equal size."""
    cell = max(1.0, max(height, width) / _GRID)
    ys, xs = (
        ((np.arange(max(1, int(k / cell))) + 0.5) * k / max(1, int(k / cell))).astype(int).tolist()
        for k in (height, width)
    )
    return [(y, x) for y in ys for x in xs]
