"""Measures of a comparison: how far estimates are from a reference, with intervals.

`MEASURES` are the measures that a comparison reports. Each is a ratio of sums over units, so one
bootstrap over the units serves all of them: `errors_of` returns the summands, `measures_of` the
measures from the sums. A unit is a block of pixels with all their batches. Errors of neighbouring
pixels are correlated, so intervals are over blocks (Künsch 1989, doi:10.1214/aos/1176347265).
`columns_of` makes columns of them; `in_words` and `titled` write these for a reader.

No measure contains the noise of the reference (`chdstat.comparison.judges`). What the reference
cannot tell is NaN: a ratio whose denominator may be 0, a relative error that the noise of its
weights decides, a share of improved estimates if too many of them are as near as the mean.

`flip` tells how visible the differences of two images are, at exposures that are chosen here.
HDR-FLIP shows both images at several exposures and keeps the largest difference. Its automatic
exposures follow from the median of the reference: for an object before a black background they are
infinite, and the program ends. So the exposures are given, from the part of the reference that
light reaches.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy import ndimage, stats

from chdstat._core.arrays import Array, generator, spans
from chdstat._core.display import (
    ends_in_words,
    number,
    percent,
    step_of,
    with_interval,
    written,
)
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import LEVEL, Interval
from chdstat.comparison.judges import Judge
from chdstat.estimators.registry import title_of

Measures = Mapping[str, Interval[Array]]
"""Intervals by the names of `MEASURES`."""
Columns = dict[str, tuple[Array, dict[str, str]]]
"""Arrays by name, each with the attributes of a variable."""

MEASURES = {
    "mse": ("mean squared error", "(W sr-1 m-2)^2"),
    "relmse": ("relative mean squared error", "1"),
    "improved": ("share of estimates closer to the truth than the sample mean", "1"),
    "unchanged": ("share of estimates equal to the sample mean", "1"),
    "bias": ("mean error over mean reference", "1"),
    "fireflies": ("share of estimates far brighter than the reference", "1"),
    "mse_ratio": ("mean squared error over that of the sample mean", "1"),
    "relmse_ratio": ("relative mean squared error over that of the sample mean", "1"),
    "fireflies_left": ("fireflies over those of the sample mean", "1"),
}
"""Long name and unit of every measure."""

SUMS = (
    "squared",
    "relative",
    "noisier",
    "improved",
    "undecided",
    "unchanged",
    "firefly",
    "error",
    "reference",
    "count",
)
"""What is summed over estimates, for every estimator and channel. `noisier` is the relative error
with denominators of twice the noise; `count` is 1 per estimate."""

_SUFFIXES = {
    "": ("value", ""),
    "_se": ("standard_error", ", standard error"),
    "_low": ("low", ", lower end of the 95 % interval"),
    "_high": ("high", ", upper end of the 95 % interval"),
}
_TITLES = {
    "label": "pattern",
    "pixels": "pixels",
    "n": "N",
    "name": "estimator",
    "mse_ratio": "MSE / mean's",
    "relmse_ratio": "relMSE / mean's",
    "improved": "improved",
    "bias": "bias",
    "fireflies": "fireflies left",
}
_REPLICATES, _AT_ONCE = 1000, 64
_TAIL = 0.95
"""Percentile of the replicates that intervals are stretched from."""
_UNDECIDED = 0.1
"""Largest share of estimates of which it is not known whether they are improved."""
_MOVED = 0.2
"""Share by which an error may depend on the noise of the reference."""
_SURE = 2.0
"""Standard errors of the reference within which nothing is decided."""
_SAME = 1e-6
"""Relative difference below which an estimate equals the mean up to the order of summation."""
_EXACT = 1e-8
"""Relative squared error up to which a mean counts as exact: samples whose logarithms spread by
1e-4 are constant, see `chdstat.patterns.Thresholds`."""
_FIREFLY = 3.0
"""Excess over the reference, in units of it, from which an estimate is a firefly: two stops."""


def counts(sums: Array) -> npt.NDArray[np.int64]:
    """Return the number of summed estimates of each channel, shape (unit,)."""
    return np.asarray(sums[:, -1, 0, 0], np.int64)


def measures_of(sums: Array, *, seed: int) -> dict[str, Interval[Array]]:
    """Return every measure with its interval over units, shape (estimator, channel + 1).

    The average over channels is last on the channel axis. A single unit gives no interval. A
    thousand replicates tell extreme percentiles badly, and percentiles of few units are too short.
    So the distances from the value to the percentiles at 5 % and 95 %, which keep the skew, are
    stretched: by Student's quantile for k units over the normal one at 95 %, and by sqrt(k / (k -
    1)), but not beyond the possible values of the measure (a variant of Hesterberg 2015,
    doi:10.1080/00031305.2015.1089789). If a few bright units hold most of what a measure is divided
    by, k is their effective number (Kish 1965, "Survey sampling").

    The share of improved estimates lies between two: none or all of those that the reference cannot
    tell from the mean are improved. Its interval holds both; if they differ by more than a tenth,
    there is no value.

    Parameters
    ----------
    sums
        By the names of `SUMS`, shape (unit, sum, 1 + estimator, channel); the sample mean is
        estimator 0.
    seed
        Seed of the bootstrap.
    """
    used, rng, draws = sums[counts(sums) > 0], generator(seed), []
    units = len(used)
    for part in spans(_REPLICATES, _AT_ONCE):
        drawn = rng.integers(units, size=(part.stop - part.start, units))
        weights = np.stack([np.bincount(row, minlength=units) for row in drawn]) / units
        draws.append(_statistics((weights @ used.reshape(units, -1)).reshape(-1, *used.shape[1:])))
    value = {name: x[0] for name, x in _statistics(used.mean(axis=0, keepdims=True)).items()}
    replicates = {name: np.concatenate([draw[name] for draw in draws]) for name in value}
    found = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        unknown = _unknown(value, replicates)
        for name, (about, _) in MEASURES.items():
            number = _effective_units(used, name)
            number = np.where(number > 1, number, np.nan)
            spread = np.sqrt(number / (number - 1))
            reach = spread * stats.t.ppf((1 + LEVEL) / 2, number - 1) / stats.norm.ppf(_TAIL)
            most = "improved_at_most" if name == "improved" else name
            low, high = (
                value[n] + reach * (np.quantile(replicates[n], tail, axis=0) - value[n])
                for n, tail in ((name, 1 - _TAIL), (most, _TAIL))
            )
            apart = value[most] - value[name]
            middle = np.where(apart > _UNDECIDED, np.nan, value[name] + apart / 2)
            error = spread * replicates[name].std(axis=0, ddof=1)
            bounds = (-np.inf if name == "bias" else 0, 1 if "share" in about else np.inf)
            ends = [np.clip(x, *bounds) for x in (middle, low, high)]
            told = ~unknown.get(name, np.False_)
            middle, low, high, error = (np.where(told, x, np.nan)[1:] for x in (*ends, error))
            found[name] = Interval(middle, low, high, standard_error=error)
    return found


def errors_of(
    estimate: Array, mean: Array, reference: Judge, *, scene_mean: npt.ArrayLike
) -> Array:
    r"""Return the summands named in `SUMS` for every estimate, shape (pixel, sum, channel).

    An estimate p with :math:`|p - \bar x| \le 10^{-6} \bar x` counts as unchanged. Whether another
    one is closer to the true radiance y than the mean is decided by the side of their middle on
    which y lies, and is undecided within two standard errors of y. It is a *firefly* if

    .. math:: p - y > 3 \sqrt{y^2 + 0.01\, m^2}

    even for a y two standard errors above the reference, where m is the mean reference of the
    scene: it is surely two stops too bright, and bright enough to be visible in the scene. A
    firefly has a relMSE above 9. We know of no published threshold; this one is ours.

    Parameters
    ----------
    estimate, mean
        Radiance, shape (pixel, channel); `mean` is the mean of the samples of the estimate.
    reference
        Of the pixels.
    scene_mean
        Mean reference of the scene, shape (channel,).
    """
    # An infinite estimate would give NaN in resamples that draw its pixel 0 times.
    p = np.where(np.isfinite(estimate), estimate, np.nan).astype(np.float64)
    mean = mean.astype(np.float64)
    y, margin = reference.mean, _SURE * reference.error
    relative, noisier = reference.relative(p)
    unchanged = np.abs(p - mean) <= _SAME * np.abs(mean)
    ahead = np.sign(mean - p) * ((p + mean) / 2 - y)
    undecided = ~unchanged & (np.abs(ahead) <= margin) & (margin > 0)
    improved = ~unchanged & ~undecided & (ahead > 0)
    most = y + margin
    firefly = p - most > _FIREFLY * np.sqrt(relative_scale(most, scene_mean))
    shares = [improved, undecided, unchanged, firefly, p - y, y, np.ones_like(p)]
    return np.stack([reference.squared(p), relative, noisier, *shares], axis=1)


def moved(one: Array, other: Array) -> npt.NDArray[np.bool_]:
    """Return whether errors that should agree differ: the noise of the reference decides them."""
    return np.asarray(np.abs(one - other) > _MOVED * np.maximum(np.abs(one), np.abs(other)))


def stacked(parts: Sequence[Mapping[str, Interval[Array]]]) -> dict[str, Interval[Array]]:
    """Return the measures of several parts, averaged over channels, along a new first axis."""
    found = {}
    for name in MEASURES:
        value, low, high, error = (
            np.stack([getattr(part[name], field)[:, -1] for part in parts])
            for field in ("value", "low", "high", "standard_error")
        )
        found[name] = Interval(value, low, high, standard_error=error)
    return found


Effect = Literal["lower", "higher", "no gain", "cannot tell"]
"""What the interval of an error over the mean's says."""
WORSE = "▲"
"""Marks an error that is surely above the mean's."""
_GAIN = 0.1
"""Share of the mean's error from which a gain is worth a word."""
_ANY = 1e3
"""Upper end of an interval from which a ratio that may be below 1 may be any number."""
_ONE = 5e-4
"""Distance to 1 that three digits do not show."""


def effect_of(row: Mapping[str, Any], name: str) -> Effect:
    """Return what the interval of a ratio of errors says, in a row of `Comparison.table`.

    "lower" and "higher" if the whole interval lies below or above 1, "no gain" if it holds 1 and a
    gain of a tenth lies outside of it.

    Examples
    --------
    >>> ends = (0.2, 0.9), (1.2, 3.0), (0.951, 1.15), (0.2, 1.01), (np.nan, np.nan)
    >>> [effect_of({"mse_ratio_low": a, "mse_ratio_high": b}, "mse_ratio") for a, b in ends]
    ['lower', 'higher', 'no gain', 'cannot tell', 'cannot tell']
    """
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    if not (np.isfinite(low) and np.isfinite(high) and high > low):
        return "cannot tell"
    if high < 1 - _ONE:
        return "lower"
    if low > 1 + _ONE:
        return "higher"
    return "no gain" if low >= 1 - _GAIN else "cannot tell"


def shown_ratio(row: Mapping[str, Any], name: str) -> str:
    r"""Return a ratio of errors from a row of `Comparison.table`, with its 95 % interval.

    A sign marks one that is surely above 1.

    Examples
    --------
    >>> row = {"mse_ratio": 1.84, "mse_ratio_low": 1.45, "mse_ratio_high": 2.31}
    >>> shown_ratio(row, "mse_ratio").replace("\N{NO-BREAK SPACE}", " ")
    '1.8 [1.4, 2.3] ▲'
    """
    if not is_told(row, name):
        return "cannot tell"
    sign = f"\N{NO-BREAK SPACE}{WORSE}" if effect_of(row, name) == "higher" else ""
    return ratio_in_words(row, name) + sign


def is_told(row: Mapping[str, Any], name: str) -> bool:
    """Return whether a ratio of errors says anything: it is known, and not just any number."""
    return bool(np.isfinite(row[name]) and not row[f"{name}_low"] < 1 < row[f"{name}_high"] / _ANY)


def ratio_in_words(row: Mapping[str, Any], name: str) -> str:
    """Return a ratio of errors with its 95 % interval, of which no end is rounded to 1."""
    return with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"], beside=[1.0])


def legend(shown: Iterable[str], baseline: str = "the mean") -> dict[str, str]:
    """Return what the sign of worse errors means, if a text has it.

    Examples
    --------
    >>> legend(["1.00", "1.8 [1.4, 2.3] ▲"]), legend([])
    ({'▲': 'surely worse than the mean: the whole interval is above 1'}, {})
    """
    means = f"surely worse than {baseline}: the whole interval is above 1"
    return {WORSE: means} if any(WORSE in text for text in shown) else {}


_READ = (
    *(f"{measure}_ratio{end}" for measure in ("relmse", "mse") for end in ("", "_low", "_high")),
    *("improved", "bias", "fireflies_left", "flip_ratio", "mse_equal_time", "seconds"),
    "uses_neighbours",
)
"""What one reads of a row of measures."""


def ranked(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return what one reads of rows of measures, the smallest relMSE over the mean's first.

    Rows that begin alike, as of one pattern, are ranked among themselves. What cannot be told comes
    last, by MSE. ``estimator`` is the title, and ``name`` what one types.

    Examples
    --------
    >>> rows = [{"n": 8, "estimator": "mean", "relmse_ratio": 1.0, "mse_ratio": 1.0},
    ...         {"n": 8, "estimator": "catoni", "relmse_ratio": 0.9, "mse_ratio": 1.1}]
    >>> [row["estimator"] for row in ranked(rows)], [*ranked(rows)[0]]
    (['Catoni', 'sample mean'], ['n', 'estimator', 'relmse_ratio', 'mse_ratio', 'name'])
    """
    leads = [{k: row[k] for k in itertools.takewhile("estimator".__ne__, row)} for row in rows]

    def place(pair: tuple[Mapping[str, Any], dict[str, Any]]) -> tuple[float, ...]:
        row, lead = pair
        ratios = (row[name] for name in ("relmse_ratio", "mse_ratio"))
        return leads.index(lead), *(x if math.isfinite(x) else math.inf for x in ratios)

    return [
        {
            **lead,
            "estimator": title_of(row["estimator"]),
            **{name: row[name] for name in _READ if name in row},
            "name": row["estimator"],
        }
        for row, lead in sorted(zip(rows, leads, strict=True), key=place)
    ]


def in_words(row: Mapping[str, Any]) -> dict[str, str]:
    r"""Return a row of a table of estimators as text, with 95 % intervals of ratios.

    Examples
    --------
    >>> ends = {"mse_ratio": 0.9131, "mse_ratio_low": 0.8691, "mse_ratio_high": 0.9502}
    >>> rest = dict.fromkeys(["relmse_ratio", "relmse_ratio_low", "relmse_ratio_high"], np.nan)
    >>> others = {"mse": 0.5, "bias": -0.012, "bias_low": -0.05, "bias_high": 0.03}
    >>> others |= {"improved": np.nan, "improved_low": 0.46, "improved_high": 0.64}
    >>> others |= {f"fireflies_left{end}": 0.0 for end in ("", "_low", "_high")}
    >>> words = in_words({"estimator": "catoni", **ends, **rest, **others})
    >>> words["mse_ratio"], words["relmse_ratio"], words["improved"].replace("\xa0", " ")
    ('0.91 [0.87, 0.95]', 'cannot tell', '46 % to 64 %')
    >>> words["bias"].replace("\xa0", " ")
    '−1 %'
    """
    label = {"label": row["label"].replace("_", "-")} if "label" in row else {}
    left = "fireflies_left"
    return {
        **label,
        "name": title_of(row["estimator"]),
        "mse": number(row["mse"]),
        "mse_ratio": shown_ratio(row, "mse_ratio"),
        "relmse_ratio": shown_ratio(row, "relmse_ratio"),
        "improved": "" if row["estimator"] == "mean" else _shown_share(row, "improved"),
        "bias": percent(row["bias"], sign=True, step=_step(row, "bias")),
        "fireflies": number(row[left], step=_step(row, left)),
    }


def _step(row: Mapping[str, Any], name: str) -> float:
    """Return the place of the last digit that the interval of a measure supports."""
    return step_of(row[f"{name}_low"], row[f"{name}_high"])


def _shown_share(row: Mapping[str, Any], name: str) -> str:
    """Return a share from a row, or the ends of its interval if these are all that is known."""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    if np.isfinite(row[name]) or not np.isfinite(low):
        return percent(row[name], step=_step(row, name))
    return ends_in_words(low, high, percent)


def columns_of(measures: Measures) -> Columns:
    """Return the arrays of all intervals with attributes."""
    return {
        measure + suffix: (
            getattr(interval, part),
            described(MEASURES[measure][0] + what, MEASURES[measure][1]),
        )
        for measure, interval in measures.items()
        for suffix, (part, what) in _SUFFIXES.items()
    }


def described(long_name: str, units: str = "1") -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def titled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows of measures in words, under titles."""
    texts = ({**row, **in_words(row)} for row in rows)
    return [
        {title: written(row[key]) for key, title in _TITLES.items() if key in row} for row in texts
    ]


def _statistics(sums: Array) -> dict[str, Array]:
    """Return what measures follow from, each (replicate, 1 + estimator, channel + 1)."""
    part = dict(zip(SUMS, np.moveaxis(sums, 1, 0), strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = {name: x / part["count"] for name, x in part.items()}
        share["bias"] = part["error"] / part["reference"]
        of = {n: np.concatenate([x, x.mean(-1, keepdims=True)], -1) for n, x in share.items()}
        ratio = {name: x / x[:, :1] for name, x in of.items()}
        return {
            "mse": of["squared"],
            "relmse": 2 * of["relative"] - of["noisier"],
            "noisy": of["relative"],
            "noisier": of["noisier"],
            "improved": of["improved"],
            "improved_at_most": of["improved"] + of["undecided"],
            "unchanged": of["unchanged"],
            "bias": of["bias"],
            "reference": of["reference"],
            "fireflies": of["firefly"],
            "mse_ratio": ratio["squared"],
            # The noise of denominators has half the effect with two parts as with one.
            "relmse_ratio": 2 * ratio["relative"] - ratio["noisier"],
            "noisy_ratio": ratio["relative"],
            "noisier_ratio": ratio["noisier"],
            "fireflies_left": ratio["firefly"],
        }


def _effective_units(sums: Array, name: str) -> Array:
    """Return the number of units that a measure rests on, shape (1 + estimator, channel + 1)."""
    of = {"mse": "squared", "relmse": "relative", "fireflies_left": "firefly", "bias": "reference"}
    by = sums[:, SUMS.index(of.get(name.removesuffix("_ratio"), "count"))]
    if name in ("mse_ratio", "relmse_ratio", "fireflies_left"):
        by = by[:, :1]
    by = np.concatenate([by, by.mean(axis=-1, keepdims=True)], axis=-1)
    return np.asarray(np.square(by.sum(axis=0)) / np.square(by).sum(axis=0))


def _unknown(value: Mapping[str, Array], replicates: Mapping[str, Array]) -> dict[str, Array]:
    """Return where measures are not known, by name, each (1 + estimator, channel + 1)."""

    def zero(name: str, sign: int = 1) -> Array:
        """Whether a sum for the sample mean, by which measures are divided, may be 0 or less."""
        least = np.quantile(sign * replicates[name][:, :1], (1 - LEVEL) / 2, axis=0)
        return np.asarray(~(least > 0))

    def decided(end: str = "") -> Array:
        """Whether the noise of denominators surely decides a relative error or a ratio of them."""
        return np.asarray(
            moved(replicates[f"noisy{end}"], replicates[f"noisier{end}"]).mean(axis=0) > LEVEL
        )

    # The error of a mean of constant samples is rounding, so it has no ratio.
    exact = value["mse"][:1] <= _EXACT * np.square(value["reference"][:1])
    return {
        "relmse": decided(),
        "bias": zero("reference") & zero("reference", sign=-1),
        "mse_ratio": exact | zero("mse"),
        "relmse_ratio": exact | zero("noisy") | zero("noisier") | decided("_ratio"),
        "fireflies_left": zero("fireflies"),
    }


# --- FLIP: how visible differences are ------------------------------------------------------------


HAS_FLIP = importlib.util.find_spec("flip_evaluator") is not None
"""Whether the package that measures it is installed."""
_LUMINANCE = (0.2126, 0.7152, 0.0722)
_LIT = 1e-3
"""Share of the mean radiance from which a pixel is lit."""
_SHOWN = 0.999
"""Quantile of the lit pixels that the least exposure shows: a few lamps may stay white."""
_WHITE = 2.1189
"""Radiance that the tone curve of HDR-FLIP (ACES) shows at 85 % of white."""
_MEDIAN = 5
"""Edge in pixels of the median that the exposures look at."""
_MOST = 16
"""Most exposures, a stop apart if they suffice."""


def exposures(reference: Array) -> tuple[float, float]:
    """Return the least and the largest exposure for a reference (y, x, channel), in stops.

    At the least, the brightest lit pixels but one in a thousand are shown at 85 % of white; at the
    largest, half of the lit pixels are at least as bright. HDR-FLIP takes the maximum and the
    median of all pixels instead, and no median of 5 x 5 pixels before: the noise of a reference
    makes its brightest pixels brighter.

    Examples
    --------
    >>> image = np.zeros((8, 8, 3))
    >>> image[:2] = 2.1189  # three quarters are black
    >>> exposures(image), exposures(image / 2), exposures(0 * image)
    ((0.0, 0.0), (1.0, 1.0), (0.0, 0.0))
    """
    light = np.broadcast_to(np.maximum(reference, 0), (*reference.shape[:2], 3)) @ _LUMINANCE
    lit, smooth = (x[x > _LIT * x.mean()] for x in (light, ndimage.median_filter(light, _MEDIAN)))
    lit = smooth if 2 * smooth.size > lit.size else lit  # else there is little but specks
    if not lit.size:
        return 0.0, 0.0
    start, stop = (
        round(math.log2(_WHITE) - math.log2(float(x)), 4) + 0.0
        for x in np.quantile(lit, (_SHOWN, 0.5))
    )
    return start, stop


def flip(image: Array, reference: Array, *, stops: tuple[float, float] | None = None) -> Array:
    """Return the FLIP error of every pixel of linear radiance, shape (y, x), from 0 to 1.

    Parameters
    ----------
    image, reference
        Radiance, shape (y, x, channel), 1 or 3 channels; what is negative or no number is black.
    stops
        Least and largest exposure; None takes the `exposures` of the reference.

    References
    ----------
    P. Andersson, J. Nilsson, P. Shirley and T. Akenine-Möller, "Visualizing errors in rendered high
    dynamic range images", Eurographics Short Papers 2021, doi:10.2312/egs.20211015; with 67 pixels
    per degree.
    """
    evaluator: Any = importlib.import_module("flip_evaluator")
    start, stop = exposures(reference) if stops is None else stops
    shape = (*reference.shape[:2], 3)
    # Both images at the least exposure, so that radiance of any unit is a usual number.
    lit = (np.nan_to_num(x.clip(0) * 2.0**start, posinf=0) for x in (reference, image))
    shown = (np.array(np.broadcast_to(x, shape), np.float32, order="C") for x in lit)
    count = min(max(2, math.ceil(stop - start)), _MOST)  # of a single one, errors are 0
    how = {"startExposure": 0.0, "stopExposure": stop - start, "numExposures": count}
    found, _, _ = evaluator.evaluate(
        *shown, "HDR", applyMagma=False, computeMeanError=False, parameters=how
    )
    return np.asarray(found, np.float64).reshape(shape[:2])
