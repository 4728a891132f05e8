"""Files of estimates: the estimate of an image, with its certainty, interval and mean as layers."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import __version__
from chdstat._core.files import checked_target
from chdstat.errors import InputError
from chdstat.estimators.estimates import (
    AnyModel,
    Combination,
    Estimated,
    EstimateOptions,
    estimates_of,
)
from chdstat.estimators.registry import check_positive
from chdstat.io.writing import IMAGES, write_image
from chdstat.samples import ImageLike
from chdstat.samples.samples import SampleStream

if TYPE_CHECKING:
    from distributed import Client

_log = logging.getLogger("chdstat")
_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""


def write_estimates(
    path: str | Path,
    samples: ImageLike | SampleStream | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    level: float = 0.9,
    denoise: bool = False,
    progress: bool | None = None,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
    seconds: float | None = None,
    relative_error: float | None = None,
) -> Path:
    """Estimate the radiance of every pixel and write it to a file: .exr, .npy, .pfm or .png.

    The image is the estimate; a PNG file is tone-mapped. An EXR file has the further layers
    ``certainty``, ``low``, ``high`` and ``mean``. Without a model it also has the ``weight`` of
    each candidate, and with `denoise` the ``estimate`` before denoising. Its header records the
    scene, the samples and the options.

    Parameters
    ----------
    path
        The file, as for `chdstat.io.write_image`. An existing file is replaced at the end; for a
        rendering, it is replaced at each doubling of the number of samples.
    samples, model, spp, level, denoise, progress, client, checkpoint
        As for `estimate`.
    seconds, relative_error
        Stop a rendering after so many seconds, or as soon as the estimated relative error of the
        image (`Combination.relative_error`) is at most this, and at most a tenth larger in nine of
        ten images. Each pass logs the error and the samples that the wanted one takes, or half of
        the present one.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    InputError, StoreError
        As for `estimate`; or if the file cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> with TemporaryDirectory() as folder:
    ...     file = write_estimates(f"{folder}/a.exr", image, progress=False)
    ...     sorted(chd.io.read_exr(file).extra)[:4]
    ['certainty', 'high', 'low', 'mean']
    """
    target = checked_target(path, *IMAGES)
    options = EstimateOptions(spp, level, denoise, progress, client, checkpoint)
    if relative_error is not None:
        check_positive(relative_error=relative_error)
    rendered, begin = hasattr(samples, "batch"), time.monotonic()
    if not rendered and (seconds, relative_error) != (None, None):
        message = "seconds and relative_error stop a rendering; these samples are there already"
        raise InputError(message)
    reached = relative_error is None
    for image in estimates_of(samples, model, options, seconds, relative_error):
        write_image(
            target,
            image.final.radiance,
            channels=None if image.mean.shape[-1] in _USUAL_CHANNELS else image.source.channels,
            extra=_layers(image),
            attributes=_header(image),
        )
        if rendered and isinstance(image.found, Combination):
            error, spent = image.found.error, time.monotonic() - begin
            _log.info("%d spp: %s", image.found.spp, error.told(relative_error, spent))
            reached = relative_error is None or error.reaches(relative_error)
    if not reached and seconds is None:
        _log.warning("the relative error of %g was not reached in all samples", relative_error)
    return target


def _layers(image: Estimated) -> dict[str, npt.NDArray[Any]]:
    layers: dict[str, npt.NDArray[Any]] = {"mean": image.mean}
    if not np.isnan(image.found.level):
        layers |= {name: getattr(image.found, name) for name in ("certainty", "low", "high")}
    if isinstance(image.found, Combination):
        weights = image.found.weights.items()
        layers |= {f"weight_{name.replace(' ', '_')}": image for name, image in weights}
    return layers | ({"estimate": image.found.radiance} if image.options.denoise else {})


def _header(image: Estimated) -> dict[str, str]:
    found, model = image.found, image.model
    training, known = "before", {} if model is None else model.provenance
    if isinstance(found, Combination):
        training = "before, on built-in scenes with references"
        known = {"bias": found.bias, "bias_error": found.bias_error}
    about = {
        "software": f"chdstat {__version__}",
        "scene": image.source.name,
        "spp": getattr(found, "spp", image.source.spp),
        "estimator": "combination" if model is None else model.name,
        "training": training,
        "level": "none" if np.isnan(found.level) else found.level,
        "denoiser": "Open Image Denoise" if image.options.denoise else "none",
        "samples": image.source.attrs,
        "model": known,
    }
    return {k: v if isinstance(v, str) else json.dumps(v, default=str) for k, v in about.items()}
