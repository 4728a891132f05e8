"""What denoisers of others start from: files of BCD, cascades by brightness, moments of StatMC.

A file of raw samples of Bayesian collaborative denoising has a header of five int32, version,
width, height, samples of each pixel and channels, of which there are 3 or 4; then the samples as
float32, pixel by pixel, row by row, the channels of a sample together. The fourth channel is alpha,
and left out. `write_bcd` writes what the denoiser takes: the mean image, the covariance of the
mean's samples as channels Bin_0000 to Bin_0005 (xx, yy, zz, yz, xz, xy), and histograms of 20 bins
for each of R, G and B as Bin_0000 to Bin_0059, with the number of samples as Bin_0060.

Cascades are one image for each layer of brightness, the mean of the samples with the weight that
they have in it, so that all layers together are the mean image. The files are called as those of
the authors' examples, from which their viewer takes the number of samples and the order of the
layers: ``NAME.SPP.regular.exr``, ``NAME.SPP.light_min8.exr``, ``NAME.SPP.light_min64.exr``...

StatMC denoises with moments of samples that a Box-Cox transformation has made more Gaussian. Every
image is a file of its own, .pfm, called ``NAME-SPP-film``, the mean image, or
``NAME-SPP-t0-b0-WHAT`` for the radiance that arrives at the camera: ``n``, the samples of each
pixel; ``mean``, ``m2`` and ``m3``, mean and sums of squared and cubed deviations of the transformed
samples ``2 (sqrt(x) - 1)``, which is Box-Cox with lambda 1/2; ``film-mean`` and ``film-m2``, those
of the samples themselves. Files are float32, little endian, with the lowest row first.

Sources: M. Boughida and T. Boubekeur, "Bayesian collaborative denoising for Monte Carlo rendering",
Computer Graphics Forum 36(4), 2017, doi:10.1111/cgf.13231; its code, superboubek/bcd
(src/raw_converter/main.cpp, src/core/SamplesAccumulator.cpp, src/Common/exr/io_exr.cpp). T. Zirr,
J. Hanika and C. Dachsbacher, "Re-weighting firefly samples for improved finite-sample Monte Carlo
estimates", Computer Graphics Forum 37(6), 2018, doi:10.1111/cgf.13335; the authors' viewer,
tszirr/ic.js (rw/rw.html, rw/split.cpp). H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer,
"A statistical approach to Monte Carlo denoising", SIGGRAPH Asia 2024, doi:10.1145/3680528.3687591;
the authors' code, cg-tuwien/StatMC (README.md, src/statistics/estimator.h,
src/statistics/statpath.cpp).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import luminance
from chdstat._core.files import checked_target, writing
from chdstat._core.image_scales import BASE, LAYERS, layer_weights
from chdstat._core.moments import Moments
from chdstat.errors import InputError, StoreError
from chdstat.io.arrays import ArraySource, Remapped, joined
from chdstat.io.exr import write_exr
from chdstat.io.reading import Opened, ReadOptions
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import Mapped

__all__ = ["open_bcd", "write_bcd", "write_cascades", "write_moments"]

_HEADER = 5 * 4
_BINS, _GAMMA, _LARGEST, _MOST = 20, 2.2, 2.5, 2.0
"""Bins of each channel; ``x^(1 / gamma) / largest`` fills the first 18 up to 1, and the last two
beyond, up to the most (src/raw_converter/main.cpp, src/core/SamplesAccumulator.cpp)."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Order of covariances (src/core/CovarianceMatrix.h)."""


def open_bcd(paths: Sequence[Path], _: ReadOptions) -> Opened:
    """Open files of raw samples, which follow each other."""
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


# --- cascades -----------------------------------------------------------------------------------


def write_cascades(
    samples: Samples | npt.ArrayLike,
    path: str | Path,
    *,
    start: float = 1.0,
    progress: bool | None = None,
) -> tuple[Path, ...]:
    """Write one image for each of six layers of brightness, as `chdstat.estimators.Cascade` has.

    A sample that is bad in one channel is left out in all.

    Parameters
    ----------
    samples
        `Samples`, an array (y, x, channel, sample), or the path of a store; of 1 or 3 channels.
    path
        Name of the files, .exr, into which the number of samples and the layer are put.
    start
        Luminance of the lowest layer, larger than 0; each other is of 8 times the one below.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    tuple of pathlib.Path
        The files, the lowest layer first.

    Raises
    ------
    InputError
        If these are no single samples of 1 or 3 channels, or `start` is not positive.
    StoreError
        If a file cannot be written.

    References
    ----------
    T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly samples for improved finite-sample
    Monte Carlo estimates", Computer Graphics Forum 37(6), 2018, doi:10.1111/cgf.13335.

    Examples
    --------
    >>> import tempfile
    >>> x = np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 32))
    >>> files = write_cascades(x, Path(tempfile.mkdtemp()) / "kitchen.exr")
    >>> [file.name for file in files[:2]]
    ['kitchen.32.regular.exr', 'kitchen.32.light_min8.exr']
    """
    image, target = samples_of(samples), checked_target(path, ".exr")
    if not (np.isfinite(start) and start > 0):
        message = f"start must be a luminance larger than 0, got {start!r}"
        raise InputError(message)

    def layers(block: npt.NDArray[np.float32]) -> Mapped:
        good = np.isfinite(block).all(axis=2, keepdims=True)
        kept = np.where(good, block, 0).astype(np.float64)
        split = kept @ layer_weights(luminance(kept) / start)
        split /= np.maximum(good.sum(axis=-1), 1)[..., np.newaxis]
        return {"layers": (("channel", "layer"), split.astype(np.float32))}

    found = image.map(layers, description="writing", progress=progress)["layers"].to_numpy()
    names = ["regular", *(f"light_min{start * BASE**i:g}" for i in range(1, LAYERS))]
    files = tuple(target.with_stem(f"{target.stem}.{image.spp}.{name}") for name in names)
    for index, file in enumerate(files):
        write_exr(file, found[..., index])
    return files


# --- moments of StatMC --------------------------------------------------------------------------

_MOMENTS = (
    "film",
    "t0-b0-n",
    *(f"t0-b0-{w}" for w in ("mean", "m2", "m3", "film-mean", "film-m2")),
)


def write_moments(
    samples: Samples | npt.ArrayLike, path: str | Path, *, progress: bool | None = None
) -> tuple[Path, ...]:
    """Write the moments of samples that StatMC denoises with, as .pfm files.

    A sample that is bad in one channel is left out in all.

    Parameters
    ----------
    samples
        `Samples`, an array (y, x, channel, sample), or the path of a store; of 1 or 3 channels.
    path
        Name of the files, .pfm, into which the number of samples and the moment are put.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    tuple of pathlib.Path
        The files: mean image, number of samples, mean, m2 and m3 of transformed samples, mean and
        m2 of samples.

    Raises
    ------
    InputError
        If these are no single samples of 1 or 3 channels, or one is negative, which has no square
        root.
    StoreError
        If a file cannot be written.

    References
    ----------
    H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer, "A statistical approach to Monte Carlo
    denoising", SIGGRAPH Asia 2024, doi:10.1145/3680528.3687591.

    Examples
    --------
    >>> import tempfile
    >>> x = np.random.default_rng(0).gamma(2.0, size=(4, 6, 3, 32))
    >>> files = write_moments(x, Path(tempfile.mkdtemp()) / "kitchen.pfm")
    >>> [file.name for file in files[:3]]
    ['kitchen-32-film.pfm', 'kitchen-32-t0-b0-n.pfm', 'kitchen-32-t0-b0-mean.pfm']
    """
    image, target = samples_of(samples), checked_target(path, ".pfm")
    if image.shape[2] not in (1, 3):
        message = f"StatMC takes images of 1 or 3 channels, got {image.shape[2]}"
        raise InputError(message)
    found = image.map(_moments, description="writing", progress=progress)
    files = tuple(target.with_stem(f"{target.stem}-{image.spp}-{name}") for name in _MOMENTS)
    for name, file in zip(_MOMENTS, files, strict=True):
        _write_pfm(file, found[name].to_numpy())
    return files


def _moments(block: npt.NDArray[np.float32]) -> Mapped:
    good = np.asarray(np.isfinite(block).all(axis=2, keepdims=True))
    kept = np.where(good, block, 0)
    if (kept < 0).any():
        message = (
            "StatMC takes square roots of samples, and there are negative ones, such as "
            f"{kept.min():.6g}; BCD and cascades take them"
        )
        raise InputError(message)
    plain = Moments.of(kept, good)
    transformed = Moments.of(2 * (np.sqrt(kept.astype(np.float64)) - 1), good)
    count = good.sum(axis=-1)[..., 0]
    values = (
        plain.mean,
        count,
        transformed.mean,
        transformed.m2,
        transformed.m3,
        plain.mean,
        plain.m2,
    )
    return {
        name: (("channel",) * (value.ndim - 2), value.astype(np.float32))
        for name, value in zip(_MOMENTS, values, strict=True)
    }


def _write_pfm(path: Path, image: npt.NDArray[Any]) -> None:
    """Write an image (y, x), (y, x, 1) or (y, x, 3) as a portable float map."""
    colours = image.ndim == 3 and image.shape[2] == 3
    height, width = image.shape[:2]
    with writing(path) as partial:
        header = f"{'PF' if colours else 'Pf'}\n{width} {height}\n-1.0\n"
        partial.write_bytes(header.encode() + image[::-1].astype("<f4").tobytes())
