"""Estimates: a better image from the samples that are there, and a file of it.

`estimate` is the one call from samples to radiance: by default it trains on the very samples that
it estimates from, and needs no reference. Given a rendering in place of samples, it learns while
the batches arrive, and keeps none of them. `write_estimates` puts the image in an EXR file, with
the certainty, the interval and the mean beside it. `chdstat.estimators` has the parts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from chdstat import __version__
from chdstat._core.arrays import Seed, seed_number
from chdstat._core.executor import check_memory
from chdstat._core.files import checked_target
from chdstat.errors import InputError
from chdstat.estimators.denoising import check_denoiser, through_denoiser
from chdstat.estimators.models import AnyModel, first_samples, load_model, train_model
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.progressive import Estimates, Progressive, Stream
from chdstat.estimators.progressive.inputs import Input
from chdstat.estimators.progressive.stream import follow
from chdstat.estimators.validation import direct_of
from chdstat.io import write_exr
from chdstat.samples import Image, Samples, samples_of

if TYPE_CHECKING:
    from chdstat.rendering.live import Rendering

__all__ = ["estimate", "write_estimates"]

_COPIES = 1.6
"""Memory that an estimate takes, over that of its samples (measured: 1.55)."""
_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""


def estimate(
    samples: Image | Rendering | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    balance: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    seed: Seed = 0,
    iterations: int | None = None,
    progress: bool | None = None,
) -> Estimates:
    """Estimate the radiance of every pixel.

    Without a model, `Progressive` is trained on these very samples, without a reference, and looks
    at first-hit features where there are any and at the pixels around (not while rendering, since
    that needs the samples).

    Parameters
    ----------
    samples
        The image, as `Samples`, an array (y, x, channel, sample) or the path of a store; or a
        rendering, as `chdstat.rendering.render_batches` makes it: then nothing is kept of its
        batches but what the estimate needs, in memory that does not grow with `spp`.
    model
        A trained estimator, or the file that one was saved to; None trains one. One of another
        scene is followed as far as it pays, which is measured on these samples.
    spp
        Use the first so many samples; None uses all.
    balance
        0 for the least MSE, 1 for the least relMSE, and what lies between. It matters little
        without a reference, and not to networks with one answer.
    level
        Probability of the interval.
    denoise
        Put the image through Open Image Denoise, with first-hit features where there are any.
        Certainty and interval remain those of the estimate before it.
    seed, iterations
        Of the training, as for `chdstat.estimators.models.train_model`; no iterations with a model.
    progress
        Show progress bars; None shows them on a terminal. A rendering shows its own.

    Returns
    -------
    Estimates
        Shape (y, x, channel), in the unit of the samples. `MLP` says neither certainty nor
        interval: these are NaN.

    Raises
    ------
    InputError
        If the samples are too few, or more than the memory of this machine holds, the model does
        not fit them, an option is out of range, or Open Image Denoise is wanted and missing.
    StoreError
        If the model cannot be read.

    References
    ----------
    J. Lehtinen et al., "Noise2Noise: learning image restoration without clean data", ICML 2018.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> found = estimate(image, iterations=5, progress=False)
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
    path: str | Path,
    samples: Image | Rendering | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    **options: Any,
) -> Path:
    """Estimate the radiance of every pixel and write it to an EXR file.

    The image is the estimate. The layers are ``certainty``, ``low``, ``high`` and ``mean``, and
    ``estimate`` where the image was denoised after it. The header says where all this comes from.

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
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> with TemporaryDirectory() as folder:
    ...     file = write_estimates(f"{folder}/a.exr", image, iterations=5, progress=False)
    ...     sorted(chd.io.read_exr(file).extra)
    ['certainty', 'high', 'low', 'mean']
    """
    target = checked_target(path, ".exr")
    found = _improve(samples, model, **options)
    count = found.mean.shape[-1]
    return write_exr(
        target,
        found.final.radiance,
        channels=None if count in _USUAL_CHANNELS else found.channels,
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
    channels
        Names of the channels.
    """

    first: Estimates
    final: Estimates
    mean: npt.NDArray[np.float32]
    provenance: Mapping[str, Any]
    channels: tuple[str, ...]

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
    samples: Image | Rendering | npt.ArrayLike,
    model: AnyModel | str | Path | None,
    *,
    spp: int | None = None,
    balance: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    seed: Seed = 0,
    iterations: int | None = None,
    progress: bool | None = None,
) -> _Improved:
    _check_options(balance, level)
    if model is not None and iterations is not None:
        message = f"iterations={iterations} is for training; with a model, nothing is trained"
        raise InputError(message)
    own = load_model(model) if isinstance(model, str | Path) else model
    asked: dict[str, float] = {"balance": balance, "level": level}
    training: dict[str, Any] = {"seed": seed_number(seed), "iterations": iterations}
    if not hasattr(samples, "batch"):  # a rendering has it; its class would need Mitsuba here
        samples = samples_of(samples)
    samples = cast("Samples | Rendering", samples)
    if isinstance(samples, Samples):
        samples = first_samples(samples, spp)
        if denoise:
            check_denoiser(samples)  # refused before the training, not after
        start = _of_samples(samples, own, asked, training | {"progress": progress})
    else:
        start = _of_rendering(samples, _checked_model(samples, own, spp, denoise), asked, training)
    final = start.found
    if denoise:
        final = replace(final, radiance=through_denoiser(final.radiance, samples.features))
    provenance = {
        "software": f"chdstat {__version__}",
        "scene": samples.name,
        "spp": samples.spp,
        "estimator": start.model.name,
        "training": start.training if model is None else "before",
        "balance": balance if isinstance(start.model, Progressive) else "none",
        "level": "none" if np.isnan(final.level) else final.level,
        "denoiser": "Open Image Denoise" if denoise else "none",
        "samples": samples.attrs,
        "model": start.told,
    }
    return _Improved(
        start.found, final, start.mean.astype(np.float32), provenance, samples.channels
    )


@dataclass(frozen=True)
class _Start:
    """An estimate before the denoiser, with what gave it.

    Attributes
    ----------
    model, told, training
        The estimator, its provenance, and what it was trained on where it was trained here.
    found
        The estimate.
    mean
        Of the same samples, shape (y, x, channel).
    """

    model: AnyModel
    told: Mapping[str, Any]
    training: str
    found: Estimates
    mean: npt.NDArray[np.floating[Any]]


def _of_samples(
    samples: Samples, model: AnyModel | None, asked: Mapping[str, float], training: dict[str, Any]
) -> _Start:
    own = model
    check_memory(
        _COPIES * samples.nbytes,
        f"the {samples.spp} spp of an estimate and what it computes of them",
        "use fewer, by spp or --spp, or estimate from render_batches or with --while-rendering",
    )
    if own is None:
        seen: tuple[Input, ...] = ("features",) if samples.features else ()
        own = train_model(samples, inputs=seen, reference=False, **training)
    image = samples.read()
    direct = (
        direct_of(samples).read() if isinstance(own, Progressive) and own.inputs.direct else None
    )
    known = model is None or (isinstance(own, Progressive) and own.trained_on(samples.attrs))
    trust = 1.0 if known else None
    found = _ask(own, image, samples.features, direct, trust=trust, **asked)
    where = "on these samples, without a reference"
    return _Start(own, own.provenance, where, found, mean_of_good(image))


def _of_rendering(
    rendering: Rendering,
    model: Progressive | None,
    asked: Mapping[str, float],
    training: Mapping[str, Any],
) -> _Start:
    own = Progressive(inputs=["features"]) if model is None else model
    stream = Stream(
        own,
        features=rendering.features if own.inputs.features else None,
        learns=model is None,
        seed=training["seed"],
        attrs=rendering.attrs,
    )
    if model is None:
        follow(stream, rendering, spp=rendering.spp, iterations=training["iterations"])
    else:
        for batch in rendering:
            stream.update(batch)
    found, where = stream.estimate(**asked), "while rendering, without a reference"
    # Where no sample varied nothing was learned.
    told = stream.model.provenance if model is not None or stream.iterations else {}
    return _Start(stream.model, told, where, found, stream.mean())


def _checked_model(
    rendering: Rendering, model: AnyModel | None, spp: int | None, denoise: bool
) -> Progressive | None:
    """Return the model; what could not be estimated after the rendering is refused before it."""
    channels = rendering.shape[2]
    if spp not in (None, rendering.spp):
        message = f"spp of a rendering is set where it is made: {rendering.spp}, got {spp} here"
        raise InputError(message)
    if denoise:
        check_denoiser(Samples.from_array(np.zeros((1, 1, channels, 1)), axes="yxcs"))
    if model is None:
        return None
    if not isinstance(model, Progressive) or model.inputs.neighbours or model.inputs.direct:
        message = (
            "while rendering, a model must be 'progressive' and look at no neighbours, since no "
            f"samples are kept, nor at direct light, which is rendered apart; got {model!r}"
        )
        raise InputError(message)
    if model.channels != channels:
        message = f"the model takes {model.channels} channels, got a rendering of {channels}"
        raise InputError(message)
    return model


def _check_options(balance: float, level: float) -> None:
    if not 0 <= balance <= 1:
        message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
        raise InputError(message)
    if not 0 < level < 1:
        message = f"level must lie between 0 and 1, got {level}"
        raise InputError(message)


def _ask(
    model: AnyModel,
    image: npt.NDArray[np.float32],
    features: Mapping[str, npt.NDArray[Any]],
    direct: npt.NDArray[Any] | None,
    *,
    balance: float,
    level: float,
    trust: float | None,
) -> Estimates:
    if isinstance(model, Progressive):
        return model.estimate(
            image,
            features=features if model.inputs.features else None,
            direct=direct,
            balance=balance,
            level=level,
            trust=trust,
        )
    radiance = model.predict(image)
    unknown = np.full_like(radiance, np.nan)
    return Estimates(radiance, unknown[..., 0], unknown, unknown, np.nan)
