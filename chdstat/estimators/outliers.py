"""Outliers: samples with too few similar samples count less or not at all.

`zirr2018` and `zirr2018_pixel` split each sample between the two nearest layers of brightness. A
layer counts more if more samples of its brightness have fallen into the pixel or around it, so
fireflies count less. `zirr2018` looks at 3 x 3 pixels, `zirr2018_pixel` at the pixel alone.
`decoro2010` averages the samples that have enough similar samples in the pixels around.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from chdstat._core.arrays import Floats, Reals, luminance, spans, whole
from chdstat._core.image_scales import BASE, LAYERS, exposure_unit, layer_weights
from chdstat.estimators import registry
from chdstat.estimators.registry import register
from chdstat.estimators.similarity import window_sum

_DARKEST = 0.05
"""Luminance that always counts as reliable (authors' code)."""
_OFF = 1e-6
"""Largest kappa that switches the reweighting off (authors' code)."""
_CHUNK = 2**16
"""Samples split at once."""
_BLACK = 1e-2
"""Radiance, after exposure, below which colours count as black."""
_SOURCE = "Zirr et al. 2018, doi:10.1111/cgf.13335"


@register("zirr2018", _SOURCE, label="Zirr et al. 2018", place=6, uses_neighbours=True)
def zirr2018(x: Reals, *, kappa: float = 1.0, unit: float | None = None) -> Reals:
    """Reweighted fireflies: each brightness counts as far as the pixels around confirm it.

    Samples are split over layers of brightness ``B_i = 8^i``. The estimate is ``sum_i w_i C_i``:
    C_i is the share of layer i in the mean, w_i its reliability. The reliability grows with the
    number of samples in layers i - 1, i, i + 1 of the 3 x 3 pixels and, once these are enough, of
    the pixel itself. kappa is the number that makes a layer reliable. The estimate is too dark.

    Formulas follow the authors' published code (their WebGL viewer); the paper's text was not
    available. The code expects an exposed image: see `unit`.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), 1 or 3 channels. Samples with a NaN or infinite
        channel are left out.
    kappa
        Number of samples that confirm a brightness, larger than 0. A larger number makes the image
        darker and smoother. The paper leaves it to the user; the authors' viewer starts at 32 for
        1024 samples per pixel, which corresponds to 1 for 32. Values up to 1e-6 switch the
        reweighting off: the result is then the mean, except for radiance above the top layer.
    unit
        Radiance of the lowest layer's brightness, B_0; None exposes the image so that the
        log-average of its pixels is 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels without a sample that
        is good in all channels get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image of 1 or 3 channels, or `kappa` or `unit` is not positive.

    References
    ----------
    T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly samples for improved finite-sample
    Monte Carlo estimates", Computer Graphics Forum 37(6), 2018, doi:10.1111/cgf.13335.

    Examples
    --------
    >>> image = np.ones((3, 3, 1, 32))
    >>> image[1, 1, 0, 0] = 900.0
    >>> float(image[1, 1].mean()), float(zirr2018(image, unit=1.0)[1, 1, 0].round(2))
    (29.09375, 0.97)
    """
    return _estimate(x, kappa, unit, radius=1)


@register("zirr2018_pixel", _SOURCE, label="Zirr et al. 2018, pixel", place=6, joint_channels=True)
def zirr2018_pixel(x: Reals, *, kappa: float = 1.0, unit: float | None = None) -> Reals:
    """Reweighted fireflies from the pixel alone: `zirr2018` without the pixels around.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), 1 or 3 channels. Samples with a NaN or infinite
        channel are left out.
    kappa
        Number of samples that confirm a brightness, larger than 0.
    unit
        Radiance of the lowest layer's brightness; None exposes all given pixels together so that
        their log-average is 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), as `zirr2018` returns them.

    Raises
    ------
    InputError
        If `x` has no channels, or not 1 or 3 of them, or `kappa` or `unit` is not positive.

    Examples
    --------
    >>> float(zirr2018_pixel([[1.0] * 31 + [900.0]], unit=1.0)[0].round(2))
    1.48
    """
    return _estimate(x, kappa, unit, radius=0)


@dataclass(frozen=True)
class _Cascade:
    """Samples as layers of brightness.

    Attributes
    ----------
    layers
        Share of each layer in the mean, in units of `unit`, float64, shape (layer, ..., channel).
    count
        Good samples N, shape (...).
    unit
        Radiance of the lowest layer's brightness.
    """

    layers: Floats
    count: npt.NDArray[np.int64]
    unit: float

    @classmethod
    def of(cls, samples: Reals, unit: float | None) -> _Cascade:
        """Split samples (..., channel, sample)."""
        channels, n = samples.shape[-2:]
        rows = samples.reshape(-1, channels, n)
        # The exposure follows from the mean, before anything is reweighted.
        means = luminance(np.nan_to_num(registry.mean_of_good(rows)), channel_axis=-1)
        found = exposure_unit(means, unit)
        layers, counts = [], []
        # One part at least: an array without pixels has layers, too.
        for part in spans(len(rows) or 1, max(1, _CHUNK // (channels * n))):
            kept, whole = registry.whole_samples(rows[part])
            relative = kept / np.float64(found)
            counts.append(np.count_nonzero(whole, axis=-1))
            divided = np.maximum(counts[-1], 1)[:, np.newaxis, np.newaxis]
            layers.append(relative @ layer_weights(luminance(relative)) / divided)
        shape = samples.shape[:-2]
        split = np.moveaxis(np.concatenate(layers), -1, 0).reshape(LAYERS, *shape, channels)
        return cls(split, np.concatenate(counts).reshape(shape), found)

    def resolve(self, kappa: float, *, radius: int) -> Floats:
        """Add the layers up by their reliability, shape (..., channel).

        Parameters
        ----------
        kappa
            Number of samples that confirm a brightness, larger than 0.
        radius
            1 for 3 x 3 pixels, which needs an image (y, x, channel); 0 for the pixel alone.
        """
        registry.check_positive(kappa=kappa)
        near, around = self._luminances(0), self._luminances(radius)
        accepted = np.zeros(self.layers.shape[1:])
        # For a large kappa, which asks for a small error, one sample may hold more energy.
        slack = 1 + 0.6 * (BASE - 1) * (1 - np.minimum(1 / kappa, 1))
        hits = self.count / kappa
        for index, layer in enumerate(self.layers):
            rows = slice(max(index - 1, 0), index + 2)
            reliable, own = (hits * part[rows].sum(axis=0) - 1 / kappa for part in (around, near))
            reliable = np.where(reliable >= 0, own, reliable)
            bright = np.maximum(luminance(accepted, channel_axis=-1), _DARKEST)
            colour = bright * hits / BASE**index * slack
            weight = np.clip((reliable + colour) / 2, kappa <= _OFF, 1)
            accepted += weight[..., np.newaxis] * layer
        return np.asarray(accepted * self.unit)

    def _luminances(self, radius: int) -> Floats:
        """Return luminances of the layers, averaged over a window, in units of their brightness."""
        values: Floats = luminance(self.layers, channel_axis=-1).astype(np.float64)
        values /= BASE ** np.arange(LAYERS).reshape(-1, *(1,) * (values.ndim - 1))
        if radius == 0:
            return values
        # The border repeats, as in the authors' viewer.
        return window_sum(values, radius, mode="edge") / (2 * radius + 1) ** 2


def _estimate(x: Reals, kappa: float, unit: float | None, *, radius: int) -> Reals:
    cascade = _Cascade.of(x, unit)
    return np.where(
        cascade.count[..., np.newaxis] > 0, cascade.resolve(kappa, radius=radius), np.nan
    )


@register(
    "karis2013", "Karis 2013, graphicrants.blogspot.com", label="Karis 2013", joint_channels=True
)
def karis2013(x: Reals, *, unit: float | None = None) -> Reals:
    """Tone-mapped average: each sample is weighted by ``1 / (1 + L)``, L being its luminance.

    The sum of ``x / (1 + L)`` over the samples, divided by the sum of ``1 / (1 + L)``. A firefly
    counts no more than a white sample. Real-time renderers average the samples of edges and bright
    highlights like this. The estimate is too dark, more so the more the samples differ.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), 1 or 3 channels. A sample of which any channel is
        NaN or infinite is left out; a negative luminance counts as 0 in the weight.
    unit
        Radiance of luminance 1; None exposes all pixels given so that their log-average is 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), as `zirr2018` returns them.

    Raises
    ------
    InputError
        If `x` has no channels, or not 1 or 3 of them, or `unit` is not positive.

    References
    ----------
    B. Karis, "Tone mapping", Graphic Rants, 2013,
    https://graphicrants.blogspot.com/2013/12/tone-mapping.html.

    Examples
    --------
    >>> float(karis2013([[1.0] * 31 + [900.0]], unit=1.0)[0].round(2))
    1.06
    """
    kept, whole = registry.whole_samples(x)
    weight = whole / (1 + np.maximum(luminance(kept), 0) / _exposed(kept, whole, unit))
    return _over(np.vecdot(kept, weight[..., np.newaxis, :]), weight.sum(axis=-1))


def _over(total: Reals, weight: npt.NDArray[Any]) -> Reals:
    """Return sums (..., channel) over weights (...); NaN where the weight is 0."""
    return np.asarray(total / np.where(weight > 0, weight, np.nan)[..., np.newaxis])


def _exposed(kept: Reals, whole: npt.NDArray[np.bool_], unit: float | None) -> np.float64:
    """Return the radiance that is exposed as 1: `unit`, or an exposure of the pixels' means."""
    total = luminance(kept).sum(axis=-1, dtype=np.float64)
    return np.float64(exposure_unit(total / np.maximum(np.count_nonzero(whole, axis=-1), 1), unit))


@register("clamped", "Pharr, Jakob and Humphreys 2023, pbr-book.org", joint_channels=True)
def clamped(x: Reals, *, limit: float = 10.0, unit: float | None = None) -> Reals:
    """Mean of clamped samples: a sample whose largest channel exceeds a limit is scaled down to it.

    Renderers offer this against fireflies: ``maxcomponentvalue`` of pbrt's film, and the clamping
    of light paths in Cycles. The colour of a sample is kept, as in pbrt. All light above the limit
    is lost, also that of visible lamps and their reflections: the estimate is too dark.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), 1 or 3 channels. Samples with a NaN or infinite
        channel are left out.
    limit
        Larger than 0, in units of `unit`. Cycles clamps indirect light at 10 by default, pbrt
        nothing.
    unit
        Radiance of 1; None exposes all pixels given so that their log-average is 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (..., channel), as `zirr2018` returns them.

    Raises
    ------
    InputError
        If `x` has no channels, or not 1 or 3 of them, or `limit` or `unit` is not positive.

    References
    ----------
    M. Pharr, W. Jakob and G. Humphreys, "Physically Based Rendering", 4th edition, 2023, section
    5.4.6, https://pbr-book.org. Blender manual, "Cycles: Light paths, clamping".

    Examples
    --------
    >>> float(clamped([[1.0] * 31 + [900.0]], unit=1.0)[0].round(2))
    1.28
    """
    registry.check_positive(limit=limit)
    kept, whole = registry.whole_samples(x)
    largest, highest = kept.max(axis=-2), limit * _exposed(kept, whole, unit)
    weight = np.where(largest > highest, highest / np.where(largest > 0, largest, 1), 1.0)
    return _over(np.vecdot(kept, weight[..., np.newaxis, :]), np.count_nonzero(whole, axis=-1))


@register(
    "decoro2010",
    "DeCoro et al. 2010, doi:10.1111/j.1467-8659.2010.01799.x",
    label="DeCoro et al. 2010",
    place=6,
    uses_neighbours=True,
)
def decoro2010(
    x: Reals,
    *,
    neighbours: int = 4,
    bandwidth: float = 1.0,
    radius: int = 1,
    unit: float | None = None,
) -> Reals:
    """Mean of the samples that have enough neighbours in joint image and colour space.

    A sample is kept if at least k other samples have a distance d below 1, ``d^2 = (dx^2 + dy^2) /
    (r + 1)^2 + mean_c (log x_c - log x'_c)^2 / h^2``. This bounds the distance to its k-th nearest
    neighbour, the classical estimate of a density.

    Reconstructed from the paper's abstract, which characterises outliers by their density among
    nearby paths in joint image and colour space. Metric, bounds and defaults are chosen here.
    Colours are taken after exposure; values below 0.01 count as black, so dim and negative samples
    are not outliers. The estimate is too dark, more so where a bright event is rare but real.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). Samples with a NaN or infinite channel are left out.
    neighbours
        k, at least 1.
    bandwidth
        h, the difference of natural logarithms that counts as 1, larger than 0.
    radius
        r, in pixels: samples up to r pixels away are neighbours; 0 for the pixel alone.
    unit
        Radiance that is exposed as 1; None makes the log-average of the image 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Pixels in which no sample is
        kept get the mean of each channel's good samples, or NaN.

    Raises
    ------
    InputError
        If `x` is not an image, or an option is out of range.

    References
    ----------
    C. DeCoro, T. Weyrich and S. Rusinkiewicz, "Density-based outlier rejection in Monte Carlo
    rendering", Computer Graphics Forum 29(7), 2010, doi:10.1111/j.1467-8659.2010.01799.x.
    D. O. Loftsgaarden and C. P. Quesenberry, "A nonparametric estimate of a multivariate density
    function", Annals of Mathematical Statistics 36(3), 1965, doi:10.1214/aoms/1177700079.

    Examples
    --------
    >>> image = np.ones((3, 3, 3, 8))
    >>> image[1, 1, :, 0] = 900.0
    >>> decoro2010(image)[1, 1].tolist()
    [1.0, 1.0, 1.0]
    """
    neighbours = whole("neighbours", neighbours, least=1)
    radius = whole("radius", radius, least=0)
    registry.check_positive(bandwidth=bandwidth)
    kept, usable = registry.whole_samples(x)
    bright = kept.mean(axis=-2, dtype=np.float64).sum(axis=-1) / np.maximum(usable.sum(axis=-1), 1)
    exposed = np.float64(exposure_unit(bright, unit))
    colours = np.log(np.maximum(kept / exposed, 0) + _BLACK).swapaxes(-1, -2)[usable]
    colours /= bandwidth * np.sqrt(x.shape[-2])
    places = np.argwhere(usable)[:, :2] / (radius + 1)
    tree = cKDTree(np.concatenate([places, colours], axis=-1))
    # The nearest one is the sample itself. Without a k-th neighbour within 1, the distance is
    # infinite.
    distance = tree.query(tree.data, [neighbours + 1], distance_upper_bound=1, workers=-1)[0][:, 0]
    stays = np.zeros(usable.shape, bool)
    stays[usable] = np.isfinite(distance)
    total = (kept * stays[..., np.newaxis, :]).sum(axis=-1, dtype=np.float64)
    return _over(total, np.count_nonzero(stays, axis=-1))
