"""Regions: where to look in an image that no recipe describes, from its classified pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.display import percent
from chdstat.rendering.recipes import Region

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["choose_regions"]


def choose_regions(patterns: xr.Dataset, *, edge: int = 5, most: int = 8) -> tuple[Region, ...]:
    """Choose one region for every pattern of an image, where the pattern is purest.

    That is the window of `edge` x `edge` pixels with the most pixels of the label; of equal ones,
    the one deepest inside its patch, so that marks do not sit on borders.

    Parameters
    ----------
    patterns
        What `chdstat.classify` returns: `label` (y, x) with its flag meanings.
    edge
        Edge of a region in pixels; less in smaller images.
    most
        Regions at most; the most frequent labels come first.
    """
    label = patterns["label"]
    codes = np.asarray(label.values)
    names = str(label.attrs["flag_meanings"]).replace("_", "-").split()
    masks = {n: codes == c for c, n in zip(label.attrs["flag_values"], names, strict=True)}
    edge = min(edge, *codes.shape)
    found = sorted(filter(lambda n: masks[n].any(), masks), key=lambda n: -masks[n].sum())
    return tuple(
        Region(
            n,
            n,
            _purest(masks[n], edge),
            f"{percent(float(masks[n].mean()))} of the pixels have this label",
        )
        for n in found[:most]
    )


def _purest(mask: npt.NDArray[np.bool_], edge: int) -> tuple[float, float, float, float]:
    height, width = mask.shape
    depth = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    score = ndimage.uniform_filter(mask.astype(float), edge, mode="constant") + 1e-3 * depth
    y, x = np.unravel_index(np.argmax(np.where(mask, score, -1)), mask.shape)
    top = int(np.clip(y - edge // 2, 0, height - edge))
    left = int(np.clip(x - edge // 2, 0, width - edge))
    return left / width, top / height, (left + edge) / width, (top + edge) / height
