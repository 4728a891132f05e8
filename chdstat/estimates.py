"""Estimates: a better picture from the samples that are there, and a file of it.

`estimate` is the one call from samples to radiance: by default it trains on the very samples that
it estimates from, and needs no reference. `write_estimates` puts the picture in an EXR file, with
the certainty, the interval and the mean beside it. `chdstat.estimators` has the parts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._targets import checked_target
from chdstat.comparison.denoising import check_denoiser, through_denoiser
from chdstat.errors import InputError
from chdstat.estimators import Estimates, Progressive
from chdstat.estimators.classical import mean_of_good
from chdstat.io import write_exr
from chdstat.models import AnyModel, first_samples, load_model, train_model
from chdstat.samples import Samples

__all__ = ["estimate", "write_estimates"]

_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""


def estimate(
    samples: Samples,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    balance: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    seed: int = 0,
    iterations: int | None = None,
    progress: bool | None = None,
) -> Estimates:
    """Estimate the radiance of every pixel.

    Without a model, `Progressive` is trained on these very samples, without a reference, and looks
    at first-hit features where there are any and at the pixels around.

    Parameters
    ----------
    samples
        The picture.
    model
        A trained estimator, or the file that one was saved to; None trains one.
    spp
        Use the first so many samples; None uses all.
    balance
        0 for the least MSE, 1 for the least relMSE, and what lies between. It matters little
        without a reference, and not to networks with one answer.
    level
        Probability of the interval.
    denoise
        Put the picture through Open Image Denoise, with first-hit features where there are any.
        Certainty and interval remain those of the estimate before it.
    seed, iterations
        Of the training, as for `chdstat.models.train_model`.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Estimates
        Shape (y, x, channel), in the unit of the samples. `MLP` says neither certainty nor
        interval: these are NaN.

    Raises
    ------
    InputError
        If the samples are too few, the model does not fit them, an option is out of range, or Open
        Image Denoise is wanted and missing.
    StoreError
        If the model cannot be read.

    References
    ----------
    J. Lehtinen et al., "Noise2Noise: learning image restoration without clean data", ICML 2018.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> picture = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> found = estimate(picture, iterations=5, progress=False)
    >>> found.radiance.shape, found.certainty.shape
    ((16, 16, 3), (16, 16))
    """
    return _improve(
        samples,
        model,
        spp=spp,
        balance=balance,
        level=level,
        denoise=denoise,
        seed=seed,
        iterations=iterations,
        progress=progress,
    ).final


def write_estimates(
    path: str | Path, samples: Samples, model: AnyModel | str | Path | None = None, **options: Any
) -> Path:
    """Estimate the radiance of every pixel and write it to an EXR file.

    The picture is the estimate. The layers are ``certainty``, ``low``, ``high`` and ``mean``, and
    ``estimate`` where the picture was denoised after it. The header says where all this comes from.

    Parameters
    ----------
    path
        The file, ending in .exr; one that is there already is replaced at the end.
    samples, model, **options
        As for `estimate`.

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
    >>> picture = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> with TemporaryDirectory() as folder:
    ...     file = write_estimates(f"{folder}/a.exr", picture, iterations=5, progress=False)
    ...     sorted(chd.io.read_exr(file).extra)
    ['certainty', 'high', 'low', 'mean']
    """
    target = checked_target(path, ".exr")
    found = _improve(samples, model, **options)
    count = found.mean.shape[-1]
    return write_exr(
        target,
        found.final.radiance,
        channels=None if count in _USUAL_CHANNELS else samples.channels,
        extra=found.layers(),
        attributes=found.header(),
    )


@dataclass(frozen=True)
class _Improved:
    """An estimate with all that a file of it says.

    Attributes
    ----------
    first, final
        Before the denoiser, and after it where there is one.
    mean
        Of the same samples, shape (y, x, channel).
    provenance
        By the names of the header's attributes.
    """

    first: Estimates
    final: Estimates
    mean: npt.NDArray[np.float32]
    provenance: Mapping[str, Any]

    def layers(self) -> dict[str, npt.NDArray[Any]]:
        found: dict[str, npt.NDArray[Any]] = {"mean": self.mean}
        if not np.isnan(self.final.level):
            known = self.final
            found |= {"certainty": known.certainty, "low": known.low, "high": known.high}
        if self.final is not self.first:
            found["estimate"] = self.first.radiance
        return found

    def header(self) -> dict[str, str]:
        return {
            name: value if isinstance(value, str) else json.dumps(value, default=str)
            for name, value in self.provenance.items()
        }


def _improve(
    samples: Samples,
    model: AnyModel | str | Path | None,
    *,
    spp: int | None = None,
    balance: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    seed: int = 0,
    iterations: int | None = None,
    progress: bool | None = None,
) -> _Improved:
    _check_options(balance, level)
    used = first_samples(samples, spp)
    if denoise:
        check_denoiser(used)  # refused before the training, not after
    own = load_model(model) if isinstance(model, str | Path) else model
    if own is None:
        own = train_model(
            used,
            features=bool(used.features),
            reference=False,
            seed=seed,
            iterations=iterations,
            progress=progress,
        )
    picture = used.read()
    first = _ask(own, picture, used.features, balance, level)
    final = first
    if denoise:
        final = replace(first, radiance=through_denoiser(first.radiance, used.features))
    provenance = {
        "software": f"chdstat {chdstat.__version__}",
        "scene": used.name,
        "spp": used.spp,
        "estimator": own.name,
        "training": "on these samples, without a reference" if model is None else "before",
        "balance": balance,
        "level": "none" if np.isnan(first.level) else first.level,
        "denoiser": "Open Image Denoise" if denoise else "none",
        "samples": used.attrs,
        "model": own.provenance,
    }
    return _Improved(
        first=first,
        final=final,
        mean=mean_of_good(picture).astype(np.float32),
        provenance=provenance,
    )


def _check_options(balance: float, level: float) -> None:
    if not 0 <= balance <= 1:
        message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
        raise InputError(message)
    if not 0 < level < 1:
        message = f"level must lie between 0 and 1, got {level}"
        raise InputError(message)


def _ask(
    model: AnyModel,
    picture: npt.NDArray[np.float32],
    features: Mapping[str, npt.NDArray[Any]],
    balance: float,
    level: float,
) -> Estimates:
    if isinstance(model, Progressive):
        given = features if model.features else None
        return model.estimate(picture, features=given, balance=balance, level=level)
    radiance = model.predict(picture)
    unknown = np.full_like(radiance, np.nan)
    return Estimates(radiance, unknown[..., 0], unknown, unknown, np.nan)
