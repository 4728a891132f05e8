"""Streaming: walk an image tile by tile, and each tile batch by batch, in constant memory.

Use `Samples.map` where a function needs all samples of a pixel at once, this where it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LeftOut
from chdstat.samples.samples import Mapped, Samples

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
    left_out = LeftOut()

    def seen(walk: Iterable[tuple[slice, slice, slice, npt.NDArray[np.float32]]]) -> Blocks:
        for *_, block in walk:
            left_out.see(block, channel_axis=-2)
            yield block

    parts = (
        (ys, xs, function(ys, xs, seen(walk)))
        for (ys, xs), walk in groupby(samples.blocks(), key=lambda block: block[:2])
    )
    dataset = samples.assemble(parts, description=description, progress=progress)
    left_out.warn()
    return dataset
