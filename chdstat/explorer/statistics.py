"""Statistics of one place, computed when first asked for.

A place is a pixel, or a region whose samples are pooled. Luminance goes along as one more channel,
so that each fit, test and mode is found once for all of them. `goodness` tests by bootstrap
whether each family describes a place. It takes seconds, not the time of a click: it reports its
progress, and its caller may end it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator, is_bad, is_null, luminance, spans, take_rows
from chdstat._core.moments import Moments
from chdstat._core.positive import PositivePart
from chdstat.fit import Fit, Mixture, Selection, Tail
from chdstat.fit.families import FAMILIES, SELECTED, get_family
from chdstat.fit.goodness_of_fit import FitTest, goodness_of_part
from chdstat.fit.mle import fit_part
from chdstat.inference import N_MEANS, Gaussianity, GaussianityOfMeans, Modality, sizes_of_means
from chdstat.inference.normality import gaussianity_of_part
from chdstat.inference.normality_of_means import means_of_block
from chdstat.patterns import Patterns
from chdstat.patterns.classification import PixelFits
from chdstat.summary.histograms import Histogram, histogram

__all__ = ["MOST_FITTED", "RESAMPLES", "FamilyGoodness", "PlaceStatistics", "Positive", "goodness"]

RESAMPLES = 199
_PIECE = 20
_MOST = 4096
"""Samples that are tested: replicates of a region's would take minutes."""
_TESTS: tuple[FitTest, ...] = ("anderson-darling", "kolmogorov-smirnov")

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FamilyGoodness:
    """How well each family describes the rows of a place.

    Attributes
    ----------
    families
        Names.
    p_value
        Bootstrap p-values by Anderson and Darling's A², shape (family, row); NaN where a family
        could not be fitted.
    distance
        Kolmogorov's D, the largest gap of the distribution functions, shape (family, row).
    resamples
        Replicates B asked for.
    n
        Samples that were tested, nulls among them.
    """

    families: tuple[str, ...]
    p_value: Floats
    distance: Floats
    resamples: int
    n: int


def goodness(
    place: PlaceStatistics,
    step: Callable[[float], None],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> FamilyGoodness:
    """Test every family by the parametric bootstrap, see `chdstat.fit.goodness`.

    Parameters
    ----------
    place
        What is tested; of more than 4096 samples, the first.
    step
        Told the share that is done before each piece; whatever it raises ends the test.
    resamples, seed
        Replicates B, and their seed.
    """
    n = min(place.spp, _MOST)
    part = PositivePart.of_pixels(place.rows[: len(place.channels), :n], rows="both")
    # One generator for all pieces: their replicates are as independent as those of one call.
    rng = generator(seed)
    pieces = list(spans(resamples, _PIECE))
    p_values, distances = [], []
    for i, name in enumerate(SELECTED):
        farther = np.zeros(part.n.shape)
        drawn = np.zeros(part.n.shape)
        fit = fit_part(part, FAMILIES[name])
        for j, piece in enumerate(pieces):
            step((i + j / len(pieces)) / len(SELECTED))
            count = piece.stop - piece.start
            found = goodness_of_part(part, fit, tests=_TESTS, resamples=count, seed=rng)
            # p = (b + 1) / (B + 1) of the piece gives its b back.
            replicates = found.resamples[:, 0]
            farther += np.nan_to_num(found.p_value[:, 0] * (replicates + 1) - 1)
            drawn += replicates
        p_values.append(np.where(drawn > 0, (farther + 1) / (drawn + 1), np.nan))
        distances.append(found.effect[:, 1])
    return FamilyGoodness(tuple(SELECTED), np.stack(p_values), np.stack(distances), resamples, n)


MOST_FITTED = 2**15
"""Samples that fits, tests and modes look at; moments and histograms take all of them."""

_OF_FIRST = {"fitted", "_positive", "_further_fits", "patterns", "gaussianity", "means"}
"""What is computed of the first `MOST_FITTED` samples alone."""


@dataclass(frozen=True)
class Positive:
    """The positive part of a fit: what histograms and quantiles are compared with.

    Attributes
    ----------
    family
        Its name; "mixture" for a mixture.
    pdf, ppf
        Density and quantiles; both integrate to 1 over positive radiance.
    """

    family: str
    pdf: Callable[[Floats], Floats]
    ppf: Callable[[Floats], Floats]

    @classmethod
    def of(cls, found: Fit | Mixture) -> Positive:
        """Return that of a fit or of a mixture of a single row."""
        if isinstance(found, Fit):
            frozen = get_family(found.family).distribution(found.parameters)
            return cls(found.family, frozen.pdf, frozen.ppf)
        zero = np.float64(found.zero_share)
        return cls("mixture", found.pdf, lambda level: found.ppf(zero + (1 - zero) * level))


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
    """

    def __init__(self, x: npt.NDArray[np.float32], channels: tuple[str, ...]) -> None:
        self.channels = channels
        self._positive: dict[tuple[str, int], Positive | None] = {}
        self._further_fits: dict[str, Fit] = {}
        self.bad = np.asarray(is_bad(x).any(axis=0))
        self.null = is_null(x) & ~self.bad
        self.names = channels
        self.rows = x
        if len(x) > 1:
            with np.errstate(invalid="ignore", over="ignore"):
                self.rows = np.concatenate([x, luminance(x)[np.newaxis]])
            self.names = (*channels, "luminance")

    @property
    def spp(self) -> int:
        """Samples, good or bad."""
        return int(self.rows.shape[1])

    @property
    def fitted_spp(self) -> int:
        """Samples that fits look at."""
        return min(self.spp, MOST_FITTED)

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
    def fitted(self) -> PixelFits:
        """Fits of each row."""
        some = self.rows[: len(self.channels), : self.fitted_spp]
        return PixelFits(PositivePart.of_pixels(some, rows="both"))

    @property
    def part(self) -> PositivePart:
        """Positive part of each row, of the samples that are fitted."""
        return self.fitted.part

    @cached_property
    def linear(self) -> Histogram:
        """Linear histogram of each row."""
        return self._histogram("linear")

    @cached_property
    def log(self) -> Histogram:
        """Log10 histogram of each row."""
        return self._histogram("log")

    @property
    def selection(self) -> Selection:
        """The families and which of them is best, of each row."""
        return self.fitted.selection

    @property
    def tail(self) -> Tail:
        """Tail of each row."""
        return self.fitted.tail

    @property
    def mixture(self) -> Mixture:
        """The log-normal mixture behind the modes, of each row."""
        return self.fitted.mixture

    @property
    def modes(self) -> Modality:
        """Modes of each row."""
        return self.fitted.modes

    @cached_property
    def patterns(self) -> Patterns:
        """Patterns of luminance, at the level of a single pixel."""
        return self.fitted.patterns()

    @cached_property
    def gaussianity(self) -> Gaussianity:
        """Anderson-Darling's test of the logarithms and of the samples, shape (row, 2, 1)."""
        return gaussianity_of_part(self.part, ("log", "linear"))

    @cached_property
    def means(self) -> GaussianityOfMeans | None:
        """Normality of averages, of each row; None with fewer samples than averages to test."""
        if self.fitted_spp < N_MEANS:
            return None
        block = np.where(self.bad, np.float32(np.nan), self.rows)[:, : self.fitted_spp]
        return means_of_block(block, sizes_of_means(self.fitted_spp))

    def averages(self, n: int) -> Floats:
        """Return the averages of consecutive good samples, n each, shape (row, average)."""
        good = self.rows if not self.bad.any() else self.rows[:, ~self.bad]
        count = good.shape[1] // n
        cut = good[:, : count * n].reshape(len(good), count, n)
        return np.asarray(cut.mean(axis=-1, dtype=np.float64))

    def running(self, points: int = 96) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
        """Return spp, running means and their standard errors, shapes (point,) and (row, point)."""
        good = np.flatnonzero(~self.bad)
        if good.size < 2:
            return np.empty(0, np.int64), *np.empty((2, len(self.rows), 0))
        at = np.unique(np.geomspace(2, good.size, min(points, good.size)).astype(np.int64))
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
        """Return a fit of one row by the name of its family, 'best' or 'mixture'."""
        if family == "mixture":
            return take_rows(self.mixture, row, axis=0)
        if family == "best":
            index = int(self.selection.best[row])
            if index < 0:
                return None
            family = self.selection.families[index]
        fits = self.selection.fits if family in self.selection.fits else self._further_fits
        if family not in fits:
            self._further_fits[family] = fit_part(self.part, FAMILIES[family])
        return take_rows(fits[family], row, axis=0)

    def positive(self, family: str, row: int) -> Positive | None:
        """Return the distribution of the positive part of a fit, None where there is none.

        It is remembered: histograms and quantiles ask for the same, and SciPy takes longer to make
        one than to evaluate it.
        """
        if (family, row) not in self._positive:
            found = self.fit(family, row)
            self._positive[family, row] = None if found is None else Positive.of(found)
        return self._positive[family, row]

    def take_over(self, earlier: PlaceStatistics) -> None:
        """Keep what was found of the first samples of this place, where they are the same."""
        if earlier.fitted_spp == self.fitted_spp:
            vars(self).update({k: v for k, v in vars(earlier).items() if k in _OF_FIRST})

    def arrays(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return the samples and which of them are null or bad, for export."""
        return {"radiance": self.rows[: len(self.channels)], "null": self.null, "bad": self.bad}

    def _histogram(self, scale: Any) -> Histogram:
        shape = self.rows.shape
        null, bad = (np.broadcast_to(mask, shape) for mask in (self.null, self.bad))
        return histogram(self.rows, scale=scale, null=null, bad=bad)
