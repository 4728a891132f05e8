"""Outliers: samples that few others confirm are left out, in part or as a whole.

`zirr2018` and `zirr2018_pixel` split a sample between the two layers whose brightness it lies
between. A layer counts as far as enough samples of its brightness have fallen into the pixel or
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

from chdstat._core.arrays import all_good, as_pixels, is_bad, luminance, spans, whole
from chdstat._core.image_scales import exposure_unit
from chdstat.errors import InputError
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.registry import register
from chdstat.estimators.rows import Floats, check_positive
from chdstat.estimators.similarity import dense

__all__ = [
    "BASE",
    "LAYERS",
    "Cascade",
    "decoro2010",
    "karis2013",
    "layer_weights",
    "zirr2018",
    "zirr2018_pixel",
]

Array = npt.NDArray[np.floating[Any]]

BASE = 8.0
"""Ratio b of the brightness of neighbouring layers: the paper's default, in the authors' code."""
LAYERS = 6
"""Number of layers, of brightness b^0 to b^5: as above."""

_DARKEST = 0.05
"""Luminance that is always taken for reliable (authors' code)."""
_OFF = 1e-6
"""Largest kappa that switches the reweighting off (authors' code)."""
_CHUNK = 2**16
"""Samples split at once."""
_SOURCE = "Zirr et al. 2018, doi:10.1111/cgf.13335"


@register("zirr2018", _SOURCE, label="Zirr et al. 2018", place=6, uses_neighbours=True)
def zirr2018(x: Array, *, kappa: float = 1.0, unit: float | None = None) -> Array:
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
def zirr2018_pixel(x: Array, *, kappa: float = 1.0, unit: float | None = None) -> Array:
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
        count = np.empty(len(rows), np.int64)
        # The image is exposed by what it shows, before anything is reweighted.
        means = luminance(np.nan_to_num(mean_of_good(rows)), channel_axis=-1)
        found = exposure_unit(means, unit)
        layers = np.empty((LAYERS, len(rows), channels))
        for part in spans(len(rows), max(1, _CHUNK // (channels * n))):
            layers[:, part], count[part] = _split(rows[part], found)
        shape = samples.shape[:-2]
        return cls(layers.reshape(LAYERS, *shape, channels), count.reshape(shape), found)

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
        near = self._luminances(0)
        around = self._luminances(radius) if radius else near
        found = [self._resolve(float(k), near, around) for k in kappas.reshape(-1)]
        return found[0] if kappas.ndim == 0 else np.stack(found, axis=-1)

    def _luminances(self, radius: int) -> Floats:
        """Return luminances of the layers, averaged over a window, in units of their brightness."""
        values: Floats = luminance(self.layers, channel_axis=-1).astype(np.float64)
        values /= BASE ** np.arange(LAYERS).reshape(-1, *(1,) * (values.ndim - 1))
        return _window_mean(values, radius) if radius else values

    def _resolve(self, kappa: float, near: Floats, around: Floats) -> Floats:
        accepted = np.zeros(self.layers.shape[1:])
        # Up to b times as much energy in one sample passes where kappa aims at a small error.
        for_error = 1 - min(1 / kappa, 1)
        slack = 1 + 0.6 * (BASE - 1) * for_error
        hits = self.count / kappa
        for index, layer in enumerate(self.layers):
            rows = slice(max(index - 1, 0), index + 2)
            reliable = hits * around[rows].sum(axis=0) - 1 / kappa
            own = hits * near[rows].sum(axis=0) - 1 / kappa
            reliable = np.where(reliable >= 0, own, reliable)
            bright = np.maximum(luminance(accepted, channel_axis=-1), _DARKEST)
            colour = bright * hits / BASE**index * slack
            weight = np.clip((reliable + colour) / 2, float(kappa <= _OFF), 1)
            accepted += weight[..., np.newaxis] * layer
        return accepted * self.unit


def layer_weights(brightness: npt.ArrayLike) -> Floats:
    """Split samples between the layers, by their luminance L in units of the lowest layer.

    Between B_i and B_(i+1), ``w_i = (B_i / L - 1 / b) / (1 - 1 / b)`` and ``w_(i+1) = 1 - w_i``, so
    that ``sum_i w_i L / B_i = 1``: every sample counts as one. Below B_0, negative samples too, all
    of it falls into the lowest layer, above the top one ``B_top / L`` into that.

    Parameters
    ----------
    brightness
        Luminances, shape (...).

    Returns
    -------
    ndarray
        Weights, shape (..., layer).

    Examples
    --------
    >>> layer_weights([0.5, 4.0])[:, :3].round(3).tolist()
    [[1.0, 0.0, 0.0], [0.143, 0.857, 0.0]]
    """
    level = np.asarray(brightness, dtype=np.float64)
    weights = np.zeros((*level.shape, LAYERS))
    below = np.zeros(level.shape)
    # A subnormal luminance would overflow the ratio; anything below B_0 is as good as B_0.
    inverse = 1 / np.maximum(level, 1)
    for index in range(LAYERS - 1):
        # What falls into this layer or a lower one.
        upto = np.clip((BASE**index * inverse - 1 / BASE) / (1 - 1 / BASE), 0, 1)
        weights[..., index] = upto - below
        below = upto
    weights[..., -1] = (1 - below) * np.minimum(BASE ** (LAYERS - 1) * inverse, 1)
    return weights


def _estimate(x: Array, kappa: float, unit: float | None, *, radius: int) -> Array:
    cascade = Cascade.of(x, unit=unit)
    found = cascade.resolve(kappa, radius=radius)
    empty = cascade.count == 0
    found[empty] = mean_of_good(x[empty])
    return found


def _split(rows: npt.NDArray[Any], unit: float) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return the layers (layer, row, channel) of rows (row, channel, sample), and their counts."""
    count = np.full(len(rows), rows.shape[-1], np.int64)
    if not all_good(rows):
        bad = np.asarray(is_bad(rows).any(axis=-2, keepdims=True))
        count -= np.count_nonzero(bad[:, 0], axis=-1)
        rows = np.where(bad, 0, rows)
    relative = rows / np.float64(unit)
    weights = layer_weights(luminance(relative))
    layers = np.matmul(relative, weights) / np.maximum(count, 1)[:, np.newaxis, np.newaxis]
    return np.moveaxis(layers, -1, 0), count


def _window_mean(values: Floats, radius: int) -> Floats:
    """Average (layer, y, x) over windows; the border repeats, as in the authors' viewer."""
    width = 2 * radius + 1
    _, height, across = values.shape
    padded = np.pad(values, ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    rows = sum((padded[:, i : i + height] for i in range(width)), np.zeros(1))
    columns = sum((rows[:, :, j : j + across] for j in range(width)), np.zeros(1))
    return np.asarray(columns / width**2)


@register(
    "karis2013", "Karis 2013, graphicrants.blogspot.com", label="Karis 2013", joint_channels=True
)
def karis2013(x: Array, *, unit: float | None = None) -> Array:
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
    bad = np.asarray(is_bad(x).any(axis=-2))
    good = np.where(bad[..., np.newaxis, :], 0, x)
    bright, count = luminance(good), np.count_nonzero(~bad, axis=-1)
    exposed = exposure_unit(bright.sum(axis=-1, dtype=np.float64) / np.maximum(count, 1), unit)
    weight = ~bad / (1 + np.maximum(bright, 0) / np.float64(exposed))
    total = weight.sum(axis=-1)[..., np.newaxis]
    found = np.vecdot(good, weight[..., np.newaxis, :])
    return np.where(total > 0, found / np.where(total > 0, total, 1), mean_of_good(x))


@register(
    "decoro2010",
    "DeCoro et al. 2010, doi:10.1111/j.1467-8659.2010.01799.x",
    label="DeCoro et al. 2010",
    place=6,
    uses_neighbours=True,
)
def decoro2010(
    x: Array,
    *,
    neighbours: int = 4,
    bandwidth: float = 1.0,
    radius: int = 1,
    unit: float | None = None,
) -> Array:
    """Mean of the samples that are not alone in joint image and colour space.

    A sample stays if at least k others are less than 1 away, ``d^2 = (dx^2 + dy^2) / (r + 1)^2 +
    mean_c (log x_c - log x'_c)^2 / h^2``. That is the same as a bound on the distance to its k-th
    nearest neighbour, the classical estimate of a density.

    Reconstructed from the paper's abstract, which characterises outliers by their density among
    nearby paths in joint image and colour space; metric, bounds and defaults are ours. Colours are
    those of an image exposed as usual, and what is darker than 0.01 of that is black: dim samples
    and negative ones are not outliers. Bias is to the dark, more where a bright event is rare but
    real.

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
    whole("neighbours", neighbours, least=1)
    whole("radius", radius, least=0)
    check_positive(bandwidth=bandwidth)
    bad = np.asarray(is_bad(x).any(axis=-2))
    kept = dense(x, bad, neighbours, bandwidth, radius, unit) & ~bad
    alone = ~kept.any(axis=-1)
    count = np.maximum(np.count_nonzero(kept, axis=-1), 1)[..., np.newaxis]
    # A product with the mask would turn what is left out, infinite or NaN, into NaN.
    found = np.where(kept[..., np.newaxis, :], x, 0).sum(axis=-1, dtype=np.float64) / count
    found[alone] = mean_of_good(x[alone])
    return np.asarray(found)
