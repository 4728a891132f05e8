"""Files of Bayesian collaborative denoising: its raw samples, and the three images that it takes.

A file of raw samples has a header of five int32, version, width, height, samples of each pixel and
channels, of which there are 3 or 4; then the samples as float32, pixel by pixel, row by row, the
channels of a sample together. The fourth channel is alpha, and left out.

`write_bcd` writes what the denoiser takes: the mean image, the covariance of the mean's samples as
channels Bin_0000 to Bin_0005 (xx, yy, zz, yz, xz, xy), and histograms of 20 bins for each of R, G
and B as Bin_0000 to Bin_0059, with the number of samples as Bin_0060.

Sources: M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte Carlo rendering",
Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231; its code, superboubek/bcd
(src/raw_converter/main.cpp, src/core/SamplesAccumulator.cpp, src/Common/exr/io_exr.cpp).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError, StoreError
from chdstat.io.arrays import ArraySource, joined
from chdstat.io.reading import Asked, Opened

__all__ = ["open_bcd"]

_HEADER = 5 * 4


def open_bcd(paths: Sequence[Path], asked: Asked) -> Opened:
    """Open files of raw samples, which follow each other."""
    if asked.features or asked.variable:
        message = "raw samples of BCD come without features; give features as files"
        raise InputError(message)
    return Opened(joined([ArraySource(_mapped(path), "yxsc", path) for path in paths]))


def _mapped(path: Path) -> npt.NDArray[Any]:
    """Return the samples in a file, shape (y, x, sample, channel), mapped into memory."""
    try:
        header = np.fromfile(path, "<i4", count=5)
        size = path.stat().st_size
        _, width, height, samples, channels = map(int, header) if len(header) == 5 else [0] * 5
        shape = (height, width, samples, channels)
        needed = _HEADER + 4 * height * width * samples * channels
        if min(shape) < 1 or channels not in (3, 4) or size != needed:
            message = (
                f"cannot read {path} as raw samples of BCD: its header claims {width} x {height} "
                f"pixels of {samples} samples of {channels} channels, but it has {size} bytes"
            )
            raise StoreError(message)
        array = np.memmap(path, "<f4", mode="r", offset=_HEADER, shape=shape)
    except OSError as error:
        message = f"cannot read {path}: {error.strerror or error}"
        raise StoreError(message) from error
    return array[..., :3]
