"""_Choice of pixels to certify: from all over an image, of every pattern, quiet and noisy ones.

The image is cut into blocks, 8 x 8 by default, and each block gives one pixel. It is of the kind
that was chosen least often so far. A kind is a pattern of `chdstat.classify` in one fourth of the
image's pixels by relative noise, so that rare patterns and extreme noise are as frequent as common
ones. `_Choice.weight` undoes that, for figures of the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Counts, Floats, flag_names, luminance
from chdstat.errors import InputError
from chdstat.patterns import classify
from chdstat.samples import Samples

BLOCKS = 8
"""Blocks along each side of the image; each gives one pixel."""
_FOURTHS = 4
_STRIDE = 37
"""Blocks are visited in this step, which is coprime to any power of two: neighbours are far apart
in the order, so that no region of the image gets first choice of the rare kinds."""


@dataclass(frozen=True)
class _Choice:
    """Pixels of an image; all arrays over the pixels, in the order of their blocks.

    Attributes
    ----------
    pixels
        (y, x) of each pixel, shape (pixel, 2).
    pattern
        Name of each pixel's pattern at the number of samples that were looked at.
    noise
        Standard deviation of luminance over its mean, of the same samples; 0 where all are null.
    weight
        Pixels of the image that each stands for: those of its kind over the chosen ones of it.
    """

    pixels: Counts
    pattern: npt.NDArray[np.str_]
    noise: Floats
    weight: Floats


def chosen(samples: Samples, blocks: int = BLOCKS) -> _Choice:
    """Choose one pixel from each of `blocks` x `blocks` blocks of an image.

    The choice depends on nothing but the samples.

    Raises
    ------
    InputError
        If the image has fewer rows or columns than blocks.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.simulate("gamma", shape=(16, 16), spp=64)
    >>> chosen(samples, blocks=4).pixels[:3].tolist()
    [[0, 0], [0, 6], [0, 8]]
    """
    height, width = samples.shape[:2]
    if min(height, width) < blocks:
        message = (
            f"an image needs at least {blocks} x {blocks} pixels to choose one from each block, "
            f"got {width} x {height}; render it larger"
        )
        raise InputError(message)
    noise = _noise(samples)
    labels = classify(samples)["label"]
    kinds = _kinds(labels.to_numpy(), noise)
    places = _places(kinds, blocks)
    at = tuple(places.T)
    names = flag_names(labels.attrs)
    pattern = np.array([names[label] for label in labels.to_numpy()[at].tolist()])
    image = np.bincount(kinds.ravel())
    weight = image[kinds[at]] / np.bincount(kinds[at], minlength=len(image))[kinds[at]]
    return _Choice(places, pattern, noise[at], weight)


def _noise(samples: Samples) -> Floats:
    """Return the relative standard deviation of luminance, shape (y, x)."""
    values = luminance(samples.read()).astype(np.float64)
    mean = values.mean(axis=-1)
    spread = values.std(axis=-1)
    noise: Floats = np.divide(spread, np.abs(mean), out=np.zeros_like(mean), where=mean != 0)
    return noise


def _kinds(labels: Array, noise: Floats) -> Counts:
    """Return a number for each pixel's pattern and its fourth of the noise, shape (y, x)."""
    ends = np.quantile(noise, np.arange(1, _FOURTHS) / _FOURTHS)
    return np.asarray(labels * _FOURTHS + np.searchsorted(ends, noise), np.int64)


def _places(kinds: Counts, blocks: int) -> Counts:
    """Return (y, x) of one pixel of each block, of the kind chosen least often so far."""
    rows, columns = (np.linspace(0, n, blocks + 1).astype(int) for n in kinds.shape)
    taken = np.zeros(kinds.max() + 1, np.int64)
    places = np.empty((blocks**2, 2), np.int64)
    for turn in range(blocks**2):
        block = turn * _STRIDE % blocks**2
        i, j = divmod(block, blocks)
        inside = kinds[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
        candidates = np.argwhere(taken[inside] == taken[inside].min())
        y, x = candidates[turn * _STRIDE % len(candidates)]
        taken[inside[y, x]] += 1
        places[block] = rows[i] + y, columns[j] + x
    return places
