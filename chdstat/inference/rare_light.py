r"""Rare light: differences that one render may have by meeting light too rarely.

Flips of signs assume that both renders have one distribution. If one of them aims at a lamp, and
the other meets it by chance, once in hundreds of samples, a window in which the other has met it
never is black, and nothing in its samples there tells that more light was to come. The samples
around tell: if each of them carries about as much as the whole difference, one more in the window
would have closed it. That explains a window, or a pixel, that lacks at least half of the light,
where the other render meets it in smaller samples; it explains no small loss, and nothing between
renders of one distribution. If the render lacks nearly all light around, what little it has met
there does not tell either, and its samples in the whole image stand for them.

The variance of a pixel over its mean is the size of the samples that carry its light, if they are
rare. So a difference D of sums is worth :math:`\lambda = D / e` such samples, of size e. None of
them is met with a probability of at most :math:`e^{-\lambda}`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from chdstat._core.arrays import Array, Floats, Mask
from chdstat.inference.windows import CHANCE_TO_MISS, ClearestWindow

_AROUND = 12
"""Pixels around a window that show how large samples are, or as many as the window has."""
_LARGER = 4.0
"""Samples of the darker render around are at least this many times as large as those of the
brighter one in the window."""
_LACKS = 0.5
"""Share of the light of the brighter render that the darker one lacks, at least."""
_BLIND = 0.9
"""Likewise around, if what the darker render has met there does not tell how large samples are."""
_ENOUGH = -math.log(CHANCE_TO_MISS)
"""Expected number of samples of which none is met with that probability."""


class _Unmet(NamedTuple):
    """Light that a render may not have met by chance.

    Attributes
    ----------
    render
        0 for A, 1 for B.
    expected
        Samples with such light that the difference is worth.
    """

    render: int
    expected: float

    def needed(self, spp: int) -> int:
        """Return the samples per pixel that miss the light with a probability of 5 %."""
        return math.ceil(spp * _ENOUGH / self.expected)


class RareLight:
    """How large the samples are that carry the light of two renders, over the image.

    Parameters
    ----------
    maps
        Means ``mean_a``, ``mean_b``, and variances of a sample ``spread_a``, ``spread_b``, (y, x,
        band).
    spp
        Samples per pixel of A and B.
    """

    def __init__(self, maps: Mapping[str, Array], spp: tuple[int, int]) -> None:
        means = np.stack([np.nan_to_num(maps[f"mean_{n}"]) for n in "ab"])
        variances = np.stack([np.nan_to_num(maps[f"spread_{n}"]) for n in "ab"])
        self._means, self._spp = means, spp
        # What is constant, such as a lamp in view, tells nothing of the size of rare samples.
        self._sums = np.stack([variances, np.where(variances > 0, np.maximum(means, 0), 0)])
        self._of_image = _size(*self._sums.sum(axis=(2, 3)))

    def in_window(
        self, ys: slice, xs: slice, band: int, weights: Floats | float = 1.0
    ) -> _Unmet | None:
        """Return the light that one render may not have met in a window; None if it had met it.

        `weights`, (y, x), are those of pixels in the sums that were tested.
        """
        means = self._means[:, ys, xs, band]
        w = np.broadcast_to(weights, means.shape[1:])
        of_both = (w * means).sum(axis=(1, 2))
        darker = int(of_both.argmin())
        brighter = 1 - darker
        if not _lacks(of_both[darker], of_both[brighter]):
            return None
        around = []
        for of, length in zip((ys, xs), w.shape, strict=True):
            more = max(_AROUND, length)
            around.append(slice(max(of.start - more, 0), of.stop + more))
        near = self._sums[:, :, around[0], around[1], band].sum(axis=(2, 3))
        size = _size(*near[:, darker])
        if _lacks(near[1, darker], near[1, brighter], _BLIND):
            size = self._of_image[darker, band]
        # Weights make samples of equal size differ.
        size = size * (w**2 * means[brighter]).sum() / of_both[brighter]
        variance, light = self._sums[:, brighter, ys, xs, band]
        own = _size((w**2 * variance).sum(), (w * light).sum())
        lost = float(of_both[brighter] - of_both[darker]) * self._spp[darker]
        expected = float(_expected(lost, size, own))
        return _Unmet(darker, expected) if 0 < expected < _ENOUGH else None

    def in_cells(self, of: ClearestWindow, edge: int) -> _Unmet | None:
        """Return the same of a window of cells, each a square of `edge` pixels."""
        top, left, rows, columns = (edge * at for at in of.window)
        height, width = self._means.shape[1:3]
        ys, xs = slice(top, min(top + rows, height)), slice(left, min(left + columns, width))
        weights = of.weights.repeat(edge, 0).repeat(edge, 1)
        return self.in_window(ys, xs, of.band, weights[ys, xs])

    def in_pixels(self) -> Mask:
        """Return where one render may not have met the light of the other, (y, x, band)."""
        edge = 2 * _AROUND + 1
        around = np.maximum(ndimage.uniform_filter(self._sums, (1, 1, edge, edge, 1)), 0)
        blind = _lacks(around[1], around[1, ::-1], _BLIND)
        sizes = np.where(blind, self._of_image[:, np.newaxis, np.newaxis], _size(*around))
        lost, own = np.abs(self._means[1] - self._means[0]), _size(*self._sums)
        expected = np.where(
            self._means[0] < self._means[1],
            _expected(lost * self._spp[0], sizes[0], own[1]),
            _expected(lost * self._spp[1], sizes[1], own[0]),
        )
        lacks = _lacks(self._means.min(axis=0), self._means.max(axis=0))
        return np.asarray(lacks & (expected > 0) & (expected < _ENOUGH))


def _lacks(light: Floats, other: Floats, share: float = _LACKS) -> Mask:
    """Return whether a render lacks at least this share of the light of the other."""
    return np.asarray(light <= (1 - share) * other)


@np.errstate(all="ignore")
def _size(variance: Floats, mean: Floats) -> Floats:
    """Return the size of the samples that carry the light; NaN where there is none."""
    return np.where(mean > 0, variance / np.where(mean > 0, mean, 1), np.nan)


@np.errstate(all="ignore")
def _expected(lost: Floats | float, size: Floats, other: Floats) -> Floats:
    """Return how many samples of a size the difference is worth; infinite if others are alike."""
    rare = size > _LARGER * np.nan_to_num(other)
    return np.where(rare, lost / np.where(size > 0, size, np.nan), np.inf)
