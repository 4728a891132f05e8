"""Conditions: a few numbers that say what the samples of a scene are like, all pixels together.

An estimator that was trained on several scenes takes them to tell which of these the picture at
hand resembles. They come from profiles, hence do not depend on the unit of radiance or on the order
of the samples, and hardly on how many there are: each is a share or an unbiased variance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat.estimators.progressive.profiles import OCTAVES, Profile

__all__ = ["CONDITIONS", "conditions_of", "local_conditions"]

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
CONDITIONS = 5 + len(QUANTILES)
"""How many numbers there are."""
_FAR = 3.0
"""Octaves above the others of its pixel from which a sample is firefly-like."""
_LEVELS = 3
"""Sizes of the parts of a picture: whole, quarters, sixteenths."""
_FEWEST = 64
"""Pixels in a part that tell its conditions; with fewer, those of the picture are taken."""
_ROWS = 1024

Floats = npt.NDArray[np.floating[Any]]


def conditions_of(profile: Profile) -> npt.NDArray[np.float32]:
    r"""Return the conditions of a picture, numbers of about unit size, shape (`CONDITIONS`,).

    With k the octave of a sample's luminance over the mean of the picture: the share of nulls; the
    quantiles 0.1 to 0.9 of k; its standard deviation within pixels,
    :math:`\sqrt{\sum S / \sum (w - 1)}`, S being the sum of squares about the mean of a pixel and w
    its samples that are not null; that between pixels; and the shares of samples and of radiance
    more than 3 octaves above the mean octave of the other samples of the pixel.

    Parameters
    ----------
    profile
        Of pixels of the picture, shape (...), in its unit.

    Returns
    -------
    ndarray
        0 where nothing is known: a black picture has but its nulls.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.lognormal(size=(100, 1, 64))
    >>> few, many = (conditions_of(Profile.of(x[..., :n], unit=1.6)) for n in (16, 64))
    >>> bool(np.abs(few - many).max() < 0.1)
    True
    """
    rows = profile.reshape(-1)
    sums = [_sums(rows[part]) for part in spans(len(rows.count), _ROWS)]
    return _conditions(*(np.sum(parts, axis=0) for parts in zip(*sums, strict=True)))


def local_conditions(
    profile: Profile,
    pixels: npt.NDArray[np.int64],
    shape: tuple[int, ...],
    rng: np.random.Generator,
) -> npt.NDArray[np.float32]:
    """Return conditions for pixels that train, each from a part of the picture around it.

    The parts are the whole, its quarters and its sixteenths, at random: so a few scenes show a
    network many conditions, and it learns to interpolate and not to tell scenes by name.

    Parameters
    ----------
    profile
        Of the pixels, shape (pixel,).
    pixels
        Rows (y, x).
    shape
        Height and width of the picture.
    rng
        Draws the size of each pixel's part.

    Returns
    -------
    ndarray
        Shape (pixel, `CONDITIONS`).
    """
    found = np.tile(conditions_of(profile), (len(pixels), 1))
    level = rng.integers(_LEVELS, size=len(pixels))
    for k in range(1, _LEVELS):
        place = pixels * 2**k // np.array(shape[:2])
        part = place[:, 0] * 2**k + place[:, 1]
        for here in np.unique(part):
            inside = np.flatnonzero(part == here)
            if len(inside) >= _FEWEST:
                found[inside[level[inside] == k]] = conditions_of(profile[inside])
    return found


def _sums(profile: Profile) -> tuple[Any, ...]:
    """Return samples, those in each octave, squares and freedom within pixels, those far above."""
    weight = profile.bins[..., 0].astype(np.float64)
    # An average of squares of 1e30 stays finite in double precision.
    radiance = profile.bins[..., 1:].astype(np.float64).mean(axis=-1)
    octave = np.arange(OCTAVES)
    lit = weight.sum(axis=1, keepdims=True)
    first = (weight @ octave)[:, np.newaxis]
    middle = first / np.maximum(lit, 1)
    within = (weight * (octave - middle) ** 2).sum()
    # The distance to the mean of the others is w / (w - 1) times that to the mean of all.
    far = octave - middle > _FAR * (lit - 1) / np.maximum(lit, 1)
    far &= lit > 1 + 1e-3
    return (
        profile.count.sum(dtype=np.float64),
        weight.sum(axis=0),
        within,
        np.maximum(lit - 1, 0).sum(),
        (weight * far).sum(),
        (radiance * far).sum(),
        radiance.sum(),
    )


def _conditions(
    count: Any, weight: Any, within: Any, freedom: Any, far: Any, far_radiance: Any, radiance: Any
) -> npt.NDArray[np.float32]:
    lit = weight.sum()
    if not lit > 0:
        nulls = float(count > 0)
        return np.array([nulls, *np.zeros(CONDITIONS - 1)], np.float32)
    octave = np.arange(OCTAVES)
    middle = weight @ octave / lit
    variance = weight @ (octave - middle) ** 2 / lit
    inner = within / freedom if freedom > 0 else 0.0
    quantiles = np.interp(QUANTILES, (np.cumsum(weight) - weight / 2) / lit, octave)
    found = (
        1 - lit / count,
        *((quantiles - OCTAVES / 2) / 4),
        np.sqrt(inner) / 2,
        np.sqrt(max(variance - inner, 0)) / 2,
        np.sqrt(far / lit),
        far_radiance / radiance if np.isfinite(radiance) and radiance > 0 else 0.0,
    )
    return np.array(found, np.float32)
