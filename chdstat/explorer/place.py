"""Statistics of one place, each computed when it is first used.

A place is a pixel, or a region whose samples are pooled. Luminance is treated as one more channel,
so each fit, test and mode is computed once for all of them. `goodness` tests by bootstrap whether
each family describes a place; `suggest` finds pixels worth a first look. Both take longer than a
click: they report their progress, and the caller may stop them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from itertools import product

import numpy as np
import numpy.typing as npt

from chdstat import inference
from chdstat._core.arrays import (
    Floats,
    is_bad,
    is_null,
    luminance,
    take_rows,
)
from chdstat._core.moments import Moments
from chdstat._core.positive import PositivePart
from chdstat.explorer.sources import MOST_POOLED, Overall, Sampled
from chdstat.explorer.view import PixelIndex
from chdstat.fit import Fit, Mixture
from chdstat.fit.families import FAMILIES, FamilyFit, get_family
from chdstat.fit.goodness_of_fit import FitTest, GoodnessOfFit
from chdstat.fit.selection import FEWEST_SHOWN, FamilySelection, Selection
from chdstat.fit.tail import Tail, TailIndex
from chdstat.inference.averages import NormalityOfMeans
from chdstat.inference.modes import Modality, ModalMixture, Modes
from chdstat.inference.normality import Normality
from chdstat.patterns import Patterns, Thresholds
from chdstat.patterns.classification import Classification
from chdstat.patterns.definitions import firefly_limit
from chdstat.summary.histograms import Histogram, histogram
from chdstat.summary.runner import measured
from chdstat.viz.chd import log_support

_OF_FIRST = {"part", "_positive", "patterns"}
"""Attributes that depend on the first `MOST_POOLED` samples alone."""
RESAMPLES = 199
_POINTS = 96
MOST_TESTED = 4096
"""Most samples that are tested: replicates for all samples of a region would take minutes."""

HOLDS = {0: "fails", 1: "cannot tell", 2: "holds"}
"""Whether the error bar of so many samples holds, by the codes of `error_bar`."""

_FittedCurve = tuple[str, Callable[[Floats], Floats], Callable[[Floats], Floats]]
"""Name of a fit, and density and quantiles of its positive part."""


class PlaceStatistics:
    """Statistics of the samples of one place.

    Parameters
    ----------
    x
        Linear radiance, shape (channel, sample), with 1 or 3 channels.
    channels
        Their names.

    Attributes
    ----------
    rows
        The channels, then luminance where there are several of them, shape (row, sample), float32.
    names
        Of the rows.
    null, bad
        Which samples are null and which are bad as a whole, shape (sample,).
    spp, fitted_spp
        Samples, good or bad, and how many of them fits look at.
    """

    def __init__(self, x: npt.NDArray[np.float32], channels: tuple[str, ...]) -> None:
        self.channels = channels
        self._positive: dict[tuple[str, int], _FittedCurve | None] = {}
        self.bad = np.asarray(is_bad(x).any(axis=0))
        self.null = is_null(x) & ~self.bad
        self.names = channels
        self.rows = x
        if len(x) > 1:
            with np.errstate(invalid="ignore", over="ignore"):
                self.rows = np.concatenate([x, luminance(x)[np.newaxis]])
            self.names = (*channels, "luminance")
        self.spp = int(x.shape[1])
        self.fitted_spp = min(self.spp, MOST_POOLED)

    @property
    def samples(self) -> npt.NDArray[np.float32]:
        """Samples without luminance, shape (channel, sample)."""
        return self.rows[: len(self.channels)]

    def row(self, channel: str) -> int:
        """Return the row of 'luminance' or of the number of a channel."""
        if channel == "luminance":
            return len(self.names) - 1
        return min(int(channel), len(self.channels) - 1)

    @cached_property
    def null_share(self) -> float:
        """Share of nulls among the good samples; NaN without any."""
        good = self.spp - int(self.bad.sum())
        return float(self.null.sum() / good) if good else float("nan")

    @cached_property
    def moments(self) -> Moments:
        """Moments of the good samples, of each row."""
        return Moments.of(self.rows, ~self.bad)

    @cached_property
    def part(self) -> PositivePart:
        """The positive samples of each row, of the samples that are fitted."""
        x = self.samples[:, : self.fitted_spp]
        return PositivePart.of_pixels(x, rows="both")

    @property
    def selection(self) -> Selection:
        """The families of each row."""
        return measured(self.part, FamilySelection())

    @property
    def tail(self) -> Tail:
        """The tail of each row."""
        return measured(self.part, TailIndex())

    @property
    def mixture(self) -> Mixture:
        """The log-normal mixture of each row, by which its modes are found."""
        return measured(self.part, ModalMixture())

    @property
    def modes(self) -> Modality:
        """The modes of each row, which are found with its mixture."""
        measured(self.part, ModalMixture())
        return measured(self.part, Modes())

    @cached_property
    def constant(self) -> npt.NDArray[np.bool_]:
        """Whether the positive samples of each row are equal, but for what rounding leaves."""
        spread = self.part.log_statistics
        return np.asarray(spread.log_variance <= Thresholds().constant ** 2) & (spread.n > 1)

    @cached_property
    def histograms(self) -> dict[str, Histogram]:
        """Linear and log10 histogram of each row, by scale."""
        null, bad = (np.broadcast_to(mask, self.rows.shape) for mask in (self.null, self.bad))
        linear = histogram(self.rows, scale="linear", null=null, bad=bad)
        log = histogram(self.rows, support=log_support(self.rows), null=null, bad=bad)
        return {"linear": linear, "log": log}

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns of luminance, at the level of a single pixel."""
        return measured(self.part.rows(-1), Classification())

    @property
    def is_firefly(self) -> bool:
        """Whether one sample dominates luminance."""
        return bool(self.patterns.flags["firefly_dominated"])

    @property
    def gaussianity(self) -> inference.Gaussianity:
        """Anderson-Darling's test of the logarithms and of the samples, shape (row, 2, 1)."""
        tests = Normality(("log", "linear"), ("anderson-darling",))
        return measured(self.part, tests)

    @property
    def means(self) -> inference.GaussianityOfMeans | None:
        """Normality of averages, of each row; None with fewer samples than averages to test."""
        tests = NormalityOfMeans.of(self.fitted_spp)
        return None if tests is None else measured(self.part, tests)

    def averages(self, n: int) -> Floats:
        """Return the averages of consecutive good samples, n each, shape (row, average)."""
        good = self.rows if not self.bad.any() else self.rows[:, ~self.bad]
        count = good.shape[1] // n
        cut = good[:, : count * n].reshape(len(good), count, n)
        return np.asarray(cut.mean(axis=-1, dtype=np.float64))

    @cached_property
    def running(self) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Spp, running means and their standard errors, shapes (point,) and (row, point)."""
        good = np.flatnonzero(~self.bad)
        if good.size < 2:
            return np.empty(0, np.int64), *np.empty((2, len(self.rows), 0))
        at = np.unique(np.geomspace(2, good.size, min(_POINTS, good.size)).astype(np.int64))
        x = self.rows[:, good].astype(np.float64)
        # Deviations from the mean of all keep the sum of squares from cancelling.
        center = x.mean(axis=-1, keepdims=True)
        x -= center
        with np.errstate(over="ignore", invalid="ignore"):
            total, squares = np.cumsum(x, axis=-1)[:, at - 1], np.cumsum(x * x, axis=-1)[:, at - 1]
            mean = total / at
            variance = np.maximum(squares / at - mean**2, 0) * at / (at - 1)
        return at, mean + center, np.sqrt(variance / at)

    def fit(self, family: str, row: int) -> Fit | Mixture | None:
        """Return a fit of one row by the name of its family, 'best' or 'mixture'.

        None where the samples are constant, as families then describe rounding, or too few.
        """
        if self.constant[row] or self.part.n[row] < FEWEST_SHOWN:
            return None
        selection = self.selection
        if family == "best":
            family = str(selection.names[row])
        if not family:
            return None
        if family == "mixture":
            return take_rows(self.mixture, row, axis=0)
        found = selection.fits.get(family)
        if found is None:
            found = measured(self.part, FamilyFit(FAMILIES[family]))
        return take_rows(found, row, axis=0)

    def positive(self, family: str, row: int) -> _FittedCurve | None:
        """Return name, density and quantiles of the positive part of a fit, None without a fit.

        They are kept: histograms and quantiles need the same, and SciPy takes longer to make a
        distribution than to evaluate it.
        """
        if (family, row) not in self._positive:
            found, made = self.fit(family, row), None
            if isinstance(found, Mixture):
                made = "mixture", found.pdf, partial(_positive_quantiles, found)
            elif found is not None:
                frozen = get_family(found.family).distribution(found.parameters)
                made = found.family, frozen.pdf, frozen.ppf
            self._positive[family, row] = made
        return self._positive[family, row]

    def take_over(self, earlier: PlaceStatistics) -> None:
        """Keep what was found of the first samples of this place, where they are the same."""
        if earlier.fitted_spp == self.fitted_spp:
            vars(self).update({k: v for k, v in vars(earlier).items() if k in _OF_FIRST})


def _positive_quantiles(mixture: Mixture, level: Floats) -> Floats:
    zero = np.float64(mixture.zero_share)
    return mixture.ppf(zero + (1 - zero) * level)


def error_bar(tail: Tail) -> Floats:
    """Return codes of `HOLDS`, by the pixel's own samples; NaN where nothing is known."""
    verdicts = tail.variance_suspect, tail.variance_unidentified, tail.variance_trusted
    return np.asarray(np.select(verdicts, [0.0, 1.0, 2.0], np.nan))


def goodness(
    place: PlaceStatistics, step: Callable[[float], None], *, resamples: int = RESAMPLES
) -> dict[str, tuple[Floats, Floats, npt.NDArray[np.int8]]]:
    """Test every family by the parametric bootstrap, see `chdstat.fit.goodness`.

    Parameters
    ----------
    place
        The place to test; of more than 4096 samples, the first.
    step
        Called with the share that is done before each family; whatever it raises ends the test.
    resamples
        Replicates B.

    Returns
    -------
    dict
        By family, p-values by Anderson and Darling's A², NaN where it could not be fitted, and
        Kolmogorov's D, the largest gap of the distribution functions, and `Reason` codes of what is
        missing, all of shape (row,).
    """
    part = PositivePart.of_pixels(place.samples[:, :MOST_TESTED], rows="both")
    result = {}
    for i, name in enumerate(FAMILIES):
        step(i / len(FAMILIES))
        tests: tuple[FitTest, ...] = ("anderson-darling", "kolmogorov-smirnov")
        found = measured(part, GoodnessOfFit(FAMILIES[name], tests, resamples, i))
        result[name] = found.p_value[:, 0], found.effect[:, 1], found.reason[:, 0]
    return result


# --- suggestions --------------------------------------------------------------------------------

_GRID = 12
"""Pixels along the longer side of the image that are looked at."""
_SPP = 512
_AT_ONCE = 12
_SUGGESTED = (("long tail", ("long_tail",)), ("bimodal", ("bimodal", "multimodal")),
              ("null-heavy", ("null_heavy",)))  # fmt: skip
"""Names, and the patterns that they stand for."""


def first_pixel(overall: Overall) -> PixelIndex:
    """Return the pixel with the brightest firefly, or the centre of an image without any.

    Examples
    --------
    >>> first_pixel(Overall.empty(5, 9, 3))
    (2, 4)
    """
    count = np.nan_to_num(overall.good_count).astype(np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = overall.extreme / (overall.extreme + overall.others)
        is_firefly = share > firefly_limit(count, Thresholds())
    height, width = share.shape
    if not is_firefly.any():
        return height // 2, width // 2
    brightest = int(np.argmax(np.where(is_firefly, overall.extreme, -np.inf)))
    return brightest // width, brightest % width


def suggest(source: Sampled) -> Iterator[tuple[float, list[tuple[str, PixelIndex]]]]:
    """Look for a pixel with a long tail, one with several modes and one that is null-heavy.

    Yields the progress, and in the end the pixels. They are chosen from a grid by the surest
    pattern: the largest lower end of the interval of its statistic. Patterns that no pixel of the
    grid has are left out.

    Parameters
    ----------
    source
        Where samples come from; the first 512 of each pixel are read or drawn.
    """
    cell = max(1.0, max(source.size) / _GRID)
    numbers = (max(1, int(length / cell)) for length in source.size)
    ys, xs = (
        ((np.arange(k) + 0.5) * length / k).astype(int).tolist()
        for k, length in zip(numbers, source.size, strict=True)
    )
    pixels = list(product(ys, xs))
    sure: dict[str, list[Floats]] = {name: [] for name, _ in _SUGGESTED}
    for i in range(0, len(pixels), _AT_ONCE):
        yield i / len(pixels), []
        part = PositivePart.of_pixels(source.some(pixels[i : i + _AT_ONCE], _SPP), rows="luminance")
        found = measured(part, Classification())
        for name, patterns in _SUGGESTED:
            lower = [
                np.where(found.flags[p] & (part.n > 0), found.intervals[p][..., 0], -np.inf)
                for p in patterns
            ]
            sure[name].append(np.fmax.reduce(lower, initial=-np.inf))
    chosen: dict[str, PixelIndex] = {}
    for name, parts in sure.items():
        score = np.concatenate(parts)
        score[[pixels.index(p) for p in chosen.values()]] = -np.inf
        if score.max() > -np.inf:
            chosen[name] = pixels[int(score.argmax())]
    yield 1.0, list(chosen.items())
