"""Suggestions: pixels that are worth a first look."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from chdstat._core.arrays import Floats
from chdstat._core.positive import PositivePart
from chdstat.explorer.address import PixelIndex
from chdstat.explorer.image_sources import Overall, Sampled
from chdstat.patterns import Thresholds
from chdstat.patterns.classification import Classification
from chdstat.patterns.definitions import firefly_limit
from chdstat.summary.runner import measured

_GRID = 12
"""Pixels along the longer side of the image that are looked at."""
_SPP = 512
_AT_ONCE = 12
_SUGGESTED = (("long tail", ("long_tail",)), ("bimodal", ("bimodal", "multimodal")),
              ("null-heavy", ("null_heavy",)))  # fmt: skip
"""Names, and the patterns that they stand for."""


def first_pixel(overall: Overall) -> PixelIndex:
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


def suggest(source: Sampled) -> Iterator[tuple[float, list[tuple[str, PixelIndex]]]]:
    """Look for a pixel with a long tail, one with several modes and one that is null-heavy.

    Yields the progress, and in the end the pixels. They are chosen from a grid by the surest
    pattern: the largest lower end of the interval of its statistic. Patterns that no pixel of the
    grid has are left out.

    Parameters
    ----------
    source
        Where samples come from; the first 512 of each pixel are read or drawn.
    """
    cell = max(1.0, max(source.size) / _GRID)
    numbers = (max(1, int(length / cell)) for length in source.size)
    ys, xs = (
        ((np.arange(k) + 0.5) * length / k).astype(int).tolist()
        for k, length in zip(numbers, source.size, strict=True)
    )
    pixels = list(product(ys, xs))
    sure: dict[str, list[Floats]] = {name: [] for name, _ in _SUGGESTED}
    for i in range(0, len(pixels), _AT_ONCE):
        yield i / len(pixels), []
        part = PositivePart.of_pixels(source.some(pixels[i : i + _AT_ONCE], _SPP), rows="luminance")
        found = measured(part, Classification())
        for name, patterns in _SUGGESTED:
            lower = [
                np.where(found.flags[p] & (part.n > 0), found.intervals[p][..., 0], -np.inf)
                for p in patterns
            ]
            sure[name].append(np.fmax.reduce(lower, initial=-np.inf))
    chosen: dict[str, PixelIndex] = {}
    for name, parts in sure.items():
        score = np.concatenate(parts)
        score[[pixels.index(p) for p in chosen.values()]] = -np.inf
        if score.max() > -np.inf:
            chosen[name] = pixels[int(score.argmax())]
    yield 1.0, list(chosen.items())
