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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.files import checked_target
from chdstat.errors import InputError, StoreError
from chdstat.io.arrays import ArraySource, Remapped, joined
from chdstat.io.exr import write_exr
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import Mapped

__all__ = ["open_bcd", "write_bcd"]

_HEADER = 5 * 4
_BINS, _GAMMA, _LARGEST, _MOST = 20, 2.2, 2.5, 2.0
"""Bins of each channel; ``x^(1 / gamma) / largest`` fills the first 18 up to 1, and the last two
beyond, up to the most (src/raw_converter/main.cpp, src/core/SamplesAccumulator.cpp)."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Order of covariances (src/core/CovarianceMatrix.h)."""


def open_bcd(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open files of raw samples, which follow each other."""
    if options.features or options.variable:
        message = "raw samples of BCD come without features; give features as files"
        raise InputError(message)
    arrays = [Remapped(partial(_mapped, path)) for path in paths]
    sources = [ArraySource(a, "yxsc", path) for a, path in zip(arrays, paths, strict=True)]
    return Opened(joined(sources))


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


def write_bcd(
    samples: Samples | npt.ArrayLike, path: str | Path, *, progress: bool | None = None
) -> tuple[Path, Path, Path]:
    """Write what the Bayesian collaborative denoiser takes: colours, histograms and covariances.

    A sample that is bad in one channel is left out in all. Images of one channel become grey.

    Parameters
    ----------
    samples
        `Samples`, an array (y, x, channel, sample), or the path of a store; of 1 or 3 channels.
    path
        The image of colours, .exr; the others are beside it, as ``NAME_hist.exr`` and
        ``NAME_cov.exr``.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    tuple of pathlib.Path
        Colours, histograms, covariances.

    Raises
    ------
    InputError
        If these are no single samples of 1 or 3 channels, at least 2 of a pixel.
    StoreError
        If a file cannot be written.

    References
    ----------
    M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte Carlo rendering",
    Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231.

    Examples
    --------
    >>> import tempfile
    >>> x = np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 32))
    >>> files = write_bcd(x, Path(tempfile.mkdtemp()) / "kitchen.exr")
    >>> [file.name for file in files]
    ['kitchen.exr', 'kitchen_hist.exr', 'kitchen_cov.exr']
    """
    image, colours = samples_of(samples), checked_target(path, ".exr")
    if image.shape[2] not in (1, 3) or image.spp < 2:
        message = (
            "BCD takes images of 1 or 3 channels and at least 2 samples of each pixel, got samples "
            f"of shape (y, x, channel, sample) = {image.shape}"
        )
        raise InputError(message)
    found = image.map(_statistics, description="writing", progress=progress)
    histograms, covariances = (
        colours.with_stem(f"{colours.stem}_{what}") for what in ("hist", "cov")
    )
    files = colours, histograms, covariances
    for name, file in zip(("mean", "histogram", "covariance"), files, strict=True):
        values = found[name].to_numpy()
        channels = None if name == "mean" else [f"Bin_{i:04}" for i in range(values.shape[2])]
        write_exr(file, values, channels=channels)
    return files


def _statistics(block: npt.NDArray[np.float32]) -> Mapped:
    """Return mean, covariance and histogram of the whole samples of a tile."""
    x = np.broadcast_to(block, (*block.shape[:2], 3, block.shape[3])).astype(np.float64)
    good = np.asarray(np.isfinite(x).all(axis=2, keepdims=True))
    count = good.sum(axis=-1)
    mean = np.where(good, x, 0).sum(axis=-1) / np.maximum(count, 1)
    away = np.where(good, x - mean[..., np.newaxis], 0)
    products = [(away[:, :, i] * away[:, :, j]).sum(axis=-1) for i, j in _PAIRS]
    covariance = np.stack(products, axis=-1) / np.maximum(count - 1, 1)
    counted = np.concatenate([_histogram(x, good).reshape(*mean.shape[:2], -1), count], axis=-1)
    return {
        "mean": (("rgb",), mean.astype(np.float32)),
        "covariance": (("pair",), covariance.astype(np.float32)),
        "histogram": (("bin",), counted.astype(np.float32)),
    }


def _histogram(x: npt.NDArray[np.float64], good: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """Share each sample between the two bins that it lies between, shape (y, x, channel, bin)."""
    value = np.minimum(np.maximum(np.nan_to_num(x), 0) ** (1 / _GAMMA) / _LARGEST, _MOST)
    place = np.where(value < 1, value * (_BINS - 2), _BINS - 2 + (value - 1) / (_MOST - 1))
    lower = np.minimum(place.astype(np.int64), _BINS - 2)
    upper_share = place - lower
    row = np.arange(lower[..., 0].size).reshape(*lower.shape[:-1], 1) * _BINS
    weight = np.broadcast_to(good, x.shape)
    counts = np.zeros(lower[..., 0].size * _BINS)
    for bins, share in ((lower, 1 - upper_share), (lower + 1, upper_share)):
        counts += np.bincount((row + bins).ravel(), (weight * share).ravel(), counts.size)
    return counts.reshape(*lower.shape[:-1], _BINS)
