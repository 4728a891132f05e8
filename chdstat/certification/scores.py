"""Scores of answers on certified pixels: of this library's own, and of anybody's.

`hold` scores intervals, `separation` scores a warning that error bars may not hold, and `bench`
scores what this library answers from a few samples. All errors are 95 % intervals over pixels; the
channels of a pixel stay together, since they share paths.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Floats, Mask, plain, whole
from chdstat._core.display import Card, Tabled
from chdstat._core.moments import Moments
from chdstat._core.resampling import (
    Z_95,
    Blocks,
    Interval,
    interval_of,
    mean_of,
    quantile_of,
    wilson,
)
from chdstat.certification.certifying import FRESH_SEED, certified, draw
from chdstat.certification.reduction import SIZES
from chdstat.errors import InputError, Reason
from chdstat.fit import select, tail_index
from chdstat.inference import gaussianity_of_means, modality

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.fit.families import Fit
    from chdstat.rendering.backend import Backend

COUNTS = (128, 512, 2048)
"""Numbers of samples that are judged by default."""
HOLDS, FAILS = 0.92, 0.85
"""Error bars hold where they cover this much or more, and fail where this or less."""
_RGB = ("R", "G", "B")
_PREDICTS = 1379
"""Fewest samples from which N is predicted, see `chdstat.inference.gaussianity_of_means`."""
_CLEAR_EXCESS = 0.08
"""Excess mass of the second mode from which on a pixel clearly has two: the least that
`chdstat.modality` counts."""
_RANKS = (0.05, 0.99)
"""Least and largest quantile at which families are compared."""


# --- what anybody may score ---------------------------------------------------------------------


def hold(low: npt.ArrayLike, high: npt.ArrayLike, true: xr.DataArray) -> Interval[float]:
    """Return the share of intervals that hold certified numbers.

    Parameters
    ----------
    low, high
        Ends of the intervals, with the shape of `true`; NaN where a method has no answer, which
        does not count.
    true
        Certified numbers over (pixel, ...), NaN where there are none: a variable of
        `chdstat.certified`.

    Returns
    -------
    Interval
        The share, and its 95 % interval over pixels.

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> import chdstat as chd
    >>> truth = chd.certified()["mean"]
    >>> print(hold(0.9 * truth, 1.1 * truth, truth))
    1.00 [0.993, 1.00]
    """
    ends = _like(true, low=low, high=high)
    inside = (ends["low"] <= true.to_numpy()) & (true.to_numpy() <= ends["high"])
    known = np.isfinite(true.to_numpy()) & np.isfinite(ends["low"]) & np.isfinite(ends["high"])
    return _share(inside, known, true)


def separation(warning: npt.ArrayLike, coverage: xr.DataArray) -> Interval[float]:
    """Return how well a warning parts pixels whose error bars fail from those whose bars hold.

    It is the area under the curve of hits against false alarms: the probability that a pixel where
    error bars fail is more doubtful than one where they hold. 0.5 is chance, 1 is perfect. Pixels
    with a coverage between 0.85 and 0.92 do not count.

    Parameters
    ----------
    warning
        Larger where error bars are more doubtful, with the shape of `coverage`; NaN counts as no
        warning.
    coverage
        Certified coverage over (pixel, ...) for the number of samples that the warning saw:
        ``truth.coverage.sel(size=n)``.

    Returns
    -------
    Interval
        The area, and its 95 % interval over pixels.

    Raises
    ------
    InputError
        If the shapes differ.

    References
    ----------
    Hanley and McNeil, "The meaning and use of the area under a receiver operating characteristic
    curve", 1982, doi:10.1148/radiology.143.1.7063747.

    Examples
    --------
    >>> import chdstat as chd
    >>> coverage = chd.certified().coverage.sel(size=512)
    >>> print(separation(-coverage, coverage))
    1.00
    """
    values = _like(coverage, warning=warning)["warning"]
    values = np.where(np.isnan(values), -np.inf, values)
    held = coverage.to_numpy()
    fails, holds = held <= FAILS, held >= HOLDS
    judged = (fails | holds).reshape(len(held), -1)
    row = np.nonzero(judged)[0]
    order = np.argsort(values.reshape(judged.shape)[judged], kind="stable")
    ordered = values.reshape(judged.shape)[judged][order]
    if not fails.any() or not holds.any():
        return Interval.unknown()
    first = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    failing = fails.reshape(judged.shape)[judged][order]
    kept, of_pixel = np.unique(row, return_inverse=True)
    blocks = _pixels(coverage)[kept]
    place = of_pixel[order]

    def area(weights: Floats) -> Floats:
        weight = weights[:, place]
        bad = np.add.reduceat(weight * failing, first, axis=1)
        good = np.add.reduceat(weight * ~failing, first, axis=1)
        below = np.cumsum(good, axis=1) - good / 2
        total = bad.sum(axis=1) * good.sum(axis=1)
        return np.asarray((bad * below).sum(axis=1) / total)

    return interval_of(area, blocks, bounds=(0, 1))


def _like(true: xr.DataArray, **given: npt.ArrayLike) -> dict[str, Floats]:
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in given.items()}
    for name, array in arrays.items():
        if array.shape != true.shape:
            message = (
                f"{name} must have the shape of the certified numbers, {true.shape} over "
                f"({', '.join(map(str, true.dims))}), got {array.shape}"
            )
            raise InputError(message)
    return arrays


def _pixels(of: xr.DataArray) -> Blocks:
    """Return each pixel as a block, and each scene as a region."""
    _, region = np.unique(of["scene"].to_numpy(), return_inverse=True)
    return Blocks(np.arange(len(region)), region)


def _share(inside: Mask, known: Mask, of: xr.DataArray) -> Interval[float]:
    """Return the share of the known rows that are inside."""
    if not known.any():
        return Interval.unknown()
    kept = known.reshape(len(known), -1).any(axis=1)
    return mean_of(np.where(known, inside, np.nan)[kept], _pixels(of)[kept])


# --- this library's own answers -----------------------------------------------------------------


@dataclass(frozen=True)
class Score:
    """How good answers to one question are.

    Attributes
    ----------
    question
        What was asked, in words.
    n
        Samples that were seen.
    score
        The score, with its 95 % interval over pixels.
    answers
        Pixels and channels that were judged.
    """

    question: str
    n: int
    score: Interval[float]
    answers: int


@dataclass(frozen=True, repr=False)
class CertifiedBench(Tabled):
    """How this library's own answers do on certified pixels.

    Questions, for n samples:

    - Do normal 95 % error bars hold the mean? The next line is the certified coverage of the same
      pixels and channels.
    - Is the sample variance within a factor of 2? What is the median of its ratio to the certified?
      What is the median relative error of quantiles?
    - Do 95 % intervals hold: Wilson's of the share of nulls; that of `chdstat.fit.tail_index`, the
      index at the depth of its fit; that of the N of `chdstat.inference.gaussianity_of_means`?
    - How often does ``variance_suspect`` warn of error bars that hold (a coverage of 0.92 or more),
      and of those that fail (0.85 or less)? How well does a score part the two (`separation`)?
    - How often does `chdstat.modality` see several modes in pixels with one, and in those with
      several? Only pixels count whose certified number does not depend on the smoothing.
    - How far is the family that `chdstat.fit.select` chooses from the certified quantiles, as the
      largest difference of probabilities from 0.05 to 0.99? Is it nearly the closest of those that
      were fitted?

    Attributes
    ----------
    scores
        A `Score` for each question and number of samples.
    scenes
        Names of the scenes.
    pixels
        Number of pixels.
    """

    scores: tuple[Score, ...]
    scenes: tuple[str, ...]
    pixels: int

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each question and number of samples."""
        return [
            {"question": s.question, "n": s.n, **s.score.to_dict(), "answers": s.answers}
            for s in self.scores
        ]

    def rows(self) -> list[dict[str, str]]:
        """Return a row of text for each question, with a column for each number of samples.

        Margins are half the 95 % intervals of `table`.
        """
        counts = sorted({s.n for s in self.scores})
        found: dict[str, dict[str, str]] = {}
        for s in self.scores:
            row = found.setdefault(
                s.question, {"question": s.question, **{str(n): "—" for n in counts}}
            )
            half = (s.score.high - s.score.low) / 2
            margin = f" ± {half:.3f}" if np.isfinite(half) else ""
            row[str(s.n)] = f"{s.score.value:.3f}{margin}" if np.isfinite(s.score.value) else "—"
        return [*found.values()]

    def to_dict(self) -> dict[str, Any]:
        """Return the table, scenes and number of pixels, ready for JSON; None for NaN."""
        return {"scenes": list(self.scenes), "pixels": self.pixels, "scores": plain(self.table())}

    def _card(self) -> Card:
        facts = {"pixels": self.pixels, "scenes": ", ".join(self.scenes)}
        return Card("Answers on certified pixels", facts, self.rows())


def bench(
    truth: xr.Dataset | None = None,
    *,
    n: Sequence[int] = COUNTS,
    seed: int = FRESH_SEED,
    backend: Backend = "scalar",
    progress: bool = True,
) -> CertifiedBench:
    """Judge what this library answers from a few samples of certified pixels.

    The samples are drawn again, independently of those that certified the pixels. Intervals and
    scores are 95 % intervals over pixels.

    Parameters
    ----------
    truth
        Certified pixels; by default, those of `chdstat.certified`.
    n
        Numbers of samples, powers of 2 from 32 to 4096.
    seed, backend
        As for `draw`.
    progress
        As for `chdstat.render`.

    Returns
    -------
    CertifiedBench

    Raises
    ------
    InputError
        If there is no certified coverage for a number of samples.

    Examples
    --------
    >>> import chdstat as chd
    >>> truth = chd.certified().isel(pixel=slice(128, 192, 4))
    >>> found = bench(truth, n=[32], progress=False)
    >>> found.scores[0].question, found.scores[0].answers
    ('95 % error bars hold the mean', 42)
    """
    truth = certified() if truth is None else truth
    counts = sorted({whole("n", count, least=1) for count in n})
    if missing := [count for count in counts if count not in SIZES]:
        message = (
            f"n must be among {', '.join(map(str, SIZES))}, for which error bars are certified, "
            f"got {', '.join(map(str, missing))}"
        )
        raise InputError(message)
    x = draw(truth, counts[-1], seed=seed, backend=backend, progress=progress)
    if "R" in truth.channel:
        truth = truth.sel(channel=list(_RGB))
    scores = tuple(score for count in counts for score in _scores(x[..., :count], truth))
    scenes = tuple(dict.fromkeys(truth["scene"].to_numpy().tolist()))
    return CertifiedBench(scores, scenes, truth.sizes["pixel"])


def _scores(x: Array, truth: xr.Dataset) -> Iterator[Score]:
    """Yield the scores of all answers from the samples, shape (pixel, channel, sample)."""
    n = x.shape[-1]
    for answer in _ANSWERS:
        yield from (
            Score(question, n, score, int(answers)) for question, score, answers in answer(x, truth)
        )


_Answer = tuple[str, Interval[float], Any]
"""A question, its score, and how many answers were judged."""
_Found = Iterator[_Answer]


def _holding(what: str, ends: Array, true: xr.DataArray) -> _Answer:
    """Return how many of the intervals (..., 2) hold what they are about, where both are known."""
    low, high = ends[..., 0], ends[..., 1]
    return what, hold(low, high, true), (np.isfinite(low) & true.notnull().to_numpy()).sum()


def _among(what: str, inside: Mask, known: Mask, of: xr.DataArray) -> _Answer:
    """Return the share of the known rows that are inside."""
    return what, _share(inside, known, of), known.sum()


def _answered(what: str, ends: Array, of: xr.DataArray) -> _Answer:
    """Return the share of all rows that have an interval (..., 2)."""
    there = np.isfinite(ends[..., 0])
    return _among(what, there, np.ones_like(there), of)


def _typical(what: str, values: Floats, of: xr.DataArray) -> _Answer:
    """Return the median of the known values."""
    return what, quantile_of(values, _pixels(of)), np.isfinite(values).sum()


def _of_moments(x: Array, truth: xr.Dataset) -> _Found:
    moments = Moments.of(x)
    half = Z_95 * moments.standard_error
    certain = truth["coverage"].sel(size=x.shape[-1])
    true = truth["mean"].where(certain.notnull())
    ends = np.stack([moments.mean - half, moments.mean + half], axis=-1)
    yield _holding("95 % error bars hold the mean", ends, true)
    known = certain.notnull().any("channel").to_numpy()
    held = mean_of(certain.to_numpy()[known], _pixels(certain)[known])
    yield "  as certified", held, np.isfinite(certain).sum()
    variance = truth["variance"]
    ratio = moments.variance / variance.where(variance > 0).to_numpy()
    near = (ratio > 0.5) & (ratio < 2)
    yield _among("variance within a factor 2", near, np.isfinite(ratio), variance)
    yield _typical("variance / certified, median", ratio, variance)


def _of_quantiles(x: Array, truth: xr.Dataset) -> _Found:
    for q in (0.5, 0.9, 0.99):
        true = truth["quantile"].sel(q=q, method="nearest")
        error = np.abs(np.quantile(x, q, axis=-1) / true.where(true > 0).to_numpy() - 1)
        yield _typical(f"error of the {q:g} quantile, median", error, true)


def _of_nulls(x: Array, truth: xr.Dataset) -> _Found:
    true = truth["null_share"]
    # Pixels that are never null, or always, have a share that any method finds.
    true = true.where((true > 0) & (true < 1))
    ends = wilson(np.count_nonzero(x == 0, axis=-1), np.array(x.shape[-1]))
    yield _holding("95 % interval holds the share of nulls", ends, true)


def _of_tails(x: Array, truth: xr.Dataset) -> _Found:
    found, index = tail_index(x), truth["tail_index"]
    true = index.isel(share=0).copy(data=_at_depth(index, found.share))
    yield _holding("95 % interval holds the tail index", found.interval, true)
    yield _answered("  there is an interval", found.interval, true)
    coverage = truth["coverage"].sel(size=x.shape[-1])
    judged, suspect = coverage.to_numpy(), found.variance_suspect
    yield _among("variance_suspect where error bars hold", suspect, judged >= HOLDS, coverage)
    yield _among("variance_suspect where they fail", suspect, judged <= FAILS, coverage)
    count = ((judged >= HOLDS) | (judged <= FAILS)).sum()
    for words, warning in (("coverage_own", -found.coverage_own), ("the tail index", found.xi)):
        yield f"  {words} parts the two", separation(warning, coverage), count
    yield _holding("95 % interval of coverage_own holds it", found.coverage_own_interval, coverage)


def _at_depth(index: xr.DataArray, share: Floats) -> Floats:
    """Return certified tail indices at shares of the positive samples, by log share."""
    known = np.log(index["share"].to_numpy()[::-1])
    values = index.to_numpy()[..., ::-1].reshape(-1, known.size)
    rows = zip(values, np.log(share).reshape(-1), strict=True)
    at = [np.interp(depth, known, row, left=np.nan) for row, depth in rows]
    return np.reshape(at, share.shape)


def _of_averages(x: Array, truth: xr.Dataset) -> _Found:
    if x.shape[-1] < _PREDICTS:
        return
    ends = gaussianity_of_means(x, sizes=[1]).n_predicted_interval
    yield _holding("95 % interval holds n_gaussian", ends, truth["n_gaussian"])
    yield _answered("  N is predicted", ends, truth["n_gaussian"])


def _of_modes(x: Array, truth: xr.Dataset) -> _Found:
    found = modality(x)
    counts = truth["modes"]
    alike = (counts == counts.isel(bandwidth=0)).all("bandwidth") & (
        truth["modes_reason"] == Reason.OK
    ).all("bandwidth")
    middle = counts.isel(bandwidth=1)
    several = (alike & (middle > 1)).to_numpy()
    several &= truth["mode_excess"].isel(mode=1).to_numpy() >= _CLEAR_EXCESS
    single = (alike & (middle == 1)).to_numpy()
    answered = found.reason == Reason.OK
    yield _among("several modes said of one", found.modes > 1, single & answered, middle)
    yield _among("several modes found of several", found.modes > 1, several & answered, middle)


def _of_families(x: Array, truth: xr.Dataset) -> _Found:
    found, of = select(x), truth["mean"]
    distances = np.stack([_distance(fit, truth) for fit in found.fits.values()], axis=-1)
    chosen = np.take_along_axis(distances, np.maximum(found.best, 0)[..., np.newaxis], axis=-1)
    chosen = np.where(found.best < 0, np.nan, chosen[..., 0])
    yield _typical("distance of the chosen family, median", chosen, of)
    least = np.where(np.isnan(distances), np.inf, distances).min(axis=-1)
    near = chosen <= least + 0.02
    yield _among("  within 0.02 of the closest family", near, np.isfinite(chosen), of)


def _distance(fit: Fit, truth: xr.Dataset) -> Floats:
    """Return the largest distance of certified from fitted probabilities, shape (pixel, channel).

    The probabilities are those of the fit's quantiles; between certified quantiles, and between 0
    and the first of them, they are interpolated.
    """
    q = truth["q"].to_numpy()
    model, true = fit.ppf(q), truth["quantile"].to_numpy()
    distance = np.full(true.shape[:-1], np.nan)
    for at, nulls in np.ndenumerate(truth["null_share"].to_numpy()):
        positive = true[at] > 0
        asked = positive & (q >= _RANKS[0]) & (q <= _RANKS[1])
        if asked.any() and np.isfinite(model[at]).all():
            ends, ranks = np.append(0, true[at][positive]), np.append(nulls, q[positive])
            distance[at] = np.abs(np.interp(model[at][asked], ends, ranks) - q[asked]).max()
    return distance


_ANSWERS = (
    _of_moments,
    _of_quantiles,
    _of_nulls,
    _of_tails,
    _of_averages,
    _of_modes,
    _of_families,
)
