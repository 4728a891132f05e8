"""Primaries: colours of files, of whatever red, green and blue, brought to linear Rec. 709.

A colour (r, g, b) is the tristimulus value ``P diag(s) (r, g, b)``: the columns of P are the
chromaticities (x, y, 1 - x - y) of the primaries, and s makes (1, 1, 1) the white point (SMPTE RP
177). Another white point than that of Rec. 709 is adapted by the matrix of Bradford.

Sources: SMPTE RP 177-1993, "Derivation of basic television color equations"; K. M. Lam,
"Metamerism and colour constancy", PhD thesis, University of Bradford, 1985, as in ISO 15076-1:2010,
annex E; ITU-R BT.709-6 and BT.2020-2; SMPTE ST 2065-1:2012 (ACES); Academy S-2014-004 (ACEScg);
SMPTE EG 432-1:2010 (P3); Adobe RGB (1998) color image encoding. Names of colour spaces are those of
the Color Interop Forum, "Color space encodings for texture assets and CG rendering", 2024.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["AP0", "REC709", "from_xyz", "named", "to_rec709"]

Matrix = npt.NDArray[np.float64]
Chromaticities = tuple[float, ...]
"""x and y of red, green, blue and white."""

_D65, _ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
REC709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
"""Linear Rec. 709, which is linear sRGB."""
AP0: Chromaticities = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES_WHITE)
_AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES_WHITE)
_NAMED: Mapping[str, Chromaticities] = {
    "acescg": _AP1,
    "ap1": _AP1,
    "aces2065": AP0,
    "ap0": AP0,
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "p3d65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "adobergb": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
    "rec709": REC709,
    "srgb": REC709,
}
_SAYS_NOTHING = frozenset(("", "linear", "scenelinear", "raw", "data", "unknown", "none"))
_CLOSE = 5e-4
"""By how much chromaticities differ that were rounded in different ways."""
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def named(space: str) -> Chromaticities | None:
    """Return the chromaticities of a linear colour space by its name; () where it says nothing.

    None is what is not understood, or not linear.

    Examples
    --------
    >>> named("lin_ap1_scene") == named("ACES - ACEScg"), named("Linear"), named("sRGB")
    (True, (), None)
    """
    plain = re.sub(r"[^a-z0-9]", "", space.casefold())
    if plain in _SAYS_NOTHING:
        return ()
    linear = re.search("(?<!non)lin", plain) or "acescg" in plain or "aces2065" in plain
    return next((c for name, c in _NAMED.items() if linear and name in plain), None)


def to_rec709(chromaticities: Sequence[Any]) -> Matrix | None:
    """Return the matrix that brings colours to linear Rec. 709; None where they are of it.

    Raises
    ------
    ValueError
        If no colours have such chromaticities.

    References
    ----------
    SMPTE RP 177-1993; the adaptation of the white point is that of Lam (1985).

    Examples
    --------
    >>> np.round(to_rec709((0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290))[0], 4)
    array([ 1.6605, -0.5876, -0.0728])
    """
    given = np.asarray(chromaticities, dtype=float)
    if given.shape == (8,) and np.abs(given - REC709).max() <= _CLOSE:
        return None
    if given.shape != (8,) or not np.isfinite(given).all() or given[7] <= 0:
        message = f"{chromaticities} are no chromaticities"
        raise ValueError(message)
    ours, white = _to_xyz(np.array(REC709))
    theirs, other = _to_xyz(given)
    cone = (_BRADFORD @ white) / (_BRADFORD @ other)
    adapted = np.linalg.solve(_BRADFORD, cone[:, np.newaxis] * _BRADFORD)
    same = np.abs(given[6:] - REC709[6:]).max() <= _CLOSE
    found = np.asarray(np.linalg.solve(ours, theirs if same else adapted @ theirs), float)
    if not np.isfinite(found).all():
        message = f"{chromaticities} are no chromaticities"
        raise ValueError(message)
    return found


def from_xyz() -> Matrix:
    """Return the matrix from tristimulus values of CIE 1931 to linear Rec. 709, white unadapted.

    Examples
    --------
    >>> from_xyz()[0].round(4)
    array([ 3.241 , -1.5374, -0.4986])
    """
    return np.asarray(np.linalg.inv(_to_xyz(np.array(REC709))[0]), float)


def _to_xyz(chromaticities: Matrix) -> tuple[Matrix, Matrix]:
    """Return the matrix to tristimulus values, and the white point with Y = 1."""
    x, y = chromaticities.reshape(4, 2).T
    columns = np.stack([x, y, 1 - x - y])
    if abs(np.linalg.det(columns[:, :3])) < 1e-6:
        message = f"primaries {chromaticities[:6]} lie on a line"
        raise ValueError(message)
    white = columns[:, 3] / y[3]
    return columns[:, :3] * np.linalg.solve(columns[:, :3], white), white
