"""Outliers: samples that few others confirm are left out, in part or as a whole.

`zirr2018` and `zirr2018_pixel` split a sample between the two layers whose brightness it lies
between. A layer counts the more, the more samples of its brightness have fallen into the pixel or
around it; rarer ones, the fireflies, are left out in part. The former looks at 3 x 3 pixels, the
latter at the pixel alone, and `Cascade` keeps the layers, so that a sweep of kappa splits the
samples once. `decoro2010` leaves out samples with too few similar ones in the pixels around, and
averages the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from chdstat._core.arrays import Floats, Reals, as_pixels, luminance, spans, whole
from chdstat._core.image_scales import BASE, LAYERS, exposure_unit, layer_weights
from chdstat.errors import InputError
from chdstat.estimators import registry
from chdstat.estimators.registry import register
from chdstat.estimators.similarity import window_sum

__all__ = ["Cascade", "clamped", "decoro2010", "karis2013", "zirr2018", "zirr2018_pixel"]


_DARKEST = 0.05
"""Luminance that is always taken for reliable (authors' code)."""
_OFF = 1e-6
"""Largest kappa that switches the reweighting off (authors' code)."""
_CHUNK = 2**16
"""Samples split at once."""
_BLACK = 1e-2
"""Radiance, of an image exposed as usual, below which colours are as good as black."""
_SOURCE = "Zirr et al. 2018, doi:10.1111/cgf.13335"


@register("zirr2018", _SOURCE, label="Zirr et al. 2018", place=6, uses_neighbours=True)
def zirr2018(x: Reals, *, kappa: float = 1.0, unit: float | None = None) -> Reals:
    """Reweighted fireflies: each brightness counts as far as the pixels around confirm it.

    Samples are split over layers of brightness ``B_i = 8^i``. The estimate is ``sum_i w_i C_i``:
    C_i is the share of layer i in the mean, w_i its reliability. That grows with the number of
    samples in layers i - 1, i, i + 1 of the 3 x 3 pixels and, once enough of them are there, of the
    pixel itself; kappa is the number that makes a layer reliable. Bias is to the dark.

    Formulas are those of the authors' published code (their WebGL viewer), the paper's text was not
    at hand. The code measures radiance in units of an image that is exposed as usual: see `unit`.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample), 1 or 3 channels. A sample of which any channel is
        NaN or infinite is left out.
    kappa
        Samples that confirm a brightness, larger than 0: the larger, the darker and smoother. The
        paper leaves it to the user; the authors' viewer starts at 32 for 1024 samples per pixel,
        which is 1 for 32. At most 1e-6 switches the reweighting off, as there: the result is the
        mean but for what exceeds the top layer. `Cascade.resolve` sweeps it.
    unit
        Radiance of the lowest layer's brightness, B_0; None exposes the image so that the
        log-average of its pixels is 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`; the mean of a channel's good
        samples where no whole sample is good, NaN where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image of 1 or 3 channels, or `kappa` or `unit` is not positive.

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
    """Reweighted fireflies of the pixel alone: `zirr2018` without its neighbourhood.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), 1 or 3 channels. A sample of which any channel is
        NaN or infinite is left out.
    kappa
        Samples that confirm a brightness, larger than 0.
    unit
        Radiance of the lowest layer's brightness; None exposes all pixels given so that their
        log-average is 0.18. That one number is all that they have in common.

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
class Cascade:
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
    def of(cls, x: npt.ArrayLike, *, unit: float | None = None) -> Cascade:
        """Split samples (..., channel, sample); see `zirr2018` for what they may be."""
        samples = as_pixels(x)
        channels, n = samples.shape[-2:]
        rows = samples.reshape(-1, channels, n)
        # The image is exposed by what it shows, before anything is reweighted.
        means = luminance(np.nan_to_num(registry.mean_of_good(rows)), channel_axis=-1)
        found = exposure_unit(means, unit)
        layers, counts = [], []
        # One part at least, for what has no pixels has layers, too.
        for part in spans(len(rows) or 1, max(1, _CHUNK // (channels * n))):
            kept, whole = registry.whole_samples(rows[part])
            relative = kept / np.float64(found)
            counts.append(np.count_nonzero(whole, axis=-1))
            divided = np.maximum(counts[-1], 1)[:, np.newaxis, np.newaxis]
            layers.append(relative @ layer_weights(luminance(relative)) / divided)
        shape = samples.shape[:-2]
        split = np.moveaxis(np.concatenate(layers), -1, 0).reshape(LAYERS, *shape, channels)
        return cls(split, np.concatenate(counts).reshape(shape), found)

    def resolve(self, kappa: npt.ArrayLike, *, radius: int = 1) -> Floats:
        """Add the layers up by their reliability, for one kappa or many.

        Parameters
        ----------
        kappa
            Samples that confirm a brightness, larger than 0, shape () or (kappa,).
        radius
            1 for 3 x 3 pixels, which needs an image (y, x, channel); 0 for the pixel alone.

        Returns
        -------
        ndarray
            Radiance, shape (..., channel) or (..., channel, kappa).

        Raises
        ------
        InputError
            If a kappa is not positive, or neighbours are asked of what is no image.

        Examples
        --------
        >>> cascade = Cascade.of([[1.0] * 31 + [900.0]], unit=1.0)
        >>> cascade.resolve([1e-9, 0.1, 1.0, 10.0], radius=0).round(1).tolist()
        [[29.1, 8.2, 1.5, 1.2]]
        """
        kappas = np.asarray(kappa, dtype=np.float64)
        if kappas.ndim > 1 or not (kappas > 0).all():
            message = f"kappa must be one or more numbers larger than 0, got {kappa!r}"
            raise InputError(message)
        if radius and self.layers.ndim != 4:
            message = f"neighbours need an image (y, x, channel), got {self.layers.shape[1:]}"
            raise InputError(message)
        k = kappas.reshape(-1, *(1,) * self.count.ndim)
        near, around = self._luminances(0), self._luminances(radius)
        accepted = np.zeros((kappas.size, *self.layers.shape[1:]))
        # Up to b times as much energy in one sample passes where kappa aims at a small error.
        slack = 1 + 0.6 * (BASE - 1) * (1 - np.minimum(1 / k, 1))
        hits = self.count / k
        for index, layer in enumerate(self.layers):
            rows = slice(max(index - 1, 0), index + 2)
            reliable, own = (hits * part[rows].sum(axis=0) - 1 / k for part in (around, near))
            reliable = np.where(reliable >= 0, own, reliable)
            bright = np.maximum(luminance(accepted, channel_axis=-1), _DARKEST)
            colour = bright * hits / BASE**index * slack
            weight = np.clip((reliable + colour) / 2, k <= _OFF, 1)
            accepted += weight[..., np.newaxis] * layer
        found = np.moveaxis(accepted * self.unit, 0, -1)
        return np.asarray(found.reshape(*self.layers.shape[1:], *kappas.shape))

    def _luminances(self, radius: int) -> Floats:
        """Return luminances of the layers, averaged over a window, in units of their brightness."""
        values: Floats = luminance(self.layers, channel_axis=-1).astype(np.float64)
        values /= BASE ** np.arange(LAYERS).reshape(-1, *(1,) * (values.ndim - 1))
        if radius == 0:
            return values
        # The border repeats, as in the authors' viewer.
        return window_sum(values, radius, mode="edge") / (2 * radius + 1) ** 2


def _estimate(x: Reals, kappa: float, unit: float | None, *, radius: int) -> Reals:
    cascade = Cascade.of(x, unit=unit)
    return np.where(
        cascade.count[..., np.newaxis] > 0, cascade.resolve(kappa, radius=radius), np.nan
    )


@register(
    "karis2013", "Karis 2013, graphicrants.blogspot.com", label="Karis 2013", joint_channels=True
)
def karis2013(x: Reals, *, unit: float | None = None) -> Reals:
    """Tone-mapped average: each sample is weighted by ``1 / (1 + L)``, L being its luminance.

    That is the mean of the samples after the tone curve ``x / (1 + L)``, taken back by the same
    curve of its weights. One firefly pulls no harder than a white sample. Real-time renderers
    average the samples of an edge, or of a bright highlight, like this. Bias is to the dark, the
    more the samples differ.

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
    """Return sums (..., channel) over weights (...); NaN where nothing has any."""
    return np.asarray(total / np.where(weight > 0, weight, np.nan)[..., np.newaxis])


def _exposed(kept: Reals, whole: npt.NDArray[np.bool_], unit: float | None) -> np.float64:
    """Return the radiance of 1: that of an exposure of the pixels' means, unless it is given."""
    total = luminance(kept).sum(axis=-1, dtype=np.float64)
    return np.float64(exposure_unit(total / np.maximum(np.count_nonzero(whole, axis=-1), 1), unit))


@register("clamped", "Pharr, Jakob and Humphreys 2023, pbr-book.org", joint_channels=True)
def clamped(x: Reals, *, limit: float = 10.0, unit: float | None = None) -> Reals:
    """Mean of clamped samples: one whose largest channel exceeds a limit is scaled down to it.

    What renderers offer against fireflies: ``maxcomponentvalue`` of pbrt's film, which keeps the
    colour of a sample, and the clamping of light paths in Cycles. All light above the limit is
    lost, that of lamps in view and of their reflections, too: bias is to the dark.

    Parameters
    ----------
    x
        Samples, shape (..., channel, sample), 1 or 3 channels. A sample of which any channel is
        NaN or infinite is left out.
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
    """Mean of the samples that are not alone in joint image and colour space.

    A sample stays if at least k others are less than 1 away, ``d^2 = (dx^2 + dy^2) / (r + 1)^2 +
    mean_c (log x_c - log x'_c)^2 / h^2``. That is the same as a bound on the distance to its k-th
    nearest neighbour, the classical estimate of a density.

    Reconstructed from the paper's abstract, which characterises outliers by their density among
    nearby paths in joint image and colour space; metric, bounds and defaults are chosen here.
    Colours are those of an image exposed as usual, and what is darker than 0.01 of that is black:
    dim samples and negative ones are not outliers. Bias is to the dark, more where a bright event
    is rare but real.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample). A sample of which any channel is NaN or infinite
        is left out.
    neighbours
        k, at least 1.
    bandwidth
        h, the difference of natural logarithms that counts as 1, larger than 0.
    radius
        r, in pixels: samples up to r pixels away count; 0 for those of the pixel alone.
    unit
        Radiance that is exposed as 1; None makes the log-average of the image 0.18.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit and dtype of `x`. Where all samples of a pixel
        are alone, and where no whole sample is good, the mean of a channel's good samples; NaN
        where there are none of these.

    Raises
    ------
    InputError
        If `x` is no image, or an option is out of range.

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
    # The nearest is the sample itself. What has no k-th neighbour within 1 is infinitely far.
    distance = tree.query(tree.data, [neighbours + 1], distance_upper_bound=1, workers=-1)[0][:, 0]
    stays = np.zeros(usable.shape, bool)
    stays[usable] = np.isfinite(distance)
    total = (kept * stays[..., np.newaxis, :]).sum(axis=-1, dtype=np.float64)
    return _over(total, np.count_nonzero(stays, axis=-1))
