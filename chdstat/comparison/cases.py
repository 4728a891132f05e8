"""Cases: errors of estimators on scenes at numbers of samples, and what all of them say."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Array
from chdstat._core.display import Card, Shown, number, percent
from chdstat._core.files import checked_target, replacing
from chdstat._core.resampling import Blocks, Interval, interval_of
from chdstat.comparison.presentation import latex, notes

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FORMATS", "MEASURES", "Bench", "Case", "flip"]


_NAMES = {"mse": "MSE", "relmse": "relMSE", "smape": "SMAPE", "flip": "FLIP"}
_HAS_FLIP = importlib.util.find_spec("flip_evaluator") is not None
MEASURES = tuple(name for name in _NAMES if name != "flip" or _HAS_FLIP)
"""Errors that are added up over pixels; FLIP where its package is installed."""
FORMATS = (".csv", ".tex", ".json", ".pdf")
"""What a benchmark is written to."""
_LEAST = 1e-3
"""Least ratio of errors: where the noise of the reference is subtracted, one may be below 0."""


def flip(image: Array, reference: Array) -> Array:
    """Return the FLIP error of every pixel of linear radiance, shape (y, x), from 0 to 1.

    HDR-FLIP with its defaults: 67 pixels per degree, exposures from the reference.

    References
    ----------
    P. Andersson, J. Nilsson, P. Shirley and T. Akenine-Möller, "Visualizing errors in rendered high
    dynamic range images", Eurographics Short Papers 2021, doi:10.2312/egs.20211015.
    """
    evaluator: Any = importlib.import_module("flip_evaluator")
    shape = (*reference.shape[:2], 3)
    shown = (
        np.array(np.broadcast_to(np.maximum(x, 0), shape), np.float32, order="C")
        for x in (reference, np.nan_to_num(image, posinf=0))
    )
    found, _, _ = evaluator.evaluate(*shown, "HDR", applyMagma=False, computeMeanError=False)
    return np.asarray(found, np.float64).reshape(shape[:2])


@dataclass(frozen=True)
class Case:
    """One scene at one number of samples.

    Attributes
    ----------
    scene, spp
        Which.
    blocks
        Blocks of its pixels.
    errors
        Sums of the errors of `MEASURES` over each block, by estimator, shape (block, measure).
    bias, fireflies
        By estimator: the mean error over the mean; the share of pixels at least two stops too
        bright, as of `chdstat.compare`.
    seconds
        That each estimate took, by estimator; NaN for finished images.
    render_seconds
        That the samples took; NaN where it is unknown.
    images
        By estimator, and last the "reference": the middle of the image of the first render, at most
        128 x 128 pixels of linear radiance, (y, x, channel). Only at the least number of samples,
        where one sees the most; whole images of all cases would fill the memory.
    """

    scene: str
    spp: int
    blocks: Blocks
    errors: Mapping[str, Array]
    bias: Mapping[str, float]
    fireflies: Mapping[str, float]
    seconds: Mapping[str, float]
    render_seconds: float
    images: Mapping[str, Array] = field(default_factory=dict)

    @staticmethod
    def average(cases: Sequence[Case]) -> Case:
        """Return one case of several renders of a scene."""

        def mean(values: list[Mapping[str, Any]]) -> dict[str, Any]:
            return {name: np.mean([value[name] for value in values], axis=0) for name in values[0]}

        return replace(
            cases[0],
            errors=mean([case.errors for case in cases]),
            bias=mean([case.bias for case in cases]),
            fireflies=mean([case.fireflies for case in cases]),
            seconds=mean([case.seconds for case in cases]),
            render_seconds=float(np.mean([case.render_seconds for case in cases])),
        )

    def ratio(self, name: str, baseline: str, measure: str) -> Interval[float]:
        """Return the error of an estimator over that of another, with its interval over blocks."""
        k = MEASURES.index(measure)
        one, other = self.errors[name][:, k], self.errors[baseline][:, k]
        return interval_of(
            lambda w: np.maximum((w @ one) / (w @ other), _LEAST), self.blocks, bounds=(0, np.inf)
        )

    def row(self, name: str, baseline: str) -> dict[str, Any]:
        """Return all numbers of an estimator."""
        pixels = len(self.blocks.of_pixel)
        means = dict(zip(MEASURES, self.errors[name].sum(axis=0) / pixels, strict=True))
        found: dict[str, Any] = {"scene": self.scene, "spp": self.spp, "estimator": name, **means}
        for measure in MEASURES:
            ratio = self.ratio(name, baseline, measure)
            found |= {f"{measure}_ratio": ratio.value, f"{measure}_ratio_low": ratio.low}
            found[f"{measure}_ratio_high"] = ratio.high
        # The error of a mean falls as the inverse of the time.
        longer = 1 + self.seconds[name] / self.render_seconds
        return found | {
            "mse_equal_time": found["mse_ratio"] * longer,
            "bias": self.bias[name],
            "fireflies": self.fireflies[name],
            "seconds": self.seconds[name],
        }


@dataclass(frozen=True, repr=False)
class Bench(Shown):
    """Errors of estimators on several scenes.

    Attributes
    ----------
    estimators
        Their names, in the order that was asked for.
    baseline
        The one whose errors are 1.
    cases
        One for each scene and number of samples.
    left_out
        Those of `chdstat.comparison.DEFAULT_ESTIMATORS` that do not apply, with the reason.
    """

    estimators: tuple[str, ...]
    baseline: str
    cases: tuple[Case, ...]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each scene, number of samples and estimator.

        Errors and their ratios to those of the baseline with intervals of 95 % over blocks of
        pixels; ``mse_equal_time``, the ratio times what the estimate adds to the time of the
        samples; bias; fireflies; seconds.
        """
        return [
            case.row(name, self.baseline)
            for case in self.cases
            for name in self.estimators
            if name in case.errors
        ]

    @cached_property
    def _regions(self) -> tuple[Blocks, dict[str, slice]]:
        """Blocks of all scenes, and which are each scene's: its cases share their pixels."""
        first = {case.scene: case.blocks for case in self.cases}
        ends = np.cumsum([0, *map(len, first.values())])
        places = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(first)}
        return Blocks.join(list(first.values())), places

    def geometric_mean(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the geometric mean of the ratios of an error to the baseline's over all cases.

        With its interval of 95 % over blocks of pixels within these scenes; other scenes may differ
        by more.
        """
        blocks, places = self._regions
        k = MEASURES.index(measure)

        def statistic(weights: Array) -> Array:
            logs = []
            for case in self.cases:
                if name in case.errors:
                    w = weights[:, places[case.scene]]
                    one, other = (w @ case.errors[n][:, k] for n in (name, self.baseline))
                    logs.append(np.log(np.maximum(one / other, _LEAST)))
            return np.asarray(np.exp(np.mean(logs, axis=0)))

        return interval_of(statistic, blocks, bounds=(0, np.inf))

    def rank(self, name: str, measure: str = "mse") -> Interval[float]:
        """Return the average rank among the estimators over all cases, 1 for the least error."""
        blocks, places = self._regions
        k = MEASURES.index(measure)

        def statistic(weights: Array) -> Array:
            ranks = []
            for case in self.cases:
                if name in case.errors:
                    w = weights[:, places[case.scene]]
                    own = w @ case.errors[name][:, k]
                    others = [w @ e[:, k] for n, e in case.errors.items() if n != name]
                    ranks.append(sum((own > other for other in others), np.ones(len(w))))
            return np.asarray(np.mean(ranks, axis=0), np.float64)

        return interval_of(statistic, blocks, bounds=(1, len(self.estimators)))

    def summary(self) -> list[dict[str, Any]]:
        """Return a row for each estimator: what all cases say of it.

        Geometric means of the ratios of errors and average ranks of the MSE, each with its
        interval of 95 %; ``worst``, the largest ratio of the MSE in a case; ``bias``, the largest
        in size of a case; ``fireflies``, the average of their shares; the number of cases.
        """
        rows = []
        for name in self.estimators:
            row: dict[str, Any] = {"estimator": name}
            for measure in MEASURES:
                found = self.geometric_mean(name, measure)
                row |= {measure: found.value, f"{measure}_low": found.low}
                row[f"{measure}_high"] = found.high
            rank = self.rank(name)
            row |= {"rank": rank.value, "rank_low": rank.low, "rank_high": rank.high}
            cases = [case for case in self.cases if name in case.errors]
            row["worst"] = max(case.ratio(name, self.baseline, "mse").value for case in cases)
            row["bias"] = max((case.bias[name] for case in cases), key=abs)
            row["fireflies"] = float(np.mean([case.fireflies[name] for case in cases]))
            row["cases"] = len(cases)
            rows.append(row)
        return rows

    @property
    def notes(self) -> dict[str, str]:
        """What a reader of the table has to know beside it, as of a `Comparison`."""
        return notes(self.estimators, left_out=self.left_out)

    def _card(self) -> Card:
        scenes, spp = {c.scene: None for c in self.cases}, {c.spp: None for c in self.cases}
        facts = {"scenes": ", ".join(scenes), "spp": ", ".join(map(str, spp))}
        facts |= self.notes
        if not _HAS_FLIP:
            facts["FLIP"] = "not measured; pip install 'chdstat[flip]' adds it"
        title = f"Benchmark: errors over those of {self.baseline}"
        rows = self.shown(intervals=("mse", "relmse"))
        for row in rows:  # as wide as a page; SMAPE is in files and in `summary`
            del row[_NAMES["smape"]]
        return Card(title, facts, rows)

    def shown(self, *, intervals: Sequence[str] = MEASURES) -> list[dict[str, str]]:
        """Return the summary as text under titles, these measures with their intervals."""
        return [_shown(row, intervals) for row in self.summary()]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {"baseline": self.baseline, "summary": self.summary(), "cases": self.table()}

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows of `table` as a pandas data frame."""
        import pandas as pd

        return pd.DataFrame(self.table())

    def to_latex(self) -> str:
        """Return the summary as LaTeX, for a paper; it needs the package booktabs."""
        return latex(self.shown())

    def save(self, path: str | Path) -> Path:
        """Write `table` to a .csv, the summary to a .tex, both to a .json file, or a .pdf.

        The PDF has both, curves of the errors and images of every scene.

        Raises
        ------
        InputError
            If the path ends otherwise, or cannot be written to.
        """
        target = checked_target(path, *FORMATS)
        if target.suffix == ".pdf":
            from chdstat.reporting.bench_report import save_pdf

            return save_pdf(self, target)
        if target.suffix == ".csv":
            text = str(self.to_dataframe().to_csv(index=False))
        elif target.suffix == ".tex":
            text = self.to_latex()
        else:
            text = json.dumps(self.to_dict(), indent=1)
        with replacing(target) as partial:
            partial.write_text(text, encoding="utf-8")
        return target


def _shown(row: Mapping[str, Any], intervals: Sequence[str]) -> dict[str, str]:
    def ratio(measure: str) -> str:
        ends = f" [{row[f'{measure}_low']:.2f}, {row[f'{measure}_high']:.2f}]"
        return f"{row[measure]:.2f}{ends if measure in intervals else ''}"

    return {
        "estimator": row["estimator"],
        **{_NAMES[measure]: ratio(measure) for measure in MEASURES},
        "bias": percent(row["bias"], sign=True),
        "fireflies": percent(row["fireflies"]),
        "rank": f"{row['rank']:.1f}",
        "worst": number(row["worst"]),
    }
