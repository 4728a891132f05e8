"""Adaptive sampling: more samples for the pixels whose noise weighs most.

The first samples of all pixels, a quarter of them (half if there are few), tell how noisy each
pixel is. The others are drawn where they are needed. Two rules keep the result honest:

- *Other* pixels decide the number of samples of a pixel, never its own samples. Pixels are the
  squares of a chessboard, and the black ones decide for the white ones and the other way round. The
  samples of a pixel thus do not depend on their number, and its mean has no bias. Stopping when
  samples look quiet has a bias (Kirk and Arvo 1991, "Unbiased sampling techniques for image
  synthesis", doi:10.1145/122718.122735). The first samples count like all others; a pilot that is
  thrown away would cost a quarter of all samples. A second round may not look at more than the
  first samples: the number of samples of a white pixel already depends on the black ones.
- No pixel gets less than a quarter of the mean, so that light that no sample has found is still
  looked for.

If the noise were known, counts in proportion to its root would minimise the relative error of the
image or its MSE (Neyman 1934, "On the two different aspects of the representative method",
doi:10.2307/2342192). But the noise is estimated, from surrounding pixels with similar albedo,
normal and depth, and brightness is known better than noise. Counts therefore follow a smaller power
of the noise, times a power of the brightness. Both powers were chosen on the 13 scenes on which the
how-to judges them. Regression trees, and powers learned from the image itself, gained no more
there.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from chdstat._core.arrays import Floats, Image, Mask, is_bad, spans
from chdstat._core.image_scales import DARK
from chdstat._core.moments import Moments
from chdstat.errors import InputError, check_option
from chdstat.samples import Samples

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from chdstat._core.resampling import Interval

__all__ = [
    "Adaptive",
    "ErrorMeasure",
    "decided",
    "density_of",
    "error_of",
    "expected_error",
]

ErrorMeasure = Literal["relMSE", "MSE"]
"""The error of the image to minimise."""
_log = logging.getLogger("chdstat")
_SHARE, _ENOUGH, _FEWEST = 4, 32, 16
"""First samples of a pixel: one in 4, or 32 but at most half; and fewest samples of a render."""
_SURE = 64
"""Most first samples that predict an error."""
_MOST = 8.0
"""Largest number of samples of a pixel, over the mean."""
_LEFT = 1 / 16
"""Share of a pixel's squared mean that is left at least when its variance is subtracted."""
_ROWS = 16
"""Rows that are read together."""
_UNITS, _DEPTH = {"albedo": 0.3, "normal": 0.8}, 0.2
"""Differences in albedo, normal and log depth at which pixels are no longer similar."""
_UNLIKE = 1e-4
"""Weight of pixels that are not similar at all, for pixels without similar ones."""
_WIDE, _NEAR = 3.0, 1.5
"""Width in pixels of the weights of pixels that decide, and of pixels whose mean is compared."""
_POWERS = {"relMSE": (0.35, -0.12), "MSE": (0.2, 0.2)}
"""Powers of the expected noise and of the brightness that counts follow."""
_LITTLE = 0.02
"""Share of the mean over the image that is added to noise and brightness."""


@dataclass(frozen=True)
class Adaptive:
    """How to decide the number of samples of each pixel.

    Attributes
    ----------
    measure
        The error of the image to minimise.
    first
        Samples of every pixel from which counts are decided.
    least
        Smallest number of samples of a pixel over the mean, so that all pixels have the first
        samples.
    error
        Relative error of the image, the root of the measure, at which to stop; None for no limit.
    percentile
        Percentile over the pixels that the error is about, such as 95; None for the error of the
        image.
    """

    measure: str
    first: int
    least: float = 1 / _SHARE
    error: float | None = None
    percentile: float | None = None

    @classmethod
    def of(
        cls,
        asked: bool | str,
        error: float | None,
        percentile: float | None,
        spp: int,
        held: Mapping[str, Any] | None,
    ) -> Adaptive:
        """Return the plan of an adaptive render.

        Parameters
        ----------
        asked, error, percentile, spp
            As for `chdstat.render`.
        held
            Plan of an earlier render that is continued.

        Raises
        ------
        InputError
            If there is no such measure, the error is not between 0 and 1, the percentile is not
            between 1 and 100 or is given without an error, or there are too few samples.
        """
        measure = "relMSE" if isinstance(asked, bool) else asked
        if held is not None and isinstance(asked, bool):
            measure = held["measure"]
        check_option("adaptive", measure, get_args(ErrorMeasure))
        if error is not None and not 0 < error < 1:
            message = f"error must lie between 0 and 1, such as 0.02 for 2 %, got {error:g}"
            raise InputError(message)
        if percentile is not None and not 1 <= percentile < 100:
            message = f"percentile must lie between 1 and 100, 95 for 95 %, got {percentile:g}"
            raise InputError(message)
        if percentile is not None and error is None:
            message = "percentile says where an error is to be reached: give error, too"
            raise InputError(message)
        if spp < _FEWEST:
            message = (
                f"adaptive sampling needs at least {_FEWEST} spp, of which the first ones tell how "
                f"noisy each pixel is; got {spp}"
            )
            raise InputError(message)
        first = max(spp // _SHARE, min(_ENOUGH, spp // 2))
        if error is not None:  # of which it may take fewer
            first = min(first, _SURE)
        first = held["first"] if held else first
        return cls(measure, first, min(max(1 / _SHARE, first / spp), 1.0), error, percentile)

    @property
    def attrs(self) -> dict[str, Any]:
        """The part that belongs to the identity of samples."""
        return {"measure": self.measure, "first": self.first}

    def spp(self, noise: Mapping[str, float], most: int) -> int:
        """Return the mean samples per pixel that reach the error, but at most `most`."""
        if self.error is None:
            return most
        needed = max(math.ceil(noise["value"] / self.error**2), self.first)
        if needed > most:
            expected = math.sqrt(noise["value"] / most)
            message = "an error of %g takes about %d spp; with %d, about %.2g is expected"
            _log.warning(message, self.error, needed, most, expected)
        return min(needed, most)


class _Seen(NamedTuple):
    """Mean, variance and variance of the mean of each pixel, shape (y, x, channel)."""

    mean: Floats
    variance: Floats
    square: Floats

    @classmethod
    def of(cls, samples: Samples) -> _Seen:
        """Read samples, some rows at a time."""
        found = cls(*(np.zeros(samples.shape[:3]) for _ in range(3)))
        for rows in spans(samples.shape[0], _ROWS):
            x = samples.read(rows)
            part = Moments.of(x, np.logical_not(is_bad(x).any(axis=2, keepdims=True)))
            found.mean[rows] = part.mean
            found.variance[rows] = part.m2 / np.maximum(part.count - 1, 1)
            found.square[rows] = found.variance[rows] / np.maximum(part.count, 1)
        return found

    def noise(self, measure: str, mean: Floats | None = None) -> Floats:
        """Return the expected squared error of one sample of each pixel, shape (y, x).

        It is the variance, averaged over the channels. For relMSE, it is divided by the squared
        mean of the pixel plus 1 % of the squared mean of the scene.

        Parameters
        ----------
        measure
            "relMSE" or "MSE".
        mean
            Means of pixels, shape (y, x, channel); None for their own. The square of a mean of
            samples is too large by the variance of the mean, which is subtracted.
        """
        if measure == "MSE":
            return np.asarray(self.variance.mean(axis=-1))
        square = np.maximum(self.mean**2 - self.square, _LEFT * self.mean**2)
        of_scene = np.empty_like(square)
        # Each half decides for the other one, without the other's samples.
        for half in _halves(*square.shape[:2]):
            of_scene[half] = self.mean[half].mean(axis=0) if half.any() else 0
        scale = (square if mean is None else mean**2) + DARK * of_scene**2
        relative = np.divide(self.variance, scale, out=np.zeros_like(scale), where=scale > 0)
        return np.asarray(relative.mean(axis=-1))

    def noise_for_error(
        self, measure: str, features: Mapping[str, Image], percentile: float | None, step: int = 1
    ) -> Floats:
        """Return the noise of each pixel from which the error of the image is predicted.

        Relative to its own mean, the error of a pixel never seems large: a single bright sample
        raises both. So the noise is relative to the mean of similar pixels around. That mean counts
        as far as it lies within one standard error of the pixel's own mean. If all the light of a
        pixel is one sample, that interval reaches down to 0. For percentiles, the noise is averaged
        over similar pixels: percentiles of single pixels would show its uncertainty instead.

        Parameters
        ----------
        measure, features, percentile
            As for `error_of`.
        step
            2 to use only pixels of the same colour of the chessboard.
        """
        error = np.sqrt(self.square)
        around = _around(self.mean, features, _NEAR, lambda away: away > 0 and away % step == 0)
        noise = self.noise(measure, np.clip(around, self.mean - error, self.mean + error))
        if percentile is None:
            return noise
        pooled = _around(noise[..., np.newaxis], features, _NEAR, lambda away: away % step == 0)
        return np.asarray(pooled[..., 0])


def density_of(
    noise: Floats,
    brightness: Floats,
    features: Mapping[str, Image],
    powers: tuple[float, float] = _POWERS["relMSE"],
    least: float = 1 / _SHARE,
) -> Floats:
    """Return the number of samples of each pixel over the mean of all, shape (y, x).

    Parameters
    ----------
    noise, brightness
        Expected squared error of one sample, and radiance, shape (y, x).
    features
        First-hit features, as far as they exist.
    powers
        Powers of the noise and of the brightness.
    least
        The smallest density.
    """
    known = np.stack([noise, np.maximum(brightness, 0)], axis=-1)
    expected = _around(known, features, _WIDE, lambda away: away % 2 == 1)
    density = np.ones(noise.shape)
    for half in _halves(*noise.shape):
        if half.any() and (mean := expected[half].mean(axis=0)).all():
            wanted = (expected[half] / mean + _LITTLE) ** powers
            density[half] = _bounded(wanted.prod(axis=-1), least)
    return density


def _bounded(wanted: Floats, least: float) -> Floats:
    """Return numbers in proportion to the wanted ones, with a mean of 1, within bounds."""
    low, high = 0.0, _MOST / float(wanted[wanted > 0].min())
    for _ in range(60):
        middle = (low + high) / 2
        is_less = np.clip(middle * wanted, least, _MOST).mean() < 1
        low, high = (middle, high) if is_less else (low, middle)
    return np.asarray(np.clip(high * wanted, least, _MOST))


def _halves(height: int, width: int) -> tuple[Mask, Mask]:
    """Return the white and the black squares of a chessboard."""
    is_white = np.asarray(np.add.outer(np.arange(height), np.arange(width)) % 2 == 1)
    return is_white, ~is_white


def _scaled(features: Mapping[str, Image], shape: tuple[int, ...]) -> Floats:
    """Return features in units of the differences that matter, shape (y, x, number)."""
    found: list[Any] = [np.zeros((*shape, 1))]
    found += [features[name] / unit for name, unit in _UNITS.items() if name in features]
    if "depth" in features:
        found.append(np.log(np.maximum(features["depth"], 1e-6))[..., np.newaxis] / _DEPTH)
    return np.concatenate(found, axis=-1, dtype=np.float64)


def _around(
    values: Floats, features: Mapping[str, Image], width: float, taken: Callable[[int], bool]
) -> Floats:
    """Return means over similar pixels around each pixel, shape (y, x, value).

    Parameters
    ----------
    values
        Values of the pixels, shape (y, x, value).
    features
        First-hit features, as far as they exist.
    width
        Width of the weights, in pixels; they reach twice as far.
    taken
        Which pixels count, by the number of steps along the grid to them: 0 for the pixel itself,
        odd for those of the other colour.
    """
    likeness, reach = _scaled(features, values.shape[:2]), int(2 * width)
    weights, total = np.zeros((*values.shape[:2], 1)), np.zeros_like(values)
    down, across = (range(-min(reach, n - 1), min(reach, n - 1) + 1) for n in values.shape[:2])
    for dy, dx in ((y, x) for y in down for x in across if taken(abs(y) + abs(x))):
        here, there = _overlap(dy, dx, *values.shape[:2])
        unlike = ((likeness[here] - likeness[there]) ** 2).sum(axis=-1, keepdims=True)
        near = math.exp(-(dy * dy + dx * dx) / (2 * width**2))
        weight = near * (np.exp(-unlike / 2) + _UNLIKE)
        weights[here] += weight
        total[here] += weight * values[there]
    return np.asarray(total / np.where(weights > 0, weights, 1))


def _overlap(dy: int, dx: int, height: int, width: int) -> tuple[Any, Any]:
    """Return where pixels have another pixel at an offset, and where the other pixels are."""
    here = tuple(slice(max(0, -d), max(0, n - max(0, d))) for d, n in ((dy, height), (dx, width)))
    there = tuple(slice(max(0, d), max(0, n + min(0, d))) for d, n in ((dy, height), (dx, width)))
    return here, there


# --- what is decided ----------------------------------------------------------------------------


def decided(samples: Samples, how: Adaptive) -> tuple[Image, dict[str, float]]:
    """Return the density of a render from the first samples of all pixels, and its noise.

    The noise is the expected squared error of the image with one sample per pixel on average, and
    the ends of its interval if there is one. With n samples, the error is the root of the noise
    over n. Each pixel's own variance enters, with the count that other pixels decided, so that the
    choice does not make the error look small.

    Parameters
    ----------
    samples
        The first samples of all pixels.
    how
        The plan of the render.
    """
    seen = _Seen.of(samples)
    noise, features = seen.noise(how.measure), samples.features
    bright = seen.mean.mean(axis=-1)
    density = density_of(noise, bright, features, _POWERS[how.measure], how.least)
    of_error = seen.noise_for_error(
        how.measure, features, how.percentile, 1 if how.error is None else 2
    )
    found = _over_pixels(of_error / density, how.percentile)
    known = {name: float(value) for name, value in found.to_dict().items()}
    if how.error is not None and found.value > 0:
        scale = _halved(of_error, density, how.percentile) / found.value
        known |= {name: scale * known[name] for name in ("value", "low", "high")}
    if how.percentile is not None:
        known["percentile"] = how.percentile
    return density.astype(np.float32), {n: v for n, v in known.items() if math.isfinite(v)}


def _over_pixels(noise: Floats, percentile: float | None) -> Interval[float]:
    """Return the mean or a percentile over the image, with an interval from its blocks."""
    # Loads SciPy, which a render need not wait for.
    from chdstat._core.resampling import Blocks, mean_of, quantile_of

    blocks = Blocks.grid(*noise.shape)
    if percentile is None:
        return mean_of(noise.ravel(), blocks)
    return quantile_of(noise.ravel(), blocks, percentile / 100)


def _halved(noise: Floats, density: Floats, percentile: float | None) -> float:
    """Return the noise of the image, where each half gets the samples that the other half suggests.

    The number of samples of a pixel thus does not depend on its own samples, even if one of them
    decides the error of the whole image.
    """
    padded = np.pad(density, 1, mode="reflect")  # beside a pixel are those for which it decides
    beside = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]
    own, halves = 4 * noise / beside, [half for half in _halves(*noise.shape) if half.any()]
    tells = [own[~half] if (~half).any() else own for half in halves]
    needs = [x.mean() if percentile is None else np.percentile(x, percentile) for x in tells]
    total = float(sum(n * half.mean() for n, half in zip(needs, halves, strict=True)))
    for need, half in zip(needs, halves, strict=True):
        density[half] *= need / total
    return total


def expected_error(attrs: Mapping[str, Any]) -> Interval[float] | None:
    """Return the relative error that the first samples of an adaptive render predict, or None.

    Parameters
    ----------
    attrs
        Attributes of its samples.
    """
    from chdstat._core.resampling import Interval

    if "noise" not in attrs:
        return None
    ends = (attrs["noise"].get(name, math.nan) / attrs["spp"] for name in ("value", "low", "high"))
    return Interval(*ends).root()


def error_of(
    samples: Samples, measure: str = "relMSE", percentile: float | None = None
) -> Interval[float]:
    """Return the error of the mean image, estimated from its samples: the root of relMSE or MSE.

    It is too small if the variance of pixels comes from light that hardly any sample has found.

    Parameters
    ----------
    samples
        Independent samples.
    measure
        "relMSE" or "MSE".
    percentile
        Return the error that this percentage of the pixels does not exceed, such as 95, instead of
        the image's.

    Examples
    --------
    >>> x = np.random.default_rng(0).exponential(size=(32, 32, 1, 100))  # of variance 1
    >>> error_of(Samples.from_array(x), "MSE")
    Interval(value=...)
    """
    counts = samples.counts
    noise = _Seen.of(samples).noise_for_error(measure, samples.features, percentile)
    return _over_pixels(
        noise / np.maximum(samples.spp if counts is None else counts, 1), percentile
    ).root()
