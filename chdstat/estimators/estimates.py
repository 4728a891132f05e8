"""Estimates: a better image from the samples that are there, and a file of it.

`estimate` is the one call from samples to radiance. It combines the mean, an outlier-free mean and
denoised images of both by their errors on held-out samples, without a reference, or lets a model
estimate that was trained before. Nothing is trained. `write_estimates` puts the image in an EXR
file, with the certainty, the interval and the mean beside it. `chdstat.estimators` has the parts.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat import __version__
from chdstat._core.files import checked_target
from chdstat._core.work import check_memory
from chdstat.errors import InputError
from chdstat.estimators.combining import LEAST, Combination, CombinationStream, combine
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.registry import (
    Estimates,
    check_positive,
    check_probability,
    mean_of_good,
)
from chdstat.estimators.training import TrainedModel, first_samples, load_model
from chdstat.io import denoise, write_image
from chdstat.io.writing import IMAGES
from chdstat.samples import ImageLike, Samples, check_equal_counts
from chdstat.samples.dependence import check_independent

if TYPE_CHECKING:
    from distributed import Client

    from chdstat.rendering import Rendering

__all__ = ["check_denoiser", "estimate", "refine", "through_denoiser", "write_estimates"]

_log = logging.getLogger("chdstat")

AnyModel = TrainedModel[Any]
_FIRST = 16
"""Samples of a pixel of the first estimate while rendering."""
_COPIES = 2.2
"""Memory that an estimate by a model takes, over that of its samples (measured)."""
_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""


def estimate(
    samples: ImageLike | Rendering | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    loss_weight: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    progress: bool | None = None,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
) -> Estimates:
    """Estimate the radiance of every pixel.

    Without a model, `chdstat.estimators.combine` weights candidates, which takes less time than
    rendering the samples did.

    Parameters
    ----------
    samples
        The image, as `Samples`, an array (y, x, channel, sample) or the path of a store; or a
        rendering, as `chdstat.rendering.render_batches` makes it: then nothing is kept of its
        batches but what the estimate needs, in memory that does not grow with `spp`. A model
        takes samples only.
    model
        A trained estimator, or the file that one was saved to; None combines candidates. A
        `Progressive` of another scene warns, and is mixed with the mean.
    spp
        Use the first so many samples; None uses all.
    loss_weight
        Of a `Progressive`: 0 for the least MSE, 1 for the least relMSE, and what lies between.
    level
        Probability of the interval.
    denoise
        Put the image through Open Image Denoise, with first-hit features where there are any.
        Certainty and interval remain those of the estimate before it. Where candidates are
        combined, a pixel is denoised once more only as far as its weights are those of denoised
        images, and stays within the interval of its mean.
    progress
        Show progress bars; None shows them on a terminal. A rendering shows its own.
    client, checkpoint
        Where candidates are combined, as for `chdstat.analyze`: a Dask client whose workers do the
        work, and a folder that keeps what is done, so that the same call goes on after a stop.

    Returns
    -------
    Estimates
        Shape (y, x, channel), in the unit of the samples; a `Combination` with the weight of each
        candidate, where candidates were combined. `MLP` says neither certainty nor interval: these
        are NaN.

    Raises
    ------
    InputError
        If the samples are too few, or more than the memory of this machine holds, the model does
        not fit them, an option is out of range, or Open Image Denoise is wanted and cannot be
        loaded.
    StoreError
        If the model cannot be read.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> image = chd.Samples.from_array(rng.exponential(size=(16, 16, 3, 16)))
    >>> found = estimate(image, progress=False)
    >>> found.radiance.shape, found.certainty.shape
    ((16, 16, 3), (16, 16))
    """
    options = _Options(spp, loss_weight, level, denoise, progress, client, checkpoint)
    return _last(_Estimated.refined(samples, model, options)).final


def refine(
    rendering: Rendering, *, level: float = 0.9, seconds: float | None = None
) -> Iterator[Combination]:
    """Estimate while a scene renders: at 16 samples of a pixel, and whenever they have doubled.

    Parameters
    ----------
    rendering
        As `chdstat.rendering.render_batches` makes it. Of its samples only sums are kept, in memory
        that does not grow with their number.
    level
        Probability of the intervals.
    seconds
        Stop after the pass that ends later than that; None renders all.

    Yields
    ------
    Combination
        What `chdstat.estimate` returns of the samples until now. The last one is, to the bit, that
        of a store of the same samples.

    Raises
    ------
    InputError
        If an option is out of range, or the samples are less than 4.

    Examples
    --------
    Stop where the image is known to 40 %:

    >>> from chdstat.rendering import render_batches
    >>> rendering = render_batches("cornell-box", spp=1024, size=(16, 16), progress=False)
    >>> for found in refine(rendering):
    ...     if found.relative_error < 0.4:
    ...         break
    >>> found.spp < 1024
    True
    """
    check_probability(level=level)
    if seconds is not None:
        check_positive(seconds=seconds)
    if rendering.spp < LEAST:
        message = f"expected at least {LEAST} samples of a pixel, got {rendering.spp}"
        raise InputError(message)
    y, x, channels, _ = rendering.shape
    stream, due, begin = CombinationStream((y, x, channels)), _FIRST, time.monotonic()
    for chunks in rendering.passes():
        for chunk, samples in chunks:
            stream.update(samples, rows=chunk.ys, columns=chunk.xs)
        late = seconds is not None and time.monotonic() - begin >= seconds
        enough = stream.spp >= LEAST
        if enough and (late or stream.spp >= min(due, rendering.spp)):
            yield stream.estimate(features=rendering.features, level=level)
            due = 2 * stream.spp
            if late:
                return


def write_estimates(
    path: str | Path,
    samples: ImageLike | Rendering | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    loss_weight: float = 0.5,
    level: float = 0.9,
    denoise: bool = False,
    progress: bool | None = None,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
    seconds: float | None = None,
    relative_error: float | None = None,
) -> Path:
    """Estimate the radiance of every pixel and write it to a file: .exr, .npy, .pfm or .png.

    The image is the estimate; a PNG file is tone-mapped. The layers of an EXR file
    are ``certainty``, ``low``, ``high`` and ``mean``, the ``weight`` of each candidate where
    candidates were combined, and ``estimate`` where the image was denoised after it. Its header
    says where all this comes from.

    Parameters
    ----------
    path
        The file, as for `chdstat.io.write_image`; one that is there already is replaced at the
        end. That of a rendering is replaced whenever the number of samples has doubled.
    samples, model, spp, loss_weight, level, denoise, progress, client, checkpoint
        As for `estimate`.
    seconds, relative_error
        Stop a rendering after so many seconds, or where the estimated error of the image, over its
        mean, is not larger.

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
    options = _Options(spp, loss_weight, level, denoise, progress, client, checkpoint)
    if relative_error is not None:
        check_positive(relative_error=relative_error)
    if not hasattr(samples, "batch") and (seconds, relative_error) != (None, None):
        message = "seconds and relative_error stop a rendering; these samples are there already"
        raise InputError(message)
    for image in _Estimated.refined(samples, model, options, seconds):
        write_image(
            target,
            image.final.radiance,
            channels=None if image.mean.shape[-1] in _USUAL_CHANNELS else image.source.channels,
            extra=image.layers(),
            attributes=image.header(),
        )
        found = image.first
        if relative_error is not None and isinstance(found, Combination):
            _log.info("%d spp: relative error %.3g", found.spp, found.relative_error)
            if found.relative_error <= relative_error:
                break
    return target


def _last(images: Iterator[_Estimated]) -> _Estimated:
    """Return the last of some images."""
    *_, image = images
    return image


@dataclass(frozen=True)
class _Options:
    """Options of `estimate`."""

    spp: int | None
    loss_weight: float
    level: float
    denoise: bool
    progress: bool | None
    client: Client | None
    checkpoint: str | Path | None


@dataclass(frozen=True)
class _Estimated:
    """An estimate with all that a file of it holds.

    Attributes
    ----------
    source, options
        The samples or the rendering, and how they were estimated from.
    model, about, training
        The estimator, None for a combination, its provenance, and what it was trained on.
    first
        Before the denoiser.
    mean
        Of the same samples, shape (y, x, channel).
    """

    source: Samples | Rendering
    options: _Options
    model: AnyModel | None
    about: Mapping[str, Any]
    training: str
    first: Estimates
    mean: npt.NDArray[np.float32]

    @classmethod
    def refined(
        cls,
        source: Any,
        model: AnyModel | str | Path | None,
        options: _Options,
        seconds: float | None = None,
    ) -> Iterator[_Estimated]:
        """Yield the estimate; of a rendering, one after another, of more and more samples."""
        if not 0 <= options.loss_weight <= 1:
            message = (
                f"loss_weight must lie between 0 (MSE) and 1 (relMSE), got {options.loss_weight}"
            )
            raise InputError(message)
        check_probability(level=options.level)
        own = load_model(model) if isinstance(model, str | Path) else model
        # A rendering has batches; to test for its class would load Mitsuba here.
        if hasattr(source, "batch"):
            cls._check_rendering(source, own, options)
            for found in refine(source, level=options.level, seconds=seconds):
                yield cls._combined(source, options, found)
            return
        samples = first_samples(source, options.spp)
        if options.denoise:
            check_denoiser(samples.shape[2])  # refused before the work, not after
        if own is not None:
            check_equal_counts(samples, "a trained estimator reads all pixels alike")
            yield cls._by(own, samples, options)
            return
        found = combine(
            samples,
            level=options.level,
            progress=options.progress,
            client=options.client,
            checkpoint=options.checkpoint,
        )
        yield cls._combined(samples, options, found)

    @classmethod
    def _combined(cls, source: Any, options: _Options, found: Combination) -> _Estimated:
        about = {"bias": found.bias, "bias_error": found.bias_error}
        training = "before, on built-in scenes with references"
        return cls(source, options, None, about, training, found, found.mean)

    @staticmethod
    def _check_rendering(rendering: Any, model: AnyModel | None, options: _Options) -> None:
        """Refuse what could not be estimated after the rendering."""
        check_independent(rendering)
        message = None
        if model is not None:
            message = (
                f"{model!r} needs the samples, of which none are kept while rendering: render "
                "first and estimate from the store, or leave the model out"
            )
        elif options.spp not in (None, rendering.spp):
            message = (
                f"spp of a rendering is set where it is made: {rendering.spp}, "
                f"got {options.spp} here"
            )
        elif options.client is not None:
            message = (
                "a rendering draws in one process: leave client or --workers out, or render first "
                "and estimate from the store"
            )
        if message is not None:
            raise InputError(message)
        if options.denoise:
            check_denoiser(rendering.shape[2])

    @classmethod
    def _by(cls, model: AnyModel, samples: Samples, options: _Options) -> _Estimated:
        """Let a model estimate."""
        check_memory(
            _COPIES * samples.nbytes,
            f"the {samples.spp} spp of an estimate and what it computes of them",
            "use fewer, by spp or --spp, or leave the model out",
        )
        x = samples.read()
        if isinstance(model, Progressive):
            found = model.estimate(samples, loss_weight=options.loss_weight, level=options.level)
        else:
            radiance = model.predict(x)
            unknown = np.full_like(radiance, np.nan)
            found = Estimates(radiance, unknown[..., 0], unknown, unknown, np.nan)
        mean = mean_of_good(x).astype(np.float32)
        return cls(samples, options, model, model.provenance, "before", found, mean)

    @cached_property
    def final(self) -> Estimates:
        """The estimate, after the denoiser where there is one."""
        if not self.options.denoise:
            return self.first
        radiance = through_denoiser(self.first.radiance, self.source.features)
        if isinstance(self.first, Combination):
            radiance = self.first.guarded(radiance)
        return replace(self.first, radiance=radiance)

    def layers(self) -> dict[str, npt.NDArray[Any]]:
        found: dict[str, npt.NDArray[Any]] = {"mean": self.mean}
        if not np.isnan(self.first.level):
            found |= {name: getattr(self.first, name) for name in ("certainty", "low", "high")}
        if isinstance(self.first, Combination):
            weights = self.first.weights.items()
            found |= {f"weight_{name.replace(' ', '_')}": image for name, image in weights}
        return found | ({"estimate": self.first.radiance} if self.options.denoise else {})

    def header(self) -> dict[str, str]:
        mixes = isinstance(self.model, Progressive)
        about = {
            "software": f"chdstat {__version__}",
            "scene": self.source.name,
            "spp": getattr(self.first, "spp", self.source.spp),
            "estimator": "combination" if self.model is None else self.model.name,
            "training": self.training,
            "loss_weight": self.options.loss_weight if mixes else "none",
            "level": "none" if np.isnan(self.first.level) else self.first.level,
            "denoiser": "Open Image Denoise" if self.options.denoise else "none",
            "samples": self.source.attrs,
            "model": self.about,
        }
        return {
            k: v if isinstance(v, str) else json.dumps(v, default=str) for k, v in about.items()
        }


def through_denoiser(
    radiance: npt.NDArray[Any],
    features: Mapping[str, npt.NDArray[Any]],
    *,
    certainty: npt.NDArray[Any] | None = None,
) -> npt.NDArray[Any]:
    """Return estimates denoised, with albedo and normal where `features` have an albedo.

    Estimates of signed samples, and those of a network, may be negative. The denoiser takes no
    negative radiance: it counts as 0.
    """
    start = np.where(radiance < 0, 0, radiance)
    albedo = features.get("albedo")
    normal = None if albedo is None else features.get("normal")
    return denoise(start, albedo=albedo, normal=normal, certainty=certainty)


def check_denoiser(channels: int) -> None:
    """Raise InputError where the denoiser cannot be loaded or takes no such image."""
    denoise(np.zeros((1, 1, channels)))
