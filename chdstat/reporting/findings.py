"""Findings: the numbers of a scene, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from chdstat.analysis import Overview
from chdstat.comparison import Comparison
from chdstat.patterns import Atlas
from chdstat.reporting.scene_figures import SelfTraining
from chdstat.reporting.typst import NAMES, number, percent

__all__ = ["FindingRow", "findings"]


@dataclass(frozen=True)
class FindingRow:
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


def findings(
    scene: Overview,
    atlas: Atlas | None,
    comparison: Comparison | None,
    self_training: SelfTraining | None = None,
) -> list[FindingRow]:
    """Return the findings on a scene, in the order of the report."""
    rows = [_nulls(scene), _spread(scene), _family(scene), _fit(scene), _log_shape(scene)]
    rows += [
        _tails(scene),
        _fireflies(scene),
        _modes(scene),
        _neighbours(scene),
        *_averages(scene),
        _bad(scene),
    ]
    if atlas is not None:
        rows.insert(-1, _shapes(atlas))
    if comparison is not None:
        rows += _estimators(comparison)
    if self_training is not None:
        rows.append(_without_reference(self_training))
    return rows


def _nulls(scene: Overview) -> FindingRow:
    return FindingRow(
        "How often does a path find no light?",
        f"{percent(scene.null_share)} of all samples are null; in {percent(scene.null_pixels)} of "
        "the pixels they are the majority.",
        percent(scene.null_share),
    )


def _spread(scene: Overview) -> FindingRow:
    question = "How far do samples scatter?"
    if not math.isfinite(scene.variation[1]):
        return FindingRow(question, "No pixel has two samples and a mean above 0.", "—")
    low, middle, high = (number(v) for v in scene.variation)
    return FindingRow(
        question,
        f"The standard deviation of a pixel's samples is {middle} times their mean "
        f"(quartiles {low} and {high}).",
        f"{middle} ×",
    )


def _family(scene: Overview) -> FindingRow:
    question = "Which family describes the samples?"
    if not any(share > 0 for share in scene.families.values()):
        return FindingRow(question, "No pixel could be fitted.", "—")
    best, share = max(scene.families.items(), key=lambda item: item[1])
    held_out = max(scene.families_held_out.items(), key=lambda item: item[1], default=None)
    agreed = (
        ""
        if held_out is None
        else f"By held-out likelihood it is {_name(held_out[0])}, {percent(held_out[1])}. "
    )
    return FindingRow(
        question,
        f"By BIC, {_name(best)} describes {percent(share)} of the pixel channels best "
        f"({_listed(scene.families, best)}); the evidence is very strong for "
        f"{percent(scene.decided)}. {agreed}".rstrip(),
        f"{_name(best)} {percent(share)}",
    )


def _fit(scene: Overview) -> FindingRow:
    question = "Is the best family a good one?"
    if not math.isfinite(scene.misfit[1]):
        return FindingRow(question, "No pixel could be fitted.", "—")
    low, middle, high = (percent(v) for v in scene.misfit)
    return FindingRow(
        question,
        f"The distribution function of the samples is at most {middle} away from that of the best "
        f"family in the median pixel channel (quartiles {low} and {high}).",
        middle,
    )


def _log_shape(scene: Overview) -> FindingRow:
    question = "Are logarithms of samples Gaussian?"
    if not math.isfinite(scene.log_rejected):
        return FindingRow(question, "No pixel has enough positive samples to test.", "—")
    low, middle, high = (number(v) for v in scene.log_skewness)
    return FindingRow(
        question,
        f"{percent(scene.log_rejected)} of the pixel channels are told from a Gaussian; their "
        f"skewness has median {middle} (quartiles {low} and {high}).",
        f"{percent(scene.log_rejected)} rejected",
    )


def _tails(scene: Overview) -> FindingRow:
    question = "Are tails long?"
    if not math.isfinite(scene.doubtful_variance):
        return FindingRow(
            question, "No pixel has enough positive samples to look at its tail.", "—"
        )
    long = scene.patterns["long_tail"]
    return FindingRow(
        question,
        f"{percent(long)} of the pixels have a long tail. In {percent(scene.doubtful_variance)} of "
        "the pixel channels the tail index is estimated at 1/2 or more, where the variance of such "
        "a tail, and every error bar that rests on it, is not to be trusted; in "
        f"{percent(scene.unidentified_variance)} the samples cannot tell whether it is finite.",
        percent(long),
    )


def _fireflies(scene: Overview) -> FindingRow:
    share = scene.patterns["firefly_dominated"]
    return FindingRow(
        "Does one sample decide a pixel?",
        f"In {percent(share)} of the pixels, a single one of {scene.spp} samples carries a large "
        "share of the mean."
        if share
        else f"In no pixel does a single one of {scene.spp} samples carry a large share of the "
        "mean.",
        percent(share),
    )


def _modes(scene: Overview) -> FindingRow:
    two, more = scene.patterns["bimodal"], scene.patterns["multimodal"]
    return FindingRow(
        "Do several kinds of paths mix?",
        f"{percent(two)} of the pixels have two clearly separated modes of log luminance, "
        f"{percent(more)} three or more.",
        percent(two + more),
    )


def _neighbours(scene: Overview) -> FindingRow:
    question = "Do patterns form regions?"
    if not math.isfinite(scene.label_agreement):
        return FindingRow(question, "All pixels have the same label, or none.", "—")
    return FindingRow(
        question,
        f"Neighbouring pixels share their primary pattern with a kappa of "
        f"{number(scene.label_agreement)}: 0 would be chance, 1 complete agreement.",
        f"κ = {number(scene.label_agreement)}",
    )


def _shapes(atlas: Atlas) -> FindingRow:
    question = "Which shapes recur?"
    count = len(atlas.share)
    if not count:
        return FindingRow(question, "No pixel has enough positive samples for a shape.", "—")
    if count == 1:
        answer = "All pixels have one shape, but for scale and noise."
    else:
        answer = (
            f"{count} typical shapes tell apart what repeats; the most frequent is that of "
            f"{percent(float(atlas.share[0]))} of the pixels. Pixels are a continuum, of which "
            "these are landmarks."
        )
    return FindingRow(question, answer, f"{count}")


def _averages(scene: Overview) -> Iterator[FindingRow]:
    if not scene.averages or not any(math.isfinite(share) for share in scene.averages.values()):
        return
    largest = max(scene.averages)
    yield FindingRow(
        "Are pixel estimates Gaussian?",
        f"Averages of {largest} samples are told from Gaussian in "
        f"{percent(scene.averages[largest])} of the pixel channels, single samples in "
        f"{percent(scene.averages[min(scene.averages)])}. A test of few averages is weak: more "
        "would be found with more samples.",
        f"N = {largest}: {percent(scene.averages[largest])}",
    )


def _bad(scene: Overview) -> FindingRow:
    total = scene.pixels * scene.spp
    return FindingRow(
        "Did the renderer return impossible values?",
        f"{scene.bad_samples} of {total} samples are NaN or infinite; they are counted "
        "and left out."
        if scene.bad_samples
        else f"None of {total} samples is NaN or infinite.",
        f"{scene.bad_samples}",
    )


def _estimators(comparison: Comparison) -> Iterator[FindingRow]:
    for row in comparison.table():
        if row["estimator"] == "mean":
            continue
        name = NAMES.get(row["estimator"], row["estimator"])
        claim = "The paper's claim: does" if row["estimator"] == "elek2019" else "Does"
        low, high = row["improved_low"], row["improved_high"]
        majority = (
            "more than half" if low > 0.5 else "fewer than half" if high < 0.5 else "about half"
        )
        yield FindingRow(
            f"{claim} {name} beat the mean of {comparison.n} samples?",
            f"It improves {majority} of the estimates ({percent(row['improved'])}), at "
            f"{number(row['mse_ratio'])} times the squared and {number(row['relmse_ratio'])} times "
            f"the relative squared error, with a bias of {percent(row['bias'], sign=True)}.",
            f"improved {percent(row['improved'])}",
        )


def _without_reference(trained: SelfTraining) -> FindingRow:
    found = trained.content()
    return FindingRow(
        f"What becomes of {found['n']} samples without a reference?",
        f"Trained on them alone, ours has {found['mse_ratio']} times the squared and "
        f"{found['relmse_ratio']} times the relative squared error of their mean, and improves "
        f"{found['improved']} of the pixels, with a bias of {found['bias']}; {found['at_90']} of "
        "its intervals of 90\N{NO-BREAK SPACE}% hold the reference.",
        f"MSE × {found['mse_ratio']}",
    )


def _name(family: str) -> str:
    return NAMES.get(family, family)


def _listed(shares: Mapping[str, float], best: str) -> str:
    rest = sorted((item for item in shares.items() if item[0] != best), key=lambda item: -item[1])
    return ", ".join(f"{_name(name)} {percent(share)}" for name, share in rest)
