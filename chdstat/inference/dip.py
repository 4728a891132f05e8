"""Dip: how far samples are from the closest distribution of one mode, for many rows at once.

`dips` follows Hartigan and Hartigan 1985, section 6. The empirical distribution function F has a
greatest convex minorant G and a least concave majorant L in an interval, at first that of all
samples. They are farthest apart at a vertex of one of them; between it and the next vertex of the
other lies the next interval. Outside of it, G on the left and L on the right are the closest
distribution of one mode; F deviates from them by twice the dip.

All rows take each of these steps together. Samples are known by their places in the array of all
rows, which differ by 1 from one sample to the next, as n F does.

P-values (`dip_p`) are interpolated between quantiles of sqrt(n) times the dip of uniform samples,
from 20 samples on, simulated by tools/make_dip_table.py.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from chdstat._core.arrays import Counts, Floats, Indices, Mask, spans
from chdstat.inference.normality import interpolated_p

__all__ = ["dip_p", "dips"]

_STEPS = (1, 5)
"""A sample on or beyond a chord between samples so many places before and behind is no vertex."""
_THINNING = 8
_CHUNK = 2**13
"""Samples worked on at once: they stay in the cache."""


def dips(ascending: Floats, n: Counts) -> Floats:
    """Return the dips of rows of samples, in [1 / (2 n), 1/4], shape (row,).

    Parameters
    ----------
    ascending
        Shape (row, sample), ascending; infinite behind the first `n` of a row.
    n
        Samples of each row, at least 1, shape (row,).

    References
    ----------
    Hartigan and Hartigan, "The dip test of unimodality", 1985, doi:10.1214/aos/1176346577.

    Examples
    --------
    >>> rows = np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 0.1, 3.0, 3.1]])
    >>> dips(rows, np.array([4, 4])).round(4)
    array([0.125 , 0.2417])
    """
    x = ascending.reshape(-1)
    low = np.arange(len(ascending)) * ascending.shape[-1]
    high = low + n - 1
    # Of n F, which rises by 1 at each sample: G lies below the step, L above it.
    deviation = np.ones(len(ascending))
    rows = np.flatnonzero(x[high] > x[low])
    low, high = low[rows], high[rows]
    convex, concave = _candidates(ascending)
    minorant, majorant = _Curve(x, low, convex, 1), _Curve(x, high, concave, -1)
    while len(rows):
        minorant.narrow(low, high)
        majorant.narrow(low, high)
        g, l = minorant.vertices, majorant.vertices  # noqa: E741 - as in the paper
        at_g, g_place = _largest(majorant.above(g), g, low)
        at_l, l_place = _largest(-minorant.above(l), l, low)
        inner_low = np.where(at_g > at_l, g_place, g[np.searchsorted(g, l_place, "right") - 1])
        inner_high = np.where(at_g > at_l, l[np.searchsorted(l, g_place)], l_place)
        open_ = np.maximum(at_g, at_l) + 1 > deviation[rows]
        rows, low, high, inner_low, inner_high = (
            values[open_] for values in (rows, low, high, inner_low, inner_high)
        )
        if not len(rows):
            break
        left, right = _ranges(low, inner_low + 1), _ranges(inner_high, high + 1)
        of_left = np.maximum.reduceat(-minorant.above(left), np.searchsorted(left, low))
        of_right = np.maximum.reduceat(majorant.above(right), np.searchsorted(right, inner_high))
        deviation[rows] = np.maximum(deviation[rows], np.maximum(of_left, of_right) + 1)
        shrunk = (inner_low > low) | (inner_high < high)
        open_ = shrunk & (x[inner_high] > x[inner_low])
        rows, low, high = rows[open_], inner_low[open_], inner_high[open_]
    return deviation / (2 * n)


class _Curve:
    """The greatest convex minorant (sign 1) or least concave majorant (-1) of n F in each row.

    Parameters
    ----------
    x
        Samples of all rows.
    vertices
        Places of the vertices, ascending: at first that of the first sample of each row for a
        minorant, of the last for a majorant.
    candidates
        Places of samples that may be vertices.
    """

    def __init__(
        self, x: Floats, vertices: Indices, candidates: Indices, sign: Literal[1, -1]
    ) -> None:
        self._x, self._candidates, self._sign = x, candidates, sign
        self.vertices = vertices

    def narrow(self, low: Indices, high: Indices) -> None:
        """Leave the curve of the samples from `low` to `high` of each row.

        The first of them is a vertex of the minorant so far, and the last of the majorant. So the
        vertices in between stay; there are new ones at the other end, behind the last that stays.
        """
        vertices, candidates = self.vertices, self._candidates
        # At that end, chords reached beyond it: it takes some samples that are no candidates.
        if self._sign > 0:
            start, stop = vertices[np.searchsorted(vertices, high, "right") - 1], high
            near = _ranges(np.maximum(start, high - _STEPS[-1]), high)
        else:
            start, stop = low, vertices[np.searchsorted(vertices, low)]
            near = _ranges(low, np.minimum(stop, low + _STEPS[-1]))
        new = _ranges(np.searchsorted(candidates, start), np.searchsorted(candidates, stop))
        old = _ranges(np.searchsorted(vertices, low), np.searchsorted(vertices, high))
        tried = np.zeros(len(self._x), dtype=bool)
        for some in (low, vertices[old], candidates[new], near, high):
            tried[some] = True
        places = np.flatnonzero(tried)
        fixed = np.zeros(len(places), dtype=bool)
        fixed[np.searchsorted(places, np.concatenate([low, high]))] = True
        self.vertices = places[_bends(places, self._sign * self._x[places], fixed)]

    def above(self, places: Indices) -> Floats:
        """Return how far the curve is above samples, ascending, in places: at its vertices 0."""
        vertices = self.vertices
        x = self._x[vertices]
        run = np.diff(x)
        slope = np.append(np.where(run > 0, np.diff(vertices) / run, 0), 0)
        count = np.diff(np.searchsorted(places, vertices), append=len(places))
        left = np.repeat(np.arange(len(vertices)), count)
        rise = (self._x[places] - x[left]) * slope[left]
        return np.asarray(rise - (places - vertices[left]))


def _candidates(ascending: Floats) -> tuple[Indices, Indices]:
    """Return the places of samples that may be vertices of a minorant, and of a majorant."""
    convex, concave = np.empty((2, *ascending.shape), dtype=bool)
    for rows in spans(len(ascending), max(1, _CHUNK // ascending.shape[-1])):
        x = ascending[rows]
        # The least and the largest rise per place from before each sample, and to behind it.
        before, behind = np.empty((2, 2, *x.shape))
        before[0], before[1], behind[0], behind[1] = np.inf, -np.inf, np.inf, -np.inf
        for step in _STEPS:
            rise = x[:, step:] - x[:, :-step]
            rise *= 1 / step
            for ends in (before[..., step:], behind[..., :-step]):
                np.minimum(ends[0], rise, out=ends[0])
                np.maximum(ends[1], rise, out=ends[1])
        np.greater(before[0], behind[1], out=convex[rows])
        np.less(before[1], behind[0], out=concave[rows])
    return np.flatnonzero(convex), np.flatnonzero(concave)


def _bends(places: Indices, x: Floats, fixed: Mask) -> Indices:
    """Return the indices of those samples that are vertices; `fixed` ones are, whatever they are.

    They are those of a minorant, or of a majorant where `x` is negated. Samples on or beyond the
    chord of their neighbours are left out until there are none. Else a smooth curve would lose its
    vertices one by one, so samples beyond the curve of every eighth are left out before.
    """
    kept = np.arange(len(places))
    if len(places) > 2 * _THINNING * np.count_nonzero(fixed):
        thinned = fixed.copy()
        thinned[::_THINNING] = True
        thin = np.flatnonzero(thinned)
        coarse = thin[_bends(places[thin], x[thin], fixed[thin])]
        inside = x > np.interp(places, places[coarse], x[coarse])
        inside[coarse] = True
        kept = np.flatnonzero(inside)
    while True:
        slope = np.diff(x[kept]) / np.diff(places[kept])
        stays = fixed[kept]
        stays[1:-1] |= slope[:-1] > slope[1:]
        if stays.all():
            return kept
        kept = kept[stays]


def _largest(values: Floats, places: Indices, low: Indices) -> tuple[Floats, Indices]:
    """Return the largest value of each row and its place; the rows begin at the places `low`."""
    first = np.searchsorted(places, low)
    largest = np.maximum.reduceat(values, first)
    row = np.repeat(np.arange(len(first)), np.diff(first, append=len(values)))
    equal = np.flatnonzero(values == largest[row])
    return largest, places[equal[np.searchsorted(row[equal], np.arange(len(first)))]]


def _ranges(start: Indices, stop: Indices) -> Indices:
    """Return all places from each `start` to before its `stop`, one after the other."""
    count = np.maximum(stop - start, 0)
    return np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())


_FLOOR = 1e-5
"""Smallest p-value: the table ends at 1e-4, where up to a million dips were simulated."""


def dip_p(dip: Floats, n: Counts) -> Floats:
    """Return p-values of dips of `n` samples, shape (row,), where uniform samples are the null.

    Of all unimodal distributions, the uniform one has the largest dips, asymptotically (Hartigan
    and Hartigan 1985, doi:10.1214/aos/1176346577). Values below 1e-5 become 1e-5.

    Examples
    --------
    >>> dip_p(np.array([0.02, 0.05]), np.array([200, 200])).round(2)
    array([0.89, 0.  ])
    """
    return interpolated_p(np.sqrt(n) * dip, n, DIP_QUANTILES, _FLOOR)


DIP_QUANTILES = np.array(
    [
        [0.225154, -2.39383, 81.9113, -1543.36, 16178.3, -94698.5, 288498, -355156],
        [0.226392, -0.943352, 32.8244, -686.296, 7675.04, -46442, 143031, -175210],
        [0.236829, -0.0122606, -12.088, 320.729, -4137.66, 28033.2, -95400.7, 128367],
        [0.241521, 0.604385, -39.5415, 891.966, -10437.3, 65783.6, -211208, 270481],
        [0.260294, 0.0594509, -12.7222, 270.774, -2909.17, 16671.5, -48250.3, 55161.3],
        [0.275591, -0.139145, -2.17888, 22.6917, 51.1332, -2071.56, 11646.4, -20711.7],
        [0.295341, -0.326919, 5.88242, -146.983, 1925.32, -13205.1, 45142.7, -60582.1],
        [0.309225, -0.343349, 5.59707, -127.138, 1561.21, -10169.6, 33211.7, -42702],
        [0.320332, -0.277512, 2.08444, -44.2231, 537.04, -3403.57, 10611.5, -12776.2],
        [0.339742, -0.11221, -6.50257, 149.688, -1742, 10942.3, -35112, 45045.7],
        [0.360156, -0.243558, -1.66977, 56.6048, -756.752, 5068.91, -16673.4, 21420.6],
        [0.380545, -0.370036, 4.51525, -93.4291, 1109.13, -7235.95, 24176.6, -32230.3],
        [0.401119, -0.310948, 1.76632, -39.2952, 516.289, -3599.05, 12510.2, -17027.4],
        [0.424806, -0.22323, -2.77193, 61.1955, -670.899, 3982.78, -12144.2, 14922.6],
        [0.438266, -0.133445, -6.57233, 134.367, -1443.3, 8505.73, -25877.9, 31736.5],
        [0.455102, -0.161482, -5.49217, 106.137, -1078.4, 6042.62, -17565.7, 20676.6],
        [0.476257, -0.288643, -0.0126482, -13.1233, 271.312, -2189.14, 8051.3, -11201.2],
        [0.503277, -0.337507, 1.83418, -58.2691, 823.164, -5741.95, 19541, -25905.5],
        [0.520546, -0.236506, -2.76911, 30.3813, -101.619, -405.571, 3566.33, -6585.11],
        [0.544066, -0.129498, -8.6895, 162.814, -1650.46, 9298.73, -27272.6, 32426.7],
        [0.565494, -0.232275, -5.88309, 119.881, -1286, 7486.27, -22291.2, 26607.7],
        [0.586723, -0.524474, 4.6238, -71.0607, 561.084, -2246.65, 4031.43, -1967.07],
        [0.607364, -0.739371, 14.3051, -287.889, 3059.97, -17617.8, 51993.8, -61618.2],
        [0.637038, -0.894611, 19.2783, -377.27, 3948.22, -22614, 66756.9, -79319.9],
        [0.654091, -0.945304, 24.2211, -523.554, 5827.03, -34673.9, 104763, -126166],
        [0.667625, -0.628501, 10.4934, -262.583, 3220.46, -20552.4, 65506, -82304.7],
        [0.687091, -0.809632, 13.155, -259.725, 2840.78, -17403.4, 55493.8, -71242],
        [0.703401, -0.676154, 0.887077, 62.334, -1166.83, 8457.23, -28025, 35407.3],
        [0.721322, -0.84241, 5.59255, -10.6696, -602.514, 6490.76, -26247.9, 38219.8],
        [0.74715, -1.21725, 22.8053, -356.7, 2844.03, -11513.2, 20924.8, -10585.1],
        [0.77331, -1.08215, 23.0039, -484.438, 5356.55, -31970.6, 97335.8, -118463],
        [0.80165, -1.40548, 37.6358, -725.576, 7055.81, -36879.3, 99290.9, -108458],
        [0.830146, -0.244429, -16.2341, 325.063, -3679.33, 22706.4, -70301.1, 85044.3],
    ]
)
"""Coefficients of the dip, shape (level, power of 1 / sqrt(n))."""
