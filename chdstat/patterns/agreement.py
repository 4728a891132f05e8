"""Agreement of the labels of pixels with those of their neighbours.

Labels that mean something form regions; labels that are noise look like the same labels shuffled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._core.positive import Floats, Mask
from chdstat.errors import InputError

__all__ = ["Agreement", "agreement"]

_OFFSETS = tuple((i, j) for i in (0, 1, 2) for j in (0, 1, 2) if (i, j) != (1, 1))


@dataclass(frozen=True)
class Agreement:
    """Agreement of labels with their neighbours.

    Attributes
    ----------
    share
        Share of the up to 8 neighbours that have the label of the pixel, shape (y, x); NaN where
        the pixel or all of its neighbours have no label.
    by_chance
        What that share would be on average, were the labels shuffled over the image, shape (y, x).
    observed, expected
        Shares of all pairs of neighbours that have equal labels: there are, and shuffled.
    kappa
        ``(observed - expected) / (1 - expected)``: 0 for shuffled labels, 1 for complete agreement;
        NaN where all labels are equal.
    z
        Observed minus expected, in standard deviations over all ways to shuffle the labels.
    """

    share: Floats
    by_chance: Floats
    observed: float
    expected: float
    kappa: float
    z: float


def agreement(labels: npt.NDArray[np.integer], known: Mask | None = None) -> Agreement:
    """Compare the labels of an image with those of their neighbours, and with shuffled labels.

    The pairs of equal neighbours are Moran's join count, for all labels at once; its mean and
    variance over all permutations are those of Mantel, exact and without a permutation. `kappa`
    corrects for agreement by chance as Cohen's does.

    Parameters
    ----------
    labels
        Shape (y, x).
    known
        Which pixels have a label, same shape; None for all. Pixels without a label are ignored.

    Raises
    ------
    InputError
        If the shapes are not those of one image.

    References
    ----------
    Moran, "The interpretation of statistical maps", 1948, doi:10.1111/j.2517-6161.1948.tb00012.x.
    Mantel, "The detection of disease clustering and a generalized regression approach", Cancer
    Research 27, 1967. Cohen, "A coefficient of agreement for nominal scales", 1960,
    doi:10.1177/001316446002000104.

    Examples
    --------
    >>> halves = np.repeat([[0, 1]], 8, axis=0).repeat(4, axis=1)
    >>> found = agreement(halves)
    >>> round(found.kappa, 2), found.z > 5, float(found.share[0, 0])
    (0.79, True, 1.0)
    """
    known = np.ones(labels.shape, dtype=bool) if known is None else known
    if labels.ndim != 2 or known.shape != labels.shape:
        message = f"labels and known must have one shape (y, x), got {labels.shape}, {known.shape}"
        raise InputError(message)
    height, width = labels.shape
    around, there = np.pad(labels, 1), np.pad(known, 1)
    # Known neighbours of each pixel, and those with an equal label.
    neighbours, equal = np.zeros((2, height, width), dtype=np.int64)
    for i, j in _OFFSETS:
        here = np.s_[i : i + height, j : j + width]
        both = there[here] & known
        neighbours += both
        equal += both & (around[here] == labels)
    _, group, counts = np.unique(labels[known], return_inverse=True, return_counts=True)
    sizes = np.zeros(labels.shape, dtype=np.int64)
    sizes[known] = counts[group]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(known, equal / neighbours, np.nan)
    n = int(np.count_nonzero(known))
    by_chance = np.where(known & (neighbours > 0), (sizes - 1) / max(n - 1, 1), np.nan)
    observed, expected, deviation = _joins(neighbours[known], equal[known], sizes[known])
    return Agreement(
        share=share,
        by_chance=by_chance,
        observed=observed,
        expected=expected,
        kappa=(observed - expected) / (1 - expected) if expected < 1 else math.nan,
        z=(observed - expected) / deviation if deviation > 0 else math.nan,
    )


def _joins(
    neighbours: npt.NDArray[np.int64],
    equal: npt.NDArray[np.int64],
    sizes: npt.NDArray[np.int64],
) -> tuple[float, float, float]:
    """Return the share of equal pairs, its mean and its standard deviation over permutations."""
    n = float(len(sizes))
    pairs = float(neighbours.sum())
    if n < 4 or pairs == 0:
        return math.nan, math.nan, math.nan
    # Mantel's sums of two symmetric 0/1 matrices: of being neighbours, and of having equal labels.
    s0, s1, s2 = pairs, 2 * pairs, 4 * float(np.sum(neighbours**2))
    others = (sizes - 1).astype(np.float64)
    t0, t1, t2 = others.sum(), 2 * others.sum(), 4 * np.sum(others**2)
    mean = s0 * t0 / (n * (n - 1))
    square = (
        s1 * t1 / (2 * n * (n - 1))
        + (s2 - 2 * s1) * (t2 - 2 * t1) / (4 * n * (n - 1) * (n - 2))
        + (s0**2 + s1 - s2) * (t0**2 + t1 - t2) / (n * (n - 1) * (n - 2) * (n - 3))
    )
    deviation = np.sqrt(max(square - mean**2, 0.0))
    return float(equal.sum()) / pairs, float(mean / pairs), float(deviation / pairs)
