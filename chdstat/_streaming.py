"""Streaming: walk an image tile by tile, and each tile batch by batch, in constant memory.

Use `Samples.map` where a function needs all samples of a pixel at once, this where it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.progress import track
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["reduce_tiles"]

Blocks = Iterator[npt.NDArray[np.float32]]


def reduce_tiles(
    samples: Samples,
    function: Callable[[slice, slice, Blocks], Mapped],
    *,
    description: str,
    progress: bool | None = None,
) -> xr.Dataset:
    """Reduce the sample blocks of every tile and assemble the image.

    Parameters
    ----------
    samples
        The image.
    function
        Takes the rows and columns of a tile and its blocks in stored order, each (y, x, channel,
        sample); returns, by variable name, the dims that follow (y, x) and an array (y, x, ...).
    description
        What the progress bar says.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    xarray.Dataset
        The variables over the whole image, with y, x and channel coordinates.
    """
    import xarray as xr

    height, width = samples.shape[:2]
    whole: dict[str, tuple[tuple[str, ...], npt.NDArray[Any]]] = {}
    with track(description, height * width, unit="px", show=progress) as advance:
        for (ys, xs), walk in groupby(samples.blocks(), key=lambda block: block[:2]):
            for name, (dims, part) in function(ys, xs, (block for *_, block in walk)).items():
                if name not in whole:
                    image = np.empty((height, width, *part.shape[2:]), part.dtype)
                    whole[name] = (("y", "x", *dims), image)
                whole[name][1][ys, xs] = part
            advance((ys.stop - ys.start) * (xs.stop - xs.start))
    coords = {
        "y": np.arange(height),
        "x": np.arange(width),
        # Strings of variable length: zarr v3 has no stable type for those of fixed length.
        "channel": np.array(samples.channels, dtype=object),
    }
    return xr.Dataset(whole, coords, attrs=samples.attrs)
