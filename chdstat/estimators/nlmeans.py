"""Non-local means: pixels are averaged whose patches differ by no more than their noise.

Each half of the samples is filtered with weights from the other half, so that a firefly of one does
not choose its own neighbours.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Floats, Reals, as_pixels, whole
from chdstat.estimators.registry import check_positive, mean_of_good, register, whole_samples
from chdstat.estimators.validation import reordered

__all__ = ["rousselle2012"]

_LEAST = 0.05
"""Weights below it are none (authors' code)."""


@register(
    "rousselle2012",
    "Rousselle et al. 2012, doi:10.1145/2366145.2366214",
    label="Rousselle et al. 2012",
    place=7,
    minimum_samples=4,
    uses_neighbours=True,
)
def rousselle2012(
    x: Reals, *, damping: float = 0.45, radius: int = 10, patch: int = 3, cancelled: float = 1.0
) -> Reals:
    """Dual-buffer non-local means: average pixels whose patches differ by noise alone.

    With u the mean of one half of the samples and v its squared standard error, pixels p and q
    are ``((u_p - u_q)^2 - a (v_p + min(v_p, v_q))) / (k^2 (v_p + v_q))`` apart, averaged over
    channels and a patch around each. The weight ``exp(-max(0, d))`` is averaged over the patch
    again, and filters the mean of the other half; the estimate is the mean of both filtered halves.

    Left out are what the paper adds for samples of low discrepancy, smoothed variances, and its
    adaptive sampling. Formulas and the cut of small weights are those of the authors' code.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), at least 4. A sample of which any channel is NaN or
        infinite is left out.
    damping
        The strength k, larger than 0.
    radius
        Of the window, in pixels: 10 for 21 x 21.
    patch
        Radius of the patches.
    cancelled
        The share a of the variance that is taken from the distance, 0 or larger.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`; the mean of a channel's good samples
        where a half has less than 2 whole ones.

    Raises
    ------
    InputError
        If `x` is no image, or an option is out of range.

    References
    ----------
    F. Rousselle, C. Knaus and M. Zwicker, "Adaptive rendering with non-local means filtering", ACM
    Transactions on Graphics 31(6), 2012, doi:10.1145/2366145.2366214.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(8, 8, 3, 32))
    >>> image[:, 4:] *= 100
    >>> rousselle2012(image)[4, [0, 3, 4, 7], 0].round().tolist()
    [1.0, 1.0, 102.0, 87.0]
    """
    check_positive(damping=damping)
    radius, patch = whole("radius", radius, least=0), whole("patch", patch, least=0)
    samples = reordered(as_pixels(x, minimum=4, image=True))[0]
    _, exponent = np.frexp(np.abs(samples[np.isfinite(samples)]).max(initial=0))
    unit = np.ldexp(1.0, int(exponent))  # a power of two changes no digit
    halves = [_mean_and_error(samples[..., i::2] / unit) for i in (0, 1)]
    known = np.asarray(np.isfinite(halves[0][1] + halves[1][1]).all(axis=-1))
    (one, one_error), (two, two_error) = (
        (np.where(known[..., np.newaxis], part, 0) for part in half) for half in halves
    )
    options = damping, radius, patch, cancelled
    filtered = [
        _filtered(one, two, two_error, known, *options),
        _filtered(two, one, one_error, known, *options),
    ]
    found = sum(filtered) / 2 * unit
    return np.where(known[..., np.newaxis], found, mean_of_good(np.asarray(x)))


def _mean_and_error(x: npt.NDArray[np.floating[Any]]) -> tuple[Floats, Floats]:
    """Return the mean of whole good samples and its squared standard error, NaN of less than 2."""
    kept, good = whole_samples(x)
    n = np.count_nonzero(good, axis=-1)[..., np.newaxis]
    mean = kept.sum(axis=-1, dtype=np.float64) / np.maximum(n, 1)
    apart = np.where(good[..., np.newaxis, :], kept - mean[..., np.newaxis], 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return mean, np.square(apart).sum(axis=-1) / (n * np.where(n > 1, n - 1, np.nan))


def _filtered(
    values: Floats,
    guide: Floats,
    error: Floats,
    known: npt.NDArray[np.bool_],
    damping: float,
    radius: int,
    patch: int,
    cancelled: float,
) -> Floats:
    """Average an image over the window by weights from another one with its squared errors."""
    height, width = known.shape

    def padded(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.pad(image, ((radius, radius), (radius, radius)) + ((0, 0),) * (image.ndim - 2))

    around = [padded(image) for image in (values, guide, error, known)]
    total, weights = values * known[..., np.newaxis], known.astype(np.float64)
    for dy, dx in itertools.product(range(2 * radius + 1), repeat=2):
        if dy == dx == radius:
            continue
        place = slice(dy, dy + height), slice(dx, dx + width)
        its_value, its_guide, its_error, there = (image[place] for image in around)
        noise, both = error + np.minimum(error, its_error), error + its_error
        squared = np.square(guide - its_guide) - cancelled * noise
        # Pixels without noise are the same or nothing.
        distance = np.divide(
            squared, damping**2 * both, out=np.where(squared > 0, np.inf, 0.0), where=both > 0
        ).mean(axis=-1)
        valid = known & there
        distance = np.where(valid, np.minimum(distance, 1e6), 0)
        share = _patch_mean(valid.astype(np.float64), patch)
        apart = _patch_mean(distance, patch) / np.maximum(share, 1e-9)
        weight = _patch_mean(np.exp(-np.maximum(apart, 0)), patch)
        weight = np.where(valid & (weight >= _LEAST), weight, 0)
        total += weight[..., np.newaxis] * its_value
        weights += weight
    return np.asarray(total / np.maximum(weights, 1e-300)[..., np.newaxis])


def _patch_mean(image: Floats, radius: int) -> Floats:
    return np.asarray(ndimage.uniform_filter(image, 2 * radius + 1, mode="nearest"))
