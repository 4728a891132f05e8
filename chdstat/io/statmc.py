"""Moments as StatMC takes them: of samples that a Box-Cox transformation has made more Gaussian.

Every image is a file of its own, .pfm, called ``NAME-SPP-film``, the mean image, or
``NAME-SPP-t0-b0-WHAT`` for the radiance that arrives at the camera: ``n``, the samples of each
pixel; ``mean``, ``m2`` and ``m3``, mean and sums of squared and cubed deviations of the transformed
samples ``2 (sqrt(x) - 1)``, which is Box-Cox with lambda 1/2; ``film-mean`` and ``film-m2``, those
of the samples themselves. Files are float32, little endian, with the lowest row first.

Sources: H. Sakai, C. Freude, T. Auzinger, D. Hahn and M. Wimmer, "A statistical approach to Monte
Carlo denoising", SIGGRAPH Asia 2024, doi:10.1145/3680528.3687591; the authors' code,
cg-tuwien/StatMC (README.md, src/statistics/estimator.h, src/statistics/statpath.cpp).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.files import checked_target, writing
from chdstat._core.moments import Moments
from chdstat.errors import InputError
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import Mapped

__all__ = ["write_moments"]

_NAMES = ("film", "t0-b0-n", *(f"t0-b0-{w}" for w in ("mean", "m2", "m3", "film-mean", "film-m2")))


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
    files = tuple(target.with_stem(f"{target.stem}-{image.spp}-{name}") for name in _NAMES)
    for name, file in zip(_NAMES, files, strict=True):
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
        for name, value in zip(_NAMES, values, strict=True)
    }


def _write_pfm(path: Path, image: npt.NDArray[Any]) -> None:
    """Write an image (y, x), (y, x, 1) or (y, x, 3) as a portable float map."""
    colours = image.ndim == 3 and image.shape[2] == 3
    height, width = image.shape[:2]
    with writing(path) as partial:
        header = f"{'PF' if colours else 'Pf'}\n{width} {height}\n-1.0\n"
        partial.write_bytes(header.encode() + image[::-1].astype("<f4").tobytes())
