"""Estimates: the default estimate of an image.

`estimate` is the one call from samples to radiance. By default it combines the mean, an
outlier-free mean and denoised images of both, pixel by pixel. Given a trained model, it applies
that model instead. It trains nothing. `chdstat.io.write_estimates` writes the image to a file.

No single candidate is the best everywhere: a denoiser loses small bright details, the mean is
noisy. `estimate` weights the candidates by their error on held-out samples: each is computed from
one half of the samples and compared with the mean of the other half, which is unbiased and has
independent noise (van der Laan, Polley and Hubbard 2007, "Super learner",
doi:10.2202/1544-6115.1309). A network turns these comparisons into a proposal. How much of its mean
each pixel and channel keeps then follows from its own noise. The steps are the files of
`chdstat.estimators.default_estimate`.

Weights per pixel for candidates follow Back et al. 2020, "Deep combiner for independent and
correlated pixel estimates", doi:10.1145/3414685.3417847, and Firmino et al. 2022, "Progressive
denoising of Monte Carlo rendered images", doi:10.1111/cgf.14454, which mixes by an estimated error.
Both combine two estimates; here there may be any number.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import special

from chdstat._core.arrays import Image, Reals, as_pixels
from chdstat._core.denoiser import denoise as run_denoiser
from chdstat._core.files import checkpoints
from chdstat._core.progress import track
from chdstat._core.work import check_memory
from chdstat.errors import InputError, check_probability
from chdstat.estimators.default_estimate.candidates import Measured, through_denoiser
from chdstat.estimators.default_estimate.error import ErrorOfEstimate, error_of, interval_around
from chdstat.estimators.default_estimate.light import lost_light
from chdstat.estimators.default_estimate.weighting_network import proposed
from chdstat.estimators.default_estimate.weights import weight_of_mean
from chdstat.estimators.held_out import reordered
from chdstat.estimators.registry import (
    Estimates,
    check_positive,
    mean_of_good,
    register,
)
from chdstat.estimators.shapes import PowerSums
from chdstat.estimators.training import TrainedModel, first_samples, load_model
from chdstat.samples import ImageLike, Samples, checkpoint_key
from chdstat.samples.dependence import check_independent
from chdstat.samples.samples import SampleStream

if TYPE_CHECKING:
    from distributed import Client

AnyModel = TrainedModel[Any]
_FIRST = 16
"""Samples per pixel at the first estimate while rendering."""
_MORE, _MARGIN = 1.25, 1.05
"""Least ratio of the numbers of samples of two passes, and margin over the number that is expected
to reach an error."""
_COPIES = 2.2
"""Memory that an estimate by a model takes, relative to that of the samples (measured)."""
_USUAL_CHANNELS = (1, 3)
"""Numbers of channels that EXR has names for."""
_BELOW = 0.001
"""Probability, for normal samples, that radiance is less than its floor."""
_LEAST = 4
"""Fewest samples of a pixel: each half needs two."""


# --- from samples to an image, and its file ---


def estimate(
    samples: ImageLike | SampleStream | npt.ArrayLike,
    model: AnyModel | str | Path | None = None,
    *,
    spp: int | None = None,
    level: float = 0.9,
    denoise: bool = False,
    progress: bool = True,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
) -> Estimates:
    """Estimate the radiance of every pixel.

    Without a model, candidates are weighted by their error on held-out samples, which takes less
    time than rendering the samples did.

    Parameters
    ----------
    samples
        The image, as `Samples`, an array (y, x, channel, sample) or the path of a store. Without a
        model also a rendering from `chdstat.rendering.render_batches`: its batches are summed and
        dropped, so memory does not grow with `spp`.
    model
        A trained estimator, or the file of one; None combines candidates.
    spp
        Use the first so many samples; None uses all.
    level
        Probability of the interval.
    denoise
        Denoise the estimate with Open Image Denoise, with first-hit features where there are any.
        Certainty and interval remain those of the estimate before denoising. Without a model, each
        pixel is denoised once more in proportion to the weight of its denoised candidates, and
        stays within the interval of its mean.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds. A
        rendering shows its own.
    client, checkpoint
        Without a model only, as for `chdstat.analyze`: a Dask client whose workers do the work, and
        a folder for finished parts, from which the same call resumes.

    Returns
    -------
    Estimates
        Shape (y, x, channel), in the unit of the samples. Without a model it is a `Combination`,
        with the weight of each candidate; by a model, what `MLP.estimate` returns.

    Raises
    ------
    InputError
        If there are too few samples, they do not fit into memory, the model does not fit them, an
        option is out of range, or Open Image Denoise cannot be loaded.
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
    options = EstimateOptions(spp, level, denoise, progress, client, checkpoint)
    *_, last = estimates_of(samples, model, options)
    return last.final


@dataclass(frozen=True)
class EstimateOptions:
    """Options of `estimate`."""

    spp: int | None = None
    level: float = 0.9
    denoise: bool = False
    progress: bool = False
    client: Client | None = None
    checkpoint: str | Path | None = None


@dataclass(frozen=True)
class Estimated:
    """An estimate, with everything that is written to a file of it.

    Attributes
    ----------
    source, options
        The samples or the rendering, and the options of the estimate.
    model
        The estimator; None for a combination.
    found
        The estimate before denoising.
    mean
        Mean of the same samples, shape (y, x, channel).
    """

    source: Samples | SampleStream
    options: EstimateOptions
    model: AnyModel | None
    found: Estimates
    mean: npt.NDArray[np.float32]

    @cached_property
    def final(self) -> Estimates:
        """The estimate, after the denoiser where there is one."""
        if not self.options.denoise:
            return self.found
        radiance = through_denoiser(self.found.radiance, self.source.features)
        if isinstance(self.found, Combination):
            radiance = self.found.guarded(radiance)
        return replace(self.found, radiance=radiance)


def estimates_of(
    source: Any,
    model: AnyModel | str | Path | None,
    options: EstimateOptions,
    seconds: float | None = None,
    error: float | None = None,
) -> Iterator[Estimated]:
    """Yield the estimate; for a rendering, yield estimates from more and more samples."""
    check_probability(level=options.level)
    model = load_model(model) if isinstance(model, str | Path) else model
    # Only a rendering has `batch`; testing for its class would import Mitsuba.
    if hasattr(source, "batch"):
        _check_rendering(source, model, options)
        passes = CombinationStream.passes
        for found in passes(source, level=options.level, seconds=seconds, error=error):
            yield Estimated(source, options, None, found, found.mean)
        return
    samples = first_samples(source, options.spp)
    if options.denoise:
        check_denoiser(samples.shape[2])  # refused before the work, not after
    if model is None:
        found = _combined(samples, samples.features, options)
        yield Estimated(samples, options, None, found, found.mean)
        return
    check_memory(
        _COPIES * samples.nbytes,
        f"the {samples.spp} spp of an estimate and what it computes of them",
        "use fewer, by spp or --spp, or leave the model out",
    )
    x = samples.read()
    mean = mean_of_good(x).astype(np.float32)
    yield Estimated(samples, options, model, _by_model(model, x, options.level), mean)


def _by_model(model: AnyModel, x: Image, level: float) -> Estimates:
    """Return the estimates of a model, with certainty and interval if it has them."""
    if hasattr(model, "estimate"):
        found: Estimates = model.estimate(x, level=level)
        return found
    radiance = model.predict(x)
    unknown = np.full_like(radiance, np.nan)
    return Estimates(radiance, unknown[..., 0], unknown, unknown, np.nan)


def _check_rendering(rendering: Any, model: AnyModel | None, options: EstimateOptions) -> None:
    """Check before the rendering whatever would fail after it."""
    check_independent(rendering.attrs)
    message = None
    if model is not None:
        message = (
            f"{model!r} needs the samples, of which none are kept while rendering: render "
            "first and estimate from the store, or leave the model out"
        )
    elif options.spp not in (None, rendering.spp):
        message = (
            f"spp of a rendering is set where it is made: {rendering.spp}, got {options.spp} here"
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


def check_denoiser(channels: int) -> None:
    """Raise InputError if the denoiser cannot be loaded or does not take so many channels."""
    run_denoiser(np.zeros((1, 1, channels)))


# --- the combination of candidates ---


@dataclass(frozen=True, repr=False)
class Combination(Estimates):
    """Estimates from several candidates, with the weight of each.

    Attributes
    ----------
    mean
        Mean of each channel's good samples, shape (y, x, channel).
    weights
        Weight of each candidate by its name, shape (y, x), averaged over the channels, adding up to
        1. The certainty is 1 minus the weight of the mean. Groups of pixels whose sum differs
        significantly from that of their means are also made brighter (or darker): see
        `default_estimate.light`.
    bias
        Difference between the sum of the image and the sum of the mean, which has no bias, divided
        by the latter.
    bias_error
        Standard error of the sum of the mean, divided by that sum. A bias below twice this may be
        chance.
    least
        Lower end of an interval of the mean, shape (y, x, channel); denoising keeps to this
        interval.
    spp
        Largest number of samples of a pixel.
    error
        Error of the image, and how it depends on the number of samples: see `relative_error` and
        `spp_for`.
    """

    mean: Image = field(default_factory=lambda: np.empty(0, np.float32))
    weights: Mapping[str, Image] = field(default_factory=dict)
    bias: float = np.nan
    bias_error: float = np.nan
    least: Image = field(default_factory=lambda: np.empty(0, np.float32))
    spp: int = 0
    error: ErrorOfEstimate = field(default_factory=ErrorOfEstimate)

    @property
    def relative_error(self) -> float:
        """Relative error of the image: the root of its relMSE, estimated from held-out halves.

        The measure that ``chdstat.render(error=)`` reaches for the mean of the samples. NaN if
        nothing is known. `error` has its parts, and ``error.surely``, which nine of ten images do
        not exceed.
        """
        return self.error.relative

    def spp_for(self, error: float) -> float:
        """Return the samples per pixel at which this estimate has a relative error.

        A forecast: half of the present error takes four times the samples if the estimate is the
        mean, and more where smoothing has made its error smaller.

        Examples
        --------
        >>> x = np.random.default_rng(0).exponential(size=(32, 32, 1, 64))
        >>> found = estimate(x)
        >>> found.spp_for(found.relative_error / 2) > 4 * found.spp
        True
        """
        check_positive(error=error)
        return self.error.spp_for(error)

    def guarded(self, denoised: Image) -> Image:
        """Mix these estimates with their denoised image, by the weights of the denoised candidates.

        Where the candidates that are not denoised have all the weight, nothing is denoised.
        Denoising moves no pixel out of the interval of its mean.
        """
        unseen = [image for name, image in self.weights.items() if "denoised" not in name]
        kept = np.clip(np.sum(unseen, axis=0), 0, 1)[..., np.newaxis]
        least, most = self.least, 2 * self.mean - self.least
        found = kept * self.radiance + (1 - kept) * denoised
        within = np.clip(found, np.minimum(self.radiance, least), np.maximum(self.radiance, most))
        return np.asarray(within, np.float32)


def _combined(
    image: Samples, features: Mapping[str, npt.NDArray[Any]], options: EstimateOptions
) -> Combination:
    """Estimate radiance from candidates, weighted by their error on held-out samples."""
    if image.shape[2] not in (1, 3) or image.shape[3] < _LEAST:
        message = (
            f"expected samples (y, x, channel, sample) of 1 or 3 channels, at least {_LEAST} of a "
            f"pixel, got shape {image.shape}; render more samples per pixel, or choose channels"
        )
        raise InputError(message)
    client, progress = options.client, options.progress
    with checkpoints(options.checkpoint, partial(checkpoint_key, image)) as kept:
        measured = Measured.of(image, progress=progress, client=client, checkpoint=kept)
    with track("combining candidates", 0, show=progress):
        return _combination_of(measured, features, level=options.level, client=client)


class CombinationStream:
    """Estimate from samples that arrive in batches; only sums of them are kept.

    Memory does not depend on the number of samples. `estimate` returns, to the bit, what
    `chdstat.estimate` returns for the same samples in the same order, however they are cut into
    batches. `passes` estimates while a scene renders.

    Parameters
    ----------
    shape
        Shape of the image: (y, x, channel), 1 or 3 channels.

    Examples
    --------
    >>> x = np.random.default_rng(0).exponential(size=(16, 16, 3, 32)).astype(np.float32)
    >>> stream = CombinationStream((16, 16, 3))
    >>> for batch in np.split(x, 4, axis=-1):
    ...     stream.update(batch)
    >>> stream.spp, np.array_equal(stream.estimate().radiance, estimate(x).radiance)
    (32, True)
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        if len(shape) != 3 or shape[2] not in (1, 3):
            message = f"expected the shape (y, x, channel) of 1 or 3 channels, got {shape}"
            raise InputError(message)
        self._halves = [PowerSums.empty(shape) for _ in range(2)]
        self._drawn = np.zeros(shape[:2], np.int64)
        self.shape = shape

    @property
    def spp(self) -> int:
        """Number of samples that every pixel has."""
        return int(self._drawn.min())

    def update(
        self, batch: npt.ArrayLike, *, rows: slice = slice(None), columns: slice = slice(None)
    ) -> None:
        """Add samples, shape (y, x, channel, sample), of the image or of a part of it."""
        x, drawn = np.asarray(batch), self._drawn[rows, columns]
        if x.ndim != 4 or x.shape[:3] != (*drawn.shape, self.shape[2]):
            expected = (*drawn.shape, self.shape[2], "sample")
            message = f"expected samples of shape {expected}, got {x.shape}"
            raise InputError(message)
        if drawn.min() != drawn.max():
            message = (
                "expected a part of pixels that have as many samples as each other, got "
                f"{drawn.min()} to {drawn.max()}"
            )
            raise InputError(message)
        for i in range(2):
            half = self._halves[(int(drawn.min()) + i) % 2]
            half.part(rows, columns).update(x[..., i::2])
        drawn += x.shape[-1]

    def estimate(
        self, *, features: Mapping[str, npt.NDArray[Any]] | None = None, level: float = 0.9
    ) -> Combination:
        """Estimate the radiance from the samples so far, as `chdstat.estimate` does."""
        check_probability(level=level)
        if self.spp < _LEAST:
            message = f"expected at least {_LEAST} samples of a pixel, got {self.spp}"
            raise InputError(message)
        return _combination_of(Measured.of_halves(*self._halves), features or {}, level=level)

    @classmethod
    def passes(
        cls,
        rendering: SampleStream,
        *,
        level: float = 0.9,
        seconds: float | None = None,
        error: float | None = None,
    ) -> Iterator[Combination]:
        """Estimate while a scene renders: at 16 samples per pixel, and at each doubling.

        Parameters
        ----------
        rendering
            From `chdstat.rendering.render_batches`.
        level
            Probability of the intervals.
        seconds
            Stop after the first pass that ends later than this; None renders all.
        error
            Stop after the first pass whose relative error is at most this, and at most a tenth
            larger in nine of ten images. The next pass comes when that is expected, if that is
            before the number of samples has doubled.

        Yields
        ------
        Combination
            What `chdstat.estimate` returns for the samples so far. The last one equals, to the bit,
            the estimate from a store of the same samples.

        Raises
        ------
        InputError
            If an option is out of range, or there are fewer than 4 samples.

        Examples
        --------
        Stop when the error of the image is surely 20 %:

        >>> from chdstat.rendering import render_batches
        >>> rendering = render_batches("cornell-box", spp=1024, size=(16, 16), progress=False)
        >>> *_, last = CombinationStream.passes(rendering, error=0.2)
        >>> last.relative_error <= 0.2, last.spp < 1024
        (True, True)
        """
        check_probability(level=level)
        given = {"seconds": seconds, "error": error}
        check_positive(**{name: value for name, value in given.items() if value is not None})
        if rendering.spp < _LEAST:
            message = f"expected at least {_LEAST} samples of a pixel, got {rendering.spp}"
            raise InputError(message)
        y, x, channels, _ = rendering.shape
        stream, begin = cls((y, x, channels)), time.monotonic()
        due: float = _FIRST
        for chunks in rendering.passes():
            for chunk, samples in chunks:
                stream.update(samples, rows=chunk.ys, columns=chunk.xs)
            late = seconds is not None and time.monotonic() - begin >= seconds
            enough = stream.spp >= _LEAST
            if enough and (late or stream.spp >= min(due, rendering.spp)):
                found = stream.estimate(features=rendering.features, level=level)
                yield found
                if late or (error is not None and found.error.reaches(error)):
                    return
                due = 2 * found.spp
                if error is not None:
                    due = max(
                        _MORE * found.spp, min(due, _MARGIN * found.error.spp_to_reach(error))
                    )


def _combination_of(
    measured: Measured,
    features: Mapping[str, npt.NDArray[Any]],
    *,
    level: float,
    client: Client | None = None,
) -> Combination:
    """Combine candidates from the statistics of all samples and of their halves."""
    weights, half, proposals = proposed(measured, features, level=level, client=client)
    unknown, absurd = measured.count == 0, measured.absurd[..., np.newaxis]
    of_means = [np.where(absurd, 1, weight) for weight in weight_of_mean(*proposals)]
    moved = [np.where(unknown, 0, 1 - weight) for weight in of_means]
    # Where samples are missing, a proposal has been filled in for their mean.
    means = measured.mean, *(proposal.mean for proposal in proposals[1:])
    estimates = [
        mean + part * (proposal.image - mean)
        for mean, part, proposal in zip(means, moved, proposals, strict=True)
    ]
    given, error_of_light = lost_light(proposals, estimates, moved)
    radiance, *halves = (image + light for image, light in zip(estimates, given, strict=True))
    reach = _reach_of_mean(measured, level, proposals[0].image + half)
    low, high = interval_around(
        radiance, of_means[0], reach, half, error_of_light, proposals, halves, level
    )
    error, pairs = measured.errors[0], list(zip(halves, means[1:], strict=True))

    def in_its_unit(image: Reals) -> Image:
        return np.where(unknown, np.nan, image * measured.unit).astype(np.float32)

    shares = _shares(weights, of_means[0])
    bias, bias_error = _bias(radiance, measured.mean, error)
    return Combination(
        in_its_unit(radiance),
        1 - shares["mean"],
        in_its_unit(low if measured.signed else np.maximum(low, 0)),
        in_its_unit(high),
        level,
        mean=in_its_unit(measured.mean),
        weights=shares,
        bias=bias,
        bias_error=bias_error,
        least=in_its_unit(_floor(measured.mean, error, measured.count)),
        spp=int(measured.count.max(initial=0)),
        error=error_of(np.where(unknown, np.nan, radiance), error, pairs, measured.count),
    )


def _reach_of_mean(measured: Measured, level: float, highest: Reals) -> tuple[Reals, Reals]:
    """Return how far the interval of the mean reaches below and above it.

    The mean of a pixel without light has no interval: that of the proposal, up to `highest`, takes
    its place.
    """
    mean = measured.mean
    low, high = measured.interval(level)
    dark = (mean == 0) & (measured.errors[0] == 0)
    return mean - low, np.where(dark, np.maximum(highest, 0), high) - mean


def _shares(weights: Mapping[str, Image], of_mean: Reals) -> dict[str, Image]:
    """Return the shares of the candidates in the estimate, averaged over the channels."""
    of_mean = of_mean.mean(axis=-1)
    shares = {name: (one * (1 - of_mean)).astype(np.float32) for name, one in weights.items()}
    shares["mean"] += of_mean
    return shares


@register(
    "combination",
    source="this library, after van der Laan, Polley and Hubbard 2007",
    place=8,
    minimum_samples=_LEAST,
    uses_neighbours=True,
    joint_channels=True,
    uses_features=True,
    learns=True,
)
def combination(
    x: npt.ArrayLike, *, features: Mapping[str, npt.NDArray[Any]] | None = None
) -> Image:
    """Weight the mean, an outlier-free mean and denoised images of both, pixel by pixel.

    Returns the radiance of `chdstat.estimate`. Its network was trained once, on built-in scenes.

    Parameters
    ----------
    x
        Samples, shape (y, x, channel, sample) of 1 or 3 channels, at least 4.
    features
        First-hit features of the image, as in `Samples.features`.

    Returns
    -------
    ndarray
        Estimates, shape (y, x, channel), in the unit of `x`.

    Raises
    ------
    InputError
        As for `chdstat.estimate`.

    References
    ----------
    M. J. van der Laan, E. C. Polley and A. E. Hubbard, "Super learner", Statistical Applications in
    Genetics and Molecular Biology 6(1), 2007, doi:10.2202/1544-6115.1309.

    Examples
    --------
    >>> image = np.random.default_rng(0).exponential(size=(16, 16, 3, 16))
    >>> combination(image).shape
    (16, 16, 3)
    """
    samples = reordered(as_pixels(x, minimum=_LEAST, image=True))
    image = Samples.from_array(np.asarray(samples, np.float32))
    return _combined(image, features or {}, EstimateOptions()).radiance


def _floor(mean: Reals, error: Reals, count: Reals) -> Reals:
    """Return the least radiance that a pixel may get when it is denoised once more.

    It is the lower end of Student's interval. With one bright sample among n, the standard error
    equals the mean; with k of them it is about mean / sqrt(k). So the bound is above 0 only for
    light that many samples found. As radiance is skewed to the right, the lower end is the more
    certain one.
    """
    counts, place = np.unique(count, return_inverse=True)
    certain = special.stdtrit(np.maximum(counts.astype(np.float64) - 1, 1), 1 - _BELOW)
    return np.asarray(mean - certain[place] * error)


def _bias(radiance: Reals, mean: Reals, error: Reals) -> tuple[float, float]:
    """Return how much brighter an image is than the mean, and the standard error, as shares."""
    whole = float(mean.sum())
    if not whole:
        return np.nan, np.nan
    of_radiance = float(np.nansum(radiance, dtype=np.float64))
    # The channels of a sample vary together: add their errors, not their variances.
    of_sum = np.sqrt(np.square(error.sum(axis=-1)).sum())
    return of_radiance / whole - 1, float(of_sum) / abs(whole)
