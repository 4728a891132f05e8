"""Findings: what the numbers of a scene say, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from chdstat.analysis import Overview
from chdstat.comparison import Comparison
from chdstat.reporting.text import NAMES, number, percent

__all__ = ["Finding", "findings"]


@dataclass(frozen=True)
class Finding:
    """One row of the table of findings.

    Parameters
    ----------
    question
        What was asked.
    answer
        What the data say.
    figure
        The number behind it.
    """

    question: str
    answer: str
    figure: str


def findings(scene: Overview, comparison: Comparison | None) -> list[Finding]:
    """Return the findings on a scene, in the order of the report."""
    rows = [_nulls(scene), _spread(scene), _family(scene), _log_shape(scene), _tails(scene)]
    rows += [_modes(scene), *_averages(scene), _bad(scene)]
    if comparison is not None:
        rows += _estimators(comparison)
    return rows


def _nulls(scene: Overview) -> Finding:
    return Finding(
        "How often does a path find no light?",
        f"{percent(scene.null_share)} of all samples are null; in {percent(scene.null_pixels)} of "
        "the pixels they are the majority.",
        percent(scene.null_share),
    )


def _spread(scene: Overview) -> Finding:
    question = "How far do samples scatter?"
    if not math.isfinite(scene.variation[1]):
        return Finding(question, "No pixel has two samples and a mean above 0.", "—")
    low, middle, high = (number(v) for v in scene.variation)
    return Finding(
        question,
        f"The standard deviation of a pixel's samples is {middle} times their mean "
        f"(quartiles {low} and {high}).",
        f"{middle} ×",
    )


def _family(scene: Overview) -> Finding:
    if not any(share > 0 for share in scene.families.values()):
        return Finding("Which family describes the samples?", "No pixel could be fitted.", "—")
    best, share = max(scene.families.items(), key=lambda item: item[1])
    rest = {name: s for name, s in scene.families.items() if name != best}
    others = ", ".join(f"{NAMES.get(name, name)} {percent(s)}" for name, s in rest.items())
    return Finding(
        "Which family describes the samples?",
        f"Of those compared, {NAMES.get(best, best)} describes {percent(share)} of the pixel "
        f"channels best ({others}); the evidence is very strong for {percent(scene.decided)}. "
        "The better one need not be good.",
        f"{NAMES.get(best, best)} {percent(share)}",
    )


def _log_shape(scene: Overview) -> Finding:
    question = "Are logarithms of samples Gaussian?"
    if not math.isfinite(scene.log_rejected):
        return Finding(question, "No pixel has enough positive samples to test.", "—")
    low, middle, high = (number(v) for v in scene.log_skewness)
    return Finding(
        question,
        f"{percent(scene.log_rejected)} of the pixel channels are told from a Gaussian; their "
        f"skewness has median {middle} (quartiles {low} and {high}).",
        f"{percent(scene.log_rejected)} rejected",
    )


def _tails(scene: Overview) -> Finding:
    question = "Are tails long?"
    if not math.isfinite(scene.doubtful_variance):
        return Finding(question, "No pixel has enough positive samples to look at its tail.", "—")
    return Finding(
        question,
        f"In {percent(scene.long_tails)} of the pixels, the tail index is above the threshold. In "
        f"{percent(scene.doubtful_variance)} its estimate reaches 1/2, where the variance of such "
        "a tail, and every error bar that rests on it, is not to be trusted.",
        percent(scene.long_tails),
    )


def _modes(scene: Overview) -> Finding:
    return Finding(
        "Do two kinds of paths mix?",
        f"{percent(scene.bimodal)} of the pixels have two clearly separated modes of log "
        "luminance.",
        percent(scene.bimodal),
    )


def _averages(scene: Overview) -> Iterator[Finding]:
    if not scene.averages or not any(math.isfinite(share) for share in scene.averages.values()):
        return
    n = 32 if 32 in scene.averages else max(scene.averages)
    largest = max(scene.averages)
    yield Finding(
        "Are pixel estimates Gaussian?",
        f"Averages of {n} samples are told from Gaussian in {percent(scene.averages[n])} of the "
        f"pixel channels, averages of {largest} in {percent(scene.averages[largest])}. A test of "
        "few averages is weak: more would be found with more samples.",
        f"N = {n}: {percent(scene.averages[n])}",
    )


def _bad(scene: Overview) -> Finding:
    total = scene.pixels * scene.spp
    return Finding(
        "Did the renderer return impossible values?",
        f"{scene.bad_samples} of {total} samples are NaN, infinite or negative; they are counted "
        "and left out."
        if scene.bad_samples
        else f"None of {total} samples is NaN, infinite or negative.",
        f"{scene.bad_samples}",
    )


def _estimators(comparison: Comparison) -> Iterator[Finding]:
    for row in comparison.table():
        if row["estimator"] == "mean":
            continue
        name = NAMES.get(row["estimator"], row["estimator"])
        low, high = row["improved_low"], row["improved_high"]
        majority = (
            "more than half" if low > 0.5 else "fewer than half" if high < 0.5 else "about half"
        )
        yield Finding(
            f"Does {name} beat the mean of {comparison.n} samples?",
            f"It improves {majority} of the estimates ({percent(row['improved'])}), at "
            f"{number(row['mse_ratio'])} times the squared and {number(row['relmse_ratio'])} times "
            f"the relative squared error, with a bias of {percent(row['bias'], sign=True)}.",
            f"improved {percent(row['improved'])}",
        )
