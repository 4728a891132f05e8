"""Cascades of images by brightness: what the viewer of Zirr et al. reweights fireflies with.

There is one image for each layer of brightness, the mean of the samples with the weight that they
have in it, so that all layers together are the mean image. The files are called as those of the
authors' examples, from which their viewer takes the number of samples and the order of the layers:
``NAME.SPP.regular.exr``, ``NAME.SPP.light_min8.exr``, ``NAME.SPP.light_min64.exr`` and so on.

Sources: T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly samples for improved
finite-sample Monte Carlo estimates", Computer Graphics Forum 37(6), 2018, doi:10.1111/cgf.13335;
the authors' viewer, tszirr/ic.js (rw/rw.html, rw/split.cpp).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import luminance
from chdstat._core.files import checked_target
from chdstat._core.image_scales import BASE, LAYERS, layer_weights
from chdstat.errors import InputError
from chdstat.io.exr import write_exr
from chdstat.samples import Samples, samples_of
from chdstat.samples.tiles import Mapped

__all__ = ["write_cascades"]


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
