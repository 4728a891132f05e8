r"""Adaptive sampling: more samples for the pixels whose noise weighs most, up to an error.

The mean of a pixel has no bias if its number of samples does not depend on the samples that are
averaged. Stopping when samples look quiet has one (Kirk and Arvo 1991, "Unbiased sampling
techniques for image synthesis", doi:10.1145/122718.122735). Let :math:`x_1, x_2, ...` be the
samples of a pixel, independent and with mean :math:`\mu`. If their number :math:`N` is a function
of anything that is independent of all of them, then
:math:`E[\frac1N \sum_{k \le N} x_k] = \mu`, whatever their law. All that is kept is the
:math:`N` samples, and everybody takes their plain mean. There are two ways:

- **Other pixels decide** (``adaptive=True``). The first samples of all pixels, a quarter of them
  (half if there are few), tell how noisy each pixel is. They count like all others, so that none is
  lost. Pixels form eight classes at random. Only samples of other classes decide for a class: the
  need of a pixel is averaged over similar pixels of other classes around it, and the numbers of a
  class are divided by the mean of these needs. (If the classes are the colours of a chessboard, and
  noise lies on one colour, each colour gets what the other one needs.)
- **Trial samples decide** (``error=``). Nothing but its own samples tells that a single pixel is
  noisy. If the first samples decide and are kept, with the mean :math:`m` and the weight :math:`W`
  in the mean of all, the bias is :math:`E[W (m - \mu)]`. It is 0 for all laws only if :math:`W` is
  constant. But their share of :math:`N` samples falls as :math:`N` grows. So the samples that
  decide are thrown away, and all others are independent of them. Between a sixteenth and an eighth
  of all samples are enough.

What is decided once stays. If the number of a pixel depended on the further samples of other
pixels, and their number on the first samples of the pixel, it would depend on its own. But where
trial samples decide, no number depends on samples that are kept. So the kept samples of the other
classes may decide once whether those of a class go on; see `more`.

No pixel gets less than a quarter of the mean, so that light that no sample has found is still
looked for.

If the noise were known, numbers in proportion to its root would minimise the relative error of the
image or its MSE (Neyman 1934, "On the two different aspects of the representative method",
doi:10.2307/2342192). If a sample takes a known time, which differs from pixel to pixel, they are
best over the root of that time (Cochran, "Sampling Techniques", 3rd edition, 1977, section 5.5):
in the time that it takes, the error is smallest. Times are known if a render is asked for them
(``cost=True``); as with noise, the times of other pixels, or of trial samples, decide. Trial
samples follow this rule, with the likely noise of each pixel. Other
pixels know less of it, and know brightness better than noise. There, numbers follow a smaller power
of the noise, times a power of the brightness. Both powers were chosen on the 13 scenes on which the
how-to judges them. Regression trees, and powers learned from the image itself, gained no more.

The error
---------

The error of an image is the root of its relMSE: `chdstat._core.image_scales.relative_error`. The
variance of the mean, in its numerator, has no bias. The denominator is the squared mean of the
pixel, and a single bright sample makes both large: relative to their own means, pixels never seem
to have large errors. Relative to the means around them, pixels that differ from these do. So both
are averaged, with a weight for the probability that the deviation of the pixel is its own, and not
chance. Two halves of the samples tell that: see `_likely`.

The interval is about the error of this very image. With :math:`c_i` the estimated squared error of
pixel i and :math:`s_i` its standard error, the sum of the squared errors has a variance of about
:math:`2 \sum c_i^2`, and the sum of their estimates one of :math:`\sum s_i^2`. Both sums are
approximated by chi-squared distributions of the same mean and variance (Satterthwaite 1946, "An
approximate distribution of estimates of variance components", doi:10.2307/3002019). Their ratio
then follows an F distribution of :math:`(\sum c_i)^2 / \sum c_i^2` and
:math:`2 (\sum c_i)^2 / \sum s_i^2` degrees of freedom.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image, Reals, is_bad, spans
from chdstat._core.image_scales import TOLERANCE, relative_scale
from chdstat._core.moments import Moments
from chdstat.errors import InputError, check_option
from chdstat.samples import Samples

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from chdstat._core.resampling import Interval
    from chdstat.samples.costs import SampleCosts

ErrorMeasure = Literal["relMSE", "MSE"]
"""The error of the image to minimise."""
Classes = npt.NDArray[np.intp]
"""Class of each pixel, shape (y, x)."""
_log = logging.getLogger("chdstat")
_SHARE, _ENOUGH, _FEWEST = 4, 32, 16
"""First samples of a pixel: one in 4, or 32 but at most half; and fewest samples of a render."""
_TRIAL, _TRIALS = 16, 256
"""Trial samples: they double while there are less than one in 16; at most 256."""
_CLASSES = 8
_MOST = 16.0
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
_NEYMAN = (0.5, -0.5)
"""Powers of the noise and of the cost of a sample that are best if both are known."""
_LITTLE = 0.02
"""Share of the mean over the image that is added to noise and brightness."""
_ALIKE = (-6.0, -1.5, -0.5, 0.0, 0.5, 1.5, 3.0, 6.0, 12.0, 25.0, 100.0)
"""Ends of the squared deviations, in squared standard errors and with their sign, that count as
equally significant."""
_FEW = (1.2, 1.6, 2.2, 3.0, 4.5, 7.0, 12.0)
"""Ends of the numbers of samples that make a mean, if they are few: these count as alike."""
_SURE = 0.9
"""Probability that the error of this very image is not larger than that, if the noise is known."""


@dataclass(frozen=True)
class Adaptive:
    """How to decide the number of samples of each pixel.

    Attributes
    ----------
    measure
        The error of the image to minimise.
    first
        Samples that every pixel gets.
    least
        Smallest number of samples of a pixel over the mean, so that all pixels have the first
        samples.
    error
        Relative error of the image at which to stop; None for no limit.
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
            message = "percentile= says where an error is to be reached: give error=, too"
            raise InputError(message)
        if spp < _FEWEST:
            message = (
                f"adaptive sampling needs at least {_FEWEST} spp, of which the first ones tell how "
                f"noisy each pixel is; got {spp}"
            )
            raise InputError(message)
        first = max(spp // _SHARE, min(_ENOUGH, spp // 2))
        if error is not None:  # others decide, and it may take fewer
            first = min(spp // 2, _FEWEST)
        first = held["first"] if held else first
        return cls(measure, first, min(max(1 / _SHARE, first / spp), 1.0), error, percentile)

    @property
    def attrs(self) -> dict[str, Any]:
        """The part that belongs to the identity of samples."""
        return {"measure": self.measure, "first": self.first}

    def first_trial(self, spp: int) -> int:
        """Return the number of trial samples to begin with, if `spp` are drawn at most."""
        return max(min(2 * _TRIAL, spp // 8), 4)

    def needs_larger_trial(self, noise: Mapping[str, Any], spp: int) -> bool:
        """Return whether to draw as many trial samples again before they decide."""
        drawn = noise["trials"]
        few = _TRIAL * drawn < min(self.needed(noise), spp)
        return bool(few and 2 * drawn <= min(_TRIALS, spp / 8))

    def needed(self, noise: Mapping[str, Any]) -> float:
        """Return the mean samples per pixel that reach the error."""
        assert self.error is not None, "an error was asked for"
        value = float(noise.get("surely", noise["value"]))
        return max(math.ceil(value / self.error**2), self.first)

    def spp(self, noise: Mapping[str, Any], most: int) -> int:
        """Return the mean samples per pixel that reach the error; with trials, at most `most`."""
        most = max(most - noise.get("trials", 0), self.first)
        if self.error is None:
            return most
        needed = int(self.needed(noise))
        if needed > most:
            expected = math.sqrt(noise["value"] / most)
            message = "an error of %g takes about %d spp; with %d, about %.2g is expected"
            _log.warning(message, self.error, needed, most, expected)
        return min(needed, most)

    def told(self, found: Interval[float]) -> dict[str, Any]:
        """Return the estimated error of a finished render, and whether it is what was asked for."""
        told: dict[str, Any] = {n: v for n, v in found.to_dict().items() if math.isfinite(v)}
        if self.percentile is not None:
            told["percentile"] = self.percentile
        if self.error is not None:
            told |= {"asked": self.error, "reached": found.value <= TOLERANCE * self.error}
        return told

    def not_reached(self, found: Interval[float], spp: float, most: int) -> str:
        """Return what to tell of an error that is larger than what was asked for."""
        assert self.error is not None, "an error was asked for"
        of = "" if self.percentile is None else f" of {self.percentile:g} % of the pixels"
        advice = f"spp above {most} goes on"
        if spp < 0.99 * most:
            advice = f"error={self.error**2 / found.value:.2g} goes on"
        return f"the error{of} is {found}, more than the {self.error:g} asked for; {advice}"


@dataclass(frozen=True)
class Look:
    """What samples tell of each pixel: the moments of those of even and of odd number.

    Attributes
    ----------
    halves
        Moments of both halves, shape (y, x, channel).
    """

    halves: tuple[Moments, Moments]

    @classmethod
    def of(cls, samples: Samples) -> Look:
        """Look at samples, some rows at a time."""
        rows = spans(samples.shape[0], _ROWS)
        return cls.of_blocks(samples.shape[:3], (((ys,), samples.read(ys)) for ys in rows))

    @classmethod
    def of_blocks(
        cls, shape: tuple[int, ...], blocks: Iterable[tuple[tuple[slice, ...], Reals]]
    ) -> Look:
        """Look at samples that come as (place, samples), shape (y, x, channel, sample)."""
        fields = np.zeros((2, 7, *shape))
        for where, x in blocks:
            for half, part in zip(fields, (x[..., ::2], x[..., 1::2]), strict=True):
                good = np.logical_not(is_bad(part).any(axis=2, keepdims=True))
                half[:, *where] = [*vars(Moments.of(part, good)).values()]
        return cls((Moments(*fields[0]), Moments(*fields[1])))

    def merge(self, other: Look) -> Look:
        """Return the look at both sets of samples together."""
        one, two = (a.merge(b) for a, b in zip(self.halves, other.halves, strict=True))
        return Look((one, two))

    @cached_property
    def whole(self) -> Moments:
        """Moments of all samples."""
        return self.halves[0].merge(self.halves[1])

    @cached_property
    def brightness(self) -> Floats:
        """Mean over the channels, shape (y, x), at least 0."""
        return np.asarray(np.maximum(self.whole.mean.mean(axis=-1), 0))


class _SquaredError(NamedTuple):
    """Expected squared error of one sample of each pixel, averaged over the channels, (y, x).

    `spread` is the variance of its estimate, and `halves` has both for each half of the samples.
    """

    value: Floats
    spread: Floats
    halves: tuple[tuple[Floats, Floats], tuple[Floats, Floats]]

    @classmethod
    def of(cls, look: Look, scale: Floats) -> _SquaredError:
        """Return the noise, relative to a scale of squared radiance (y, x, channel)."""
        of_each = [
            tuple(_over(values, scale) for values in (_variance(m), np.sqrt(_spread(m))))
            for m in (look.whole, *look.halves)
        ]
        whole, one, two = ((value, root**2) for value, root in of_each)
        return cls(*whole, (one, two))

    def likely(
        self,
        features: Mapping[str, Image],
        classes: Classes | None = None,
        width: float = _NEAR,
    ) -> _SquaredError:
        """Return it, drawn towards that of similar pixels around, as far as it is uncertain."""
        values, squares = (
            np.stack([half[i] for half in self.halves], axis=-1)[:, :, np.newaxis] for i in (0, 1)
        )
        found = _likely(values, squares, features, classes, width)
        one, two = (np.maximum(found.halves[..., 0, i], 0) for i in (0, 1))
        halves = (one, self.halves[0][1]), (two, self.halves[1][1])
        return _SquaredError(np.maximum(found.value[..., 0], 0), self.spread, halves)


def _variance(moments: Moments) -> Floats:
    return np.nan_to_num(moments.variance)


def _spread(moments: Moments) -> Floats:
    """Return the variance of the variance, from the fourth moment; 0 below two samples."""
    n = np.maximum(moments.count, 2)
    found = (moments.m4 / n - (n - 3) / (n - 1) * _variance(moments) ** 2) / n
    return np.asarray(np.where(moments.count > 1, np.maximum(found, 0), 0))


def _over(values: Floats, scale: Floats) -> Floats:
    """Return values over a scale, averaged over the channels; 0 where both are."""
    relative = np.divide(values, scale, out=np.zeros_like(values), where=scale > 0)
    return np.asarray(relative.mean(axis=-1))


def _relative(mean: Floats, of_scene: Floats, classes: Classes | None) -> Floats:
    """Return the squared radiance to which errors of pixels are relative, (y, x, channel)."""
    means = np.empty_like(mean)
    for part in _parts(classes, mean.shape[:2]):
        means[part] = of_scene[part].mean(axis=0)
    return relative_scale(mean, means)


def _noise_for_counts(look: Look, measure: str, classes: Classes | None) -> _SquaredError:
    """Return the noise by which others decide: relative to own means, so never very large.

    The square of a mean of samples is too large by the variance of the mean, which is subtracted.
    """
    if measure == "MSE":
        return _SquaredError.of(look, np.ones(look.whole.mean.shape))
    own, square = _mean_of(look.whole)
    mean = np.sqrt(np.maximum(own**2 - square, _LEFT * own**2))
    return _SquaredError.of(look, _relative(mean, own, classes))


def _noise_for_error(
    look: Look, measure: str, features: Mapping[str, Image], classes: Classes | None = None
) -> _SquaredError:
    """Return the noise from which the error of the image follows: relative to the likely mean.

    With `classes`, that of a class depends on its own samples only.
    """
    if measure == "MSE":
        return _noise_for_counts(look, measure, classes)
    own, square, likely = _likely_means(look, features, classes)
    # Of a Poisson number k of bright samples, E 1 / (k + 1) is nearly 1 / E k, and E 1 / k larger.
    means = np.sqrt(own**2 + square), _limited(likely.around, own, square)
    scales = (_relative(mean, own, classes) for mean in means)
    of_own, of_others = (np.divide(1, x, out=np.zeros_like(x), where=x > 0) for x in scales)
    mixed = likely.weight * of_own + (1 - likely.weight) * of_others
    return _SquaredError.of(look, np.divide(1, mixed, out=np.zeros_like(mixed), where=mixed > 0))


def _own_noise(look: Look, measure: str, features: Mapping[str, Image]) -> _SquaredError:
    """Return the likely noise of each pixel, in which its own samples have a share.

    It is relative to the likely mean, and to the error of the mean, so never very large: numbers
    that follow a few fireflies leave too few for all other pixels.
    """
    if measure == "MSE":
        return _noise_for_counts(look, measure, None).likely(features, width=_WIDE)
    own, square, likely = _likely_means(look, features, None)
    mean = np.sqrt(_limited(likely.value, own, square) ** 2 + square)
    return _SquaredError.of(look, _relative(mean, own, None)).likely(features, width=_WIDE)


def _likely_means(
    look: Look, features: Mapping[str, Image], classes: Classes | None
) -> tuple[Floats, Floats, _Likely]:
    """Return the mean of each pixel, its squared standard error, and likely means."""
    means, squares = (
        np.stack(values, axis=-1)
        for values in zip(*(_mean_of(half) for half in look.halves), strict=True)
    )
    return *_mean_of(look.whole), _likely(means, squares, features, classes)


def _mean_of(moments: Moments) -> tuple[Floats, Floats]:
    return moments.mean, _variance(moments) / np.maximum(moments.count, 1)


def _limited(likely: Floats, own: Floats, square: Floats) -> Floats:
    """Return likely means that differ from the own ones by one standard error at most.

    See Efron and Morris 1972, "Limiting the risk of Bayes and empirical Bayes estimators",
    doi:10.2307/2284711.
    """
    return np.clip(likely, own - np.sqrt(square), own + np.sqrt(square))


class _Likely(NamedTuple):
    """Likely values of each pixel, (y, x, channel), and by each half of its samples.

    `weight` is that of the pixel's own value; the rest is that of the values `around`.
    """

    value: Floats
    halves: Floats
    weight: Floats
    around: Floats


def _likely(
    values: Floats,
    squares: Floats,
    features: Mapping[str, Image],
    classes: Classes | None = None,
    width: float = _NEAR,
) -> _Likely:
    """Return likely values of each pixel.

    A value is drawn towards those of similar pixels around, from which it deviates by d. The
    deviation of the other half of the samples tells how much of d is the pixel's own: its sum, over
    the sum of d, among all pixels (of a class) that are alike. Alike are those whose d is as
    significant, or, where few bright samples make the mean, as many of them: its square, over its
    squared standard error. This is an empirical Bayes estimate (Efron and Morris 1975, "Data
    analysis using Stein's estimator and its generalizations", doi:10.2307/2285814) that assumes no
    family of distributions.

    Parameters
    ----------
    values, squares
        Estimates from both halves of the samples and their squared standard errors, shape (y, x,
        channel, half).
    features
        First-hit features, as far as they exist.
    classes
        Class of each pixel, if those of a class may depend on its own samples only.
    width
        Width of the weights of pixels around, in pixels.
    """
    own = values.mean(axis=-1)
    around = _around(own, features, width, _same(classes))
    away = values - around[..., np.newaxis]
    size, number = (
        np.divide(x**2, squares, out=np.full_like(away, np.inf), where=squares > 0)
        for x in (away, values)
    )
    few = np.digitize(number, _FEW)
    by_number = len(_ALIKE) + 1 + 2 * few + (away > 0)
    kinds = np.where(few < len(_FEW), by_number, np.digitize(np.copysign(size, away), _ALIKE))
    if classes is not None:
        kinds += (kinds.max() + 1) * classes[..., np.newaxis, np.newaxis]
    share = np.empty_like(away)
    for channel in range(own.shape[-1]):
        for half in (0, 1):
            kind = kinds[..., channel, half]
            this, other = (
                np.bincount(kind.ravel(), away[..., channel, i].ravel()) for i in (half, 1 - half)
            )
            of_kind = np.divide(other, this, out=np.zeros_like(this), where=this != 0)
            share[..., channel, half] = np.clip(of_kind, 0, 1)[kind]
    kept, total = (share * away**2).sum(axis=-1), (away**2).sum(axis=-1)
    of_half = np.divide(kept, total, out=np.ones_like(kept), where=total > 0)
    # Both halves together are as reliable as Spearman (1910) and Brown (1910) say.
    weight = 2 * of_half / (1 + of_half)
    halves = around[..., np.newaxis] + share * away
    return _Likely(around + weight * (own - around), halves, weight, around)


# --- pixels around a pixel ----------------------------------------------------------------------


def classes_of(height: int, width: int) -> Classes:
    """Return a random class of each pixel, shape (y, x); all classes are equally large.

    The numbers come from a generator whose stream no version of NumPy changes.
    """
    order = np.argsort(np.random.PCG64(0).random_raw(height * width), kind="stable")
    classes = np.empty(height * width, np.intp)
    classes[order] = np.arange(height * width) % _CLASSES
    return classes.reshape(height, width)


def _parts(classes: Classes | None, shape: tuple[int, ...]) -> Iterable[Any]:
    """Yield the pixels of each class that has any; all pixels without classes."""
    if classes is None:
        yield np.ones(shape, bool)
    else:
        yield from (classes == number for number in np.unique(classes))


def _same(classes: Classes | None) -> Callable[[Any, Any], Any]:
    """Return which pixels count for which others: those of the same class."""
    return lambda here, there: 1.0 if classes is None else classes[here] == classes[there]


def _scaled(features: Mapping[str, Image], shape: tuple[int, ...]) -> Floats:
    """Return features in units of the differences that matter, shape (y, x, number)."""
    found: list[Any] = [np.zeros((*shape, 1))]
    found += [features[name] / unit for name, unit in _UNITS.items() if name in features]
    if "depth" in features:
        found.append(np.log(np.maximum(features["depth"], 1e-6))[..., np.newaxis] / _DEPTH)
    return np.concatenate(found, axis=-1, dtype=np.float64)


def _around(
    values: Floats,
    features: Mapping[str, Image],
    width: float,
    counts: Callable[[Any, Any], Any] = lambda _here, _there: 1.0,
) -> Floats:
    """Return means over similar pixels around each pixel without itself, shape (y, x, value).

    A pixel around which none counts keeps its own values.

    Parameters
    ----------
    values
        Values of the pixels, shape (y, x, value).
    features
        First-hit features, as far as they exist.
    width
        Width of the weights, in pixels; they reach twice as far.
    counts
        Whether pixels count for others, from the places of both; it is symmetric.
    """
    height, across = values.shape[:2]
    likeness, reach = _scaled(features, (height, across)), int(2 * width)
    weights, total = np.zeros((height, across, 1)), np.zeros_like(values)
    down, beside = min(reach, height - 1), min(reach, across - 1)
    # Half of the offsets; each is that of two pixels from each other.
    offsets = [
        (y, x) for y in range(down + 1) for x in range(-beside, beside + 1) if (y, x) > (0, 0)
    ]
    for dy, dx in offsets:
        here, there = _overlap(dy, dx, height, across)
        unlike = ((likeness[here] - likeness[there]) ** 2).sum(axis=-1)
        near = math.exp(-(dy * dy + dx * dx) / (2 * width**2))
        weight = (near * (np.exp(-unlike / 2) + _UNLIKE) * counts(here, there))[..., np.newaxis]
        for one, two in ((here, there), (there, here)):
            weights[one] += weight
            total[one] += weight * values[two]
    return np.where(weights > 0, total / np.where(weights > 0, weights, 1), values)


def _overlap(dy: int, dx: int, height: int, width: int) -> tuple[Any, Any]:
    """Return where pixels have another pixel at an offset, and where the other pixels are."""
    here = tuple(slice(max(0, -d), max(0, n - max(0, d))) for d, n in ((dy, height), (dx, width)))
    there = tuple(slice(max(0, d), max(0, n + min(0, d))) for d, n in ((dy, height), (dx, width)))
    return here, there


# --- what is decided ----------------------------------------------------------------------------


def density_of(
    needs: Floats,
    powers: tuple[float, ...] = _POWERS["relMSE"],
    least: float = 1 / _SHARE,
    classes: Classes | None = None,
) -> Floats:
    """Return the number of samples of each pixel over the mean of all, shape (y, x).

    Parameters
    ----------
    needs
        What decides: the expected squared error of one sample, radiance and, if it is known, what a
        sample takes, shape (y, x, number).
    powers
        Power of each.
    least
        The smallest density.
    classes
        Class of each pixel; the densities of each class have a mean of 1.
    """
    density = np.ones(needs.shape[:2])
    for part in _parts(classes, density.shape):
        if (mean := needs[part].mean(axis=0)).all():
            wanted = (needs[part] / mean + _LITTLE) ** powers
            density[part] = _bounded(wanted.prod(axis=-1), least)
    return density


def _bounded(wanted: Floats, least: float) -> Floats:
    """Return numbers in proportion to the wanted ones, with a mean of 1, within bounds."""
    low, high = 0.0, _MOST / float(wanted[wanted > 0].min())
    for _ in range(60):
        middle = (low + high) / 2
        is_less = np.clip(middle * wanted, least, _MOST).mean() < 1
        low, high = (middle, high) if is_less else (low, middle)
    return np.asarray(np.clip(high * wanted, least, _MOST))


def decided(
    look: Look, how: Adaptive, features: Mapping[str, Image], costs: SampleCosts | None = None
) -> tuple[Image, dict[str, Any]]:
    """Return the density of a render, and its noise.

    The noise is the expected squared error of the image with one sample per pixel on average, and
    the ends of its interval if there is one. With n samples, the error is the root of the noise
    over n.

    Parameters
    ----------
    look
        At the first samples of all pixels; with `how.error`, at trial samples, which are not kept.
    how
        The plan of the render.
    features
        First-hit features, as far as they exist.
    costs
        What samples take, if they were timed: with `how.error`, trial samples. Pixels that are
        twice as costly as others get fewer samples by the root of 2.
    """
    # The error is a relative one, whatever it is that counts minimise.
    of_error = _noise_for_error(look, "relMSE", features)
    seconds = [] if costs is None else [_known(costs.seconds)]
    if how.error is None:
        density = _by_others(look, how, features, seconds)
        found, surely = _squared(of_error.value / density, of_error.spread / density**2)
    else:
        needs, likely = _own_noise(look, how.measure, features), of_error.likely(features)
        even = of_error.value.mean()
        if how.percentile is not None:
            even = np.percentile(likely.value, how.percentile)
        least = min(max(how.first * how.error**2 / even, how.least), 1.0) if even > 0 else 1.0
        density, one, two = (
            density_of(np.stack([of, *seconds], axis=-1), _NEYMAN[: 1 + len(seconds)], least)
            for of in (needs.value, *(half for half, _ in needs.halves))
        )
        each = likely.value / density
        if how.percentile is None:
            # Too small, since noise and number follow the same chance; and too large, since a half
            # that decides for the other one knows less than both. The truth lies between.
            low = of_error.value / density
            each = (of_error.halves[0][0] / two + of_error.halves[1][0] / one) / 2
            each *= np.sqrt(low.mean() / each.mean()) if each.any() else 1.0
        found, surely = _squared(each, of_error.spread / density**2, how.percentile)
    known: dict[str, Any] = {n: v for n, v in found.to_dict().items() if math.isfinite(v)}
    if how.error is not None:
        known["surely"] = surely
    if how.percentile is not None:
        known["percentile"] = how.percentile
    return density.astype(np.float32), known


def _known(seconds: Floats) -> Floats:
    """Return times of samples, their mean where they are unknown."""
    known = np.isfinite(seconds)
    return np.where(known, seconds, seconds[known].mean() if known.any() else 1.0)


def _by_others(
    look: Look, how: Adaptive, features: Mapping[str, Image], seconds: Sequence[Floats] = ()
) -> Floats:
    """Return densities of which the samples of other classes decide those of a class."""
    classes = classes_of(*look.brightness.shape)
    noise = _noise_for_counts(look, how.measure, classes).value
    needs = _around(
        np.stack([noise, look.brightness, *seconds], axis=-1),
        features,
        _WIDE,
        lambda here, there: classes[here] != classes[there],
    )
    powers = (*_POWERS[how.measure], *_NEYMAN[1 : 1 + len(seconds)])
    return density_of(needs, powers, how.least, classes)


def more(look: Look, how: Adaptive, features: Mapping[str, Image]) -> Floats | None:
    """Return by what factor each pixel needs more samples, shape (y, x); None if none does.

    The other classes of pixels decide for a class, by the mean of their errors. The largest of them
    counts as the next one, so that noise that only one class has, as a single pixel does, makes no
    other class go on in vain.

    Parameters
    ----------
    look
        At samples whose numbers are independent of them, so that trial samples decided.
    how, features
        As for `decided`.
    """
    assert how.error is not None, "an error was asked for"
    classes = classes_of(*look.brightness.shape)
    noise = _noise_for_error(look, "relMSE", features, classes)
    if how.percentile is not None:
        noise = noise.likely(features, classes)
    each = noise.value / np.maximum(look.whole.count.min(axis=-1), 1)
    if each.size < 2 * _CLASSES:
        return None

    # What one class alone has counts as much as what the next one has.
    needs = np.array(
        [
            part.mean() if how.percentile is None else np.percentile(part, how.percentile)
            for part in (each[classes == number] for number in range(_CLASSES))
        ]
    )
    factors = np.empty(_CLASSES)
    for number in range(_CLASSES):
        others = np.sort(np.delete(needs, number))
        factors[number] = np.minimum(others, others[-2]).mean() / how.error**2
    factors = np.where(factors > TOLERANCE**2, factors, 1.0)
    return factors[classes] if (factors > 1).any() else None


def _squared(
    each: Floats, spread: Floats, percentile: float | None = None
) -> tuple[Interval[float], float]:
    """Return the squared error of an image.

    Also the squared error that the image has at most, or a tenth more, in nine of ten renders: that
    of few pixels may by chance be much larger than is expected.

    Parameters
    ----------
    each, spread
        Expected squared errors of the pixels, and the variances of their estimates, shape (y, x).
    percentile
        As for `error_of`.
    """
    # Loads SciPy, which a render need not wait for.
    from scipy import stats

    from chdstat._core.resampling import LEVEL, Blocks, Interval, quantile_of

    if percentile is not None:
        found = quantile_of(each.ravel(), Blocks.grid(*each.shape), percentile / 100)
        return found, found.value
    if not (value := float(each.mean())) > 0:
        return Interval(0.0, 0.0, 0.0), 0.0
    total = each.sum() ** 2
    chance = total / np.square(each).sum()
    of_spread = 2 * total / max(float(spread.sum()), 1e-12 * total)
    low, high = value * stats.f.ppf([(1 - LEVEL) / 2, (1 + LEVEL) / 2], chance, of_spread)
    surely = value * max(float(stats.chi2.ppf(_SURE, chance) / chance) / TOLERANCE**2, 1.0)
    return Interval(value, float(low), float(high)), surely


def expected_error(attrs: Mapping[str, Any]) -> Interval[float] | None:
    """Return the error that was predicted when an adaptive render decided counts, or None.

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


def errors_told(attrs: Mapping[str, Any]) -> dict[str, Interval[float]]:
    """Return the predicted and the estimated error of an adaptive render, by name.

    Parameters
    ----------
    attrs
        Attributes of its samples; nothing is told of another render.
    """
    from chdstat._core.resampling import Interval

    found, expected = attrs.get("error"), expected_error(attrs)
    if found is None or expected is None:
        return {}
    about = "relative_error"
    if (percentile := found.get("percentile")) is not None:
        about += f"_of_{percentile:g}_%_of_pixels"
    estimated = Interval(*(found.get(name, math.nan) for name in ("value", "low", "high")))
    return {f"predicted_{about}": expected, f"estimated_{about}": estimated}


def error_of(
    samples: Samples | Look,
    measure: str = "relMSE",
    percentile: float | None = None,
    *,
    features: Mapping[str, Image] | None = None,
) -> Interval[float]:
    """Return the error of the mean image, estimated from its samples: the root of relMSE or MSE.

    It is too small if the variance of pixels comes from light that hardly any sample has found.

    Parameters
    ----------
    samples
        Independent samples, or a `Look` at them.
    measure
        "relMSE", whose root is the relative error that `chdstat.render` reaches, or "MSE".
    percentile
        Return the error that this percentage of the pixels does not exceed, such as 95, instead of
        the image's.
    features
        First-hit features, which tell similar pixels; None for those of the samples.

    Returns
    -------
    Interval
        The error, and a 95 % interval for the error of this image.

    Examples
    --------
    >>> x = np.random.default_rng(0).exponential(size=(32, 32, 1, 100))  # of variance 1
    >>> error_of(Samples.from_array(x), "MSE")
    Interval(value=...)
    """
    if isinstance(samples, Samples):
        features = samples.features if features is None else features
        samples = Look.of(samples)
    noise = _noise_for_error(samples, measure, features or {})
    if percentile is not None:
        noise = noise.likely(features or {})
    number = np.maximum(samples.whole.count.min(axis=-1), 1)
    found, _ = _squared(noise.value / number, noise.spread / number**2, percentile)
    return found.root()
