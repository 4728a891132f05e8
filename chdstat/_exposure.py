"""Exposure: how bright a picture is shown where nobody says so."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["auto_exposure"]

_WHITE, _PERCENTILE = 0.8, 90
_KEY = 0.09
"""Log-average of what is shown, at least: a stop below the middle grey of Reinhard et al."""
_MOST_STOPS = 3.0
_LIMIT = 32.0


def auto_exposure(image: npt.ArrayLike) -> float:
    """Return stops that show a picture well.

    They put the 90th percentile near white, which suits rooms; but a view whose window or lamps
    are more than a tenth of it, and would leave all else black, is up to three stops brighter, as
    its log-average asks (Reinhard et al., "Photographic tone reproduction for digital images",
    2002, doi:10.1145/566654.566575).

    Parameters
    ----------
    image
        Linear radiance, any shape; what is not finite is left out.

    Examples
    --------
    >>> room = np.full(100, 0.4)
    >>> round(auto_exposure(room), 2)
    1.0
    >>> room[:20] = 400  # a window
    >>> round(2 ** auto_exposure(room) * 400, 2)  # 0.8, brighter by three stops
    6.4
    """
    values = np.asarray(image, dtype=np.float64)
    values = values[np.isfinite(values)]
    bright = float(np.percentile(values, _PERCENTILE)) if values.size else 0.0
    if not bright > 0:
        return 0.0
    stops = np.log2(_WHITE / bright)
    wanted = np.log2(_KEY) - float(np.log2(values[values > 0]).mean())
    return float(np.clip(stops + np.clip(wanted - stops, 0, _MOST_STOPS), -_LIMIT, _LIMIT))
