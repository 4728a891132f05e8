"""Raw samples of Bayesian collaborative denoising.

A file has a header of five int32, version, width, height, samples of each pixel and channels, of
which there are 3 or 4; then the samples as float32, pixel by pixel, row by row, the channels of a
sample together. The fourth channel is alpha, and left out.

Sources: M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte Carlo rendering",
Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231; its code, superboubek/bcd
(src/raw_converter/main.cpp).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from chdstat._core.arrays import Array
from chdstat.errors import StoreError
from chdstat.io.lazy import ArraySource, Joined, Opened, ReadOptions, Remapped, readable

__all__ = ["open_bcd"]


def open_bcd(paths: Sequence[Path], _: ReadOptions) -> Opened:
    """Open files of raw samples, which follow each other."""
    return Opened(Joined([ArraySource(Remapped(partial(_mapped, p)), "yxsc", p) for p in paths]))


def _mapped(path: Path) -> Array:
    """Return the samples in a file, shape (y, x, sample, channel), mapped into memory."""
    with readable(path):
        header = np.fromfile(path, "<i4", count=5)
        size = path.stat().st_size
        _, width, height, samples, channels = map(int, header) if len(header) == 5 else [0] * 5
        shape = (height, width, samples, channels)
        needed = header.nbytes + 4 * height * width * samples * channels
        if min(shape) < 1 or channels not in (3, 4) or size != needed:
            message = (
                f"cannot read {path} as raw samples of BCD: its header claims {width} x {height} "
                f"pixels of {samples} samples of {channels} channels, but it has {size} bytes"
            )
            raise StoreError(message)
        return np.memmap(path, "<f4", mode="r", offset=header.nbytes, shape=shape)[..., :3]
