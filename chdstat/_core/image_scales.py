"""Image scales: how bright an image is, for the screen and for published thresholds.

- `display_stops` and `tonemap` show an image.
- `exposure_unit` is the radiance that a usual exposure shows as 1.
- `relative_error` is the relative error of an image, and `relative_scale` its denominator.
- `worst_parts` are where an image is furthest above a better one.
- `layer_weights` splits samples between layers of brightness.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Reals
from chdstat.errors import InputError

BASE = 8.0
"""Ratio b of the brightness of neighbouring layers: the paper's default, in the authors' code."""
LAYERS = 6
"""Number of layers, of brightness b^0 to b^5, as in the paper."""
_DARK = 0.01
"""Share of a scene's squared mean that keeps relative errors of its dark pixels finite."""
TOLERANCE = 1.1
"""An error counts as reached if its estimate exceeds it by at most a tenth."""
_WHITE, _PERCENTILE = 0.8, 90
_KEY = 0.09
"""Least log-average of a shown image: a stop below the middle grey of Reinhard et al."""
_MOST_STOPS = 3.0
_LIMIT = 32.0
_MIDDLE_GREY = 0.18
_PARTS, _OF_EDGE = 2, 6
"""Number of the worst parts; their edge is this fraction of the image's shorter edge."""


def relative_scale(value: Array, of_scene: npt.ArrayLike | None = None) -> Array:
    """Return y^2 + 0.01 m^2, which makes squared errors of radiances y relative errors.

    No pixel thus counts as darker than a tenth of the scene, whose mean m is `of_scene`; None for
    the mean of all finite y.

    Examples
    --------
    >>> relative_scale(np.array([0.0, 2.0]), 10), relative_scale(np.array([0.0, 20.0]))
    (array([1., 5.]), array([  1., 401.]))
    """
    if of_scene is None:
        known = value[np.isfinite(value)]
        of_scene = known.mean() if known.size else np.nan
    return np.asarray(value**2 + _DARK * np.square(of_scene))


def relative_error(squared: Reals, image: Array) -> float:
    """Return the relative error of an image: the root of its relMSE.

    relMSE is the mean over pixels and channels of ``e^2 / (y^2 + 0.01 m^2)``, with y the radiance
    and m the mean of its channel over the image. Pixels that are NaN are left out.

    Parameters
    ----------
    squared
        Squared errors e^2, shape (y, x, channel).
    image
        The true image y, or the best estimate of it.

    Examples
    --------
    >>> image = np.full((2, 2, 3), 5.0)
    >>> round(relative_error(np.full_like(image, 0.1**2), image), 3)  # 0.1 of 5
    0.02
    """
    scale = relative_scale(image, np.nanmean(image, axis=(0, 1), dtype=np.float64))
    relative = np.divide(squared, scale, out=np.zeros_like(scale), where=scale != 0)
    return float(np.sqrt(np.nanmean(relative)))


def display_stops(image: npt.ArrayLike) -> float:
    """Return the stops that show an image well.

    They put the 90th percentile near white, which suits rooms. If windows or lamps fill more than a
    tenth of a view and would leave everything else black, the image is up to three stops brighter,
    according to its log-average (Reinhard et al., "Photographic tone reproduction for digital
    images", 2002, doi:10.1145/566654.566575).

    Parameters
    ----------
    image
        Linear radiance, any shape; values that are not finite are left out.

    Examples
    --------
    >>> room = np.full(100, 0.4)
    >>> round(display_stops(room), 2)
    1.0
    >>> room[:20] = 400  # a window
    >>> round(2 ** display_stops(room) * 400, 2)  # 0.8, brighter by three stops
    6.4
    """
    values = np.asarray(image, dtype=np.float64)
    values = values[np.isfinite(values)]
    bright = float(np.percentile(values, _PERCENTILE)) if values.size else 0.0
    if not bright > 0:
        return 0.0
    stops = np.log2(_WHITE / bright)
    wanted = np.log2(_KEY / _log_average(values))
    return float(np.clip(stops + np.clip(wanted - stops, 0, _MOST_STOPS), -_LIMIT, _LIMIT))


def tonemap(image: npt.ArrayLike, *, exposure: float | None = None) -> npt.NDArray[np.float64]:
    """Return display values for linear radiance: exposure, then the sRGB curve, clipped to [0, 1].

    Parameters
    ----------
    image
        Linear radiance, shape (y, x, channel) with 1 or 3 channels.
    exposure
        Stops. None puts the 90th percentile near white, which suits interiors, or up to three stops
        above it if windows or lamps would leave everything else dark.

    Returns
    -------
    ndarray
        Display values, shape (y, x, 3), in [0, 1]; pixels that are not finite are magenta, to stand
        out.

    Raises
    ------
    InputError
        If the shape is not (y, x, 1) or (y, x, 3).

    Examples
    --------
    >>> tonemap(np.full((1, 1, 3), 1.0), exposure=-1).round(3)
    array([[[0.735, 0.735, 0.735]]])
    """
    linear = np.asarray(image, dtype=np.float64)
    if linear.ndim != 3 or linear.shape[2] not in {1, 3}:
        message = f"an image must have shape (y, x, 1) or (y, x, 3), got {linear.shape}"
        raise InputError(message)
    linear = np.broadcast_to(linear, (*linear.shape[:2], 3))
    finite = np.asarray(np.isfinite(linear).all(axis=-1))
    stops = display_stops(linear[finite]) if exposure is None else exposure
    value = np.clip(np.where(finite[..., None], linear, 0) * 2.0**stops, 0, 1)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.where(finite[..., None], curve, (1.0, 0.0, 1.0))


def worst_parts(image: npt.ArrayLike, better: npt.ArrayLike) -> list[tuple[slice, slice]]:
    """Return the two parts of an image, rows and columns, that exceed a better image most.

    Examples
    --------
    >>> image = np.ones((32, 32, 3))
    >>> image[20, 8] = 9.0
    >>> worst_parts(image, np.ones((32, 32, 3)))
    [(slice(16, 24, None), slice(4, 12, None))]
    """
    seen, truth = (np.asarray(i, np.float64).mean(axis=-1) for i in (image, better))
    level = float(np.nanmean(truth)) or 1.0  # of excess that is seen, not only in the dark
    excess = np.nan_to_num((seen - truth) / (np.abs(truth) + level))
    height, width = excess.shape
    edge = min(height, width, max(8, min(height, width) // _OF_EDGE))
    parts: list[tuple[slice, slice]] = []
    while len(parts) < _PARTS and excess.max() > 0:
        y, x = np.unravel_index(excess.argmax(), excess.shape)
        top = int(np.clip(y - edge // 2, 0, height - edge))
        left = int(np.clip(x - edge // 2, 0, width - edge))
        parts.append((slice(top, top + edge), slice(left, left + edge)))
        excess[max(0, top - edge // 2) : top + 3 * edge // 2,
               max(0, left - edge // 2) : left + 3 * edge // 2] = 0  # fmt: skip
    return parts


def exposure_unit(pixels: Reals, unit: float | None = None) -> float:
    """Return the radiance that counts as 1: the log-average of the image is middle grey, 0.18.

    This follows Reinhard et al. 2002, doi:10.1145/566654.566575, equations 1 and 2, without black
    pixels. It is 1 for a black image. Some estimators were published with thresholds in absolute
    radiance, and mean those of an image with this exposure.

    Parameters
    ----------
    pixels
        Luminances, any shape; values that are not positive and finite are left out.
    unit
        Returned as it is, if the caller knows the unit.

    Raises
    ------
    InputError
        If `unit` is not positive and finite.
    """
    if unit is not None:
        if not 0 < unit < np.inf:
            message = f"unit must be a positive radiance, got {unit}"
            raise InputError(message)
        return float(unit)
    average = _log_average(pixels[np.isfinite(pixels)].astype(np.float64))
    return average / _MIDDLE_GREY if average > 0 else 1.0


def _log_average(values: npt.NDArray[np.float64]) -> float:
    """Return the geometric mean of the positive values, 0 if there are none."""
    lit = values[values > 0]
    return float(np.exp(np.log(lit).mean())) if lit.size else 0.0


def layer_weights(brightness: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Split samples between the layers, by their luminance L in units of the lowest layer.

    Between B_i and B_(i+1), ``w_i = (B_i / L - 1 / b) / (1 - 1 / b)`` and ``w_(i+1) = 1 - w_i``, so
    that ``sum_i w_i L / B_i = 1``: every sample counts as one. Below B_0, and for negative samples,
    everything falls into the lowest layer. Above the top layer, ``B_top / L`` falls into the top
    layer.

    Parameters
    ----------
    brightness
        Luminances, shape (...).

    Returns
    -------
    ndarray
        Weights, shape (..., layer).

    References
    ----------
    T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly samples for improved finite-sample
    Monte Carlo estimates", Computer Graphics Forum 37(6), 2018, doi:10.1111/cgf.13335; the authors'
    code, tszirr/ic.js (rw/split.cpp).

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
        # The part in this layer or a lower one.
        upto = np.clip((BASE**index * inverse - 1 / BASE) / (1 - 1 / BASE), 0, 1)
        weights[..., index] = upto - below
        below = upto
    weights[..., -1] = (1 - below) * np.minimum(BASE ** (LAYERS - 1) * inverse, 1)
    return weights
