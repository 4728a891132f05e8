"""Content of the report on a scene: from results to words and tables, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from chdstat.analysis import Overview, pooled_shares
from chdstat.comparison import Comparison
from chdstat.comparison.self_training import LEVELS, SelfTraining
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS, Atlas
from chdstat.reporting.claims import remake_note
from chdstat.reporting.figures import names_of
from chdstat.reporting.typst import NAMES, between, number, percent
from chdstat.samples import Samples
from chdstat.studies.claims import SceneData
from chdstat.viz.styling import qualitative

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "FindingRow",
    "atlas_content",
    "estimator_table",
    "findings",
    "scene_content",
    "self_training_content",
]


# --- findings -----------------------------------------------------------------------------------


class FindingRow(NamedTuple):
    """One row of the table of findings.

    Attributes
    ----------
    question, answer
        In words.
    figure
        The number behind the answer.
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
    rows = [*_samples(scene), *_fits(scene), *_patterns(scene, atlas), *_averages(scene)]
    if comparison is not None:
        rows += _estimators(comparison)
    if self_training is not None:
        rows.append(_without_reference(self_training))
    return rows


def _row(known: float, question: str, answer: str, figure: str, *, otherwise: str) -> FindingRow:
    """Return a row; where `known` is not finite, one with the reason in place of a number."""
    if math.isfinite(known):
        return FindingRow(question, answer, figure)
    return FindingRow(question, otherwise, "—")


def _samples(scene: Overview) -> Iterator[FindingRow]:
    yield FindingRow(
        "How often does a path find no light?",
        f"{percent(scene.null_share)} of all samples are null; in {percent(scene.null_pixels)} of "
        "the pixels they are the majority.",
        percent(scene.null_share),
    )
    total = scene.pixels * scene.spp
    yield FindingRow(
        "Did the renderer return impossible values?",
        f"{scene.bad_samples} of {total} samples are NaN or infinite; they are counted "
        "and left out."
        if scene.bad_samples
        else f"None of {total} samples is NaN or infinite.",
        f"{scene.bad_samples}",
    )
    low, middle, high = (number(v) for v in scene.variation)
    yield _row(
        scene.variation[1],
        "How far do samples scatter?",
        f"The standard deviation of a pixel's samples is {middle} times their mean "
        f"(quartiles {low} and {high}).",
        f"{middle} ×",
        otherwise="No pixel has two samples and a mean above 0.",
    )


def _fits(scene: Overview) -> Iterator[FindingRow]:
    best, *others = sorted(scene.families.items(), key=lambda item: -item[1])
    rest = ", ".join(f"{_name(name)} {percent(share)}" for name, share in others)
    held_out = max(scene.families_held_out.items(), key=lambda item: item[1], default=None)
    agreed = (
        f"By held-out likelihood it is {_name(held_out[0])}, {percent(held_out[1])}."
        if held_out
        else ""
    )
    unfitted = "No pixel could be fitted."
    yield _row(
        best[1] or math.nan,
        "Which family describes the samples?",
        f"By BIC, {_name(best[0])} describes {percent(best[1])} of the pixel channels best "
        f"({rest}); the data is very strong for {percent(scene.decided)}. {agreed}".rstrip(),
        f"{_name(best[0])} {percent(best[1])}",
        otherwise=unfitted,
    )
    low, middle, high = (percent(v) for v in scene.misfit)
    yield _row(
        scene.misfit[1],
        "Is the best family a good one?",
        f"The distribution function of the samples is at most {middle} away from that of the best "
        f"family in the median pixel channel (quartiles {low} and {high}).",
        middle,
        otherwise=unfitted,
    )
    low, middle, high = (number(v) for v in scene.log_skewness)
    yield _row(
        scene.log_rejected,
        "Are logarithms of samples Gaussian?",
        f"In {percent(scene.log_rejected)} of the pixel channels normality is rejected; their "
        f"skewness has median {middle} (quartiles {low} and {high}).",
        f"{percent(scene.log_rejected)} rejected",
        otherwise="No pixel has enough positive samples to test.",
    )
    long = percent(scene.patterns["long_tail"])
    yield _row(
        scene.doubtful_variance,
        "Are tails long?",
        f"{long} of the pixels have a long tail. In {percent(scene.doubtful_variance)} of the "
        "pixel channels the estimated tail index is 1/2 or more, where neither the variance nor an "
        f"error bar can be trusted; in {percent(scene.unidentified_variance)} the samples do not "
        "show whether the variance is finite.",
        long,
        otherwise="No pixel has enough positive samples to look at its tail.",
    )


def _patterns(scene: Overview, atlas: Atlas | None) -> Iterator[FindingRow]:
    share = scene.patterns["firefly_dominated"]
    yield FindingRow(
        "Does one sample dominate a pixel?",
        f"In {percent(share)} of the pixels, a single one of {scene.spp} samples carries a large "
        "share of the mean."
        if share
        else f"In no pixel does a single one of {scene.spp} samples carry a large share of the "
        "mean.",
        percent(share),
    )
    two, more = scene.patterns["bimodal"], scene.patterns["multimodal"]
    yield FindingRow(
        "Do several kinds of paths mix?",
        f"{percent(two)} of the pixels have two clearly separated modes of log luminance, "
        f"{percent(more)} three or more.",
        percent(two + more),
    )
    kappa = number(scene.label_agreement)
    yield _row(
        scene.label_agreement,
        "Do patterns form regions?",
        f"Neighbouring pixels share their primary pattern with a kappa of {kappa}: 0 would be "
        "chance, 1 complete agreement.",
        f"κ = {kappa}",
        otherwise="All pixels have the same label, or none.",
    )
    if atlas is not None:
        count = len(atlas.share)
        answer = "All pixels have one shape, but for scale and noise."
        if count > 1:
            answer = (
                f"{count} typical shapes recur; the most frequent is that of "
                f"{percent(float(atlas.share[0]))} of the pixels. Pixels form a continuum, in "
                "which these are landmarks."
            )
        yield FindingRow("Which shapes recur?", answer, f"{count}")


def _averages(scene: Overview) -> Iterator[FindingRow]:
    if any(math.isfinite(share) for share in scene.averages.values()):
        fewest, most = min(scene.averages), max(scene.averages)
        single, averaged = percent(scene.averages[fewest]), percent(scene.averages[most])
        yield FindingRow(
            "Are pixel estimates Gaussian?",
            f"Normality is rejected in {averaged} of the pixel channels for averages of {most} "
            f"samples, in {single} for single samples. A test of few averages is weak: with more "
            "samples it would reject more often.",
            f"N = {most}: {averaged}",
        )


def _estimators(comparison: Comparison) -> Iterator[FindingRow]:
    for row in comparison.table():
        if row["estimator"] == "mean":
            continue
        claim = "The paper's claim: does" if row["estimator"] == "elek2019" else "Does"
        low, high = row["improved_low"], row["improved_high"]
        majority = (
            "more than half" if low > 0.5 else "fewer than half" if high < 0.5 else "about half"
        )
        yield FindingRow(
            f"{claim} {_name(row['estimator'])} beat the mean of {comparison.n} samples?",
            f"It improves {majority} of the estimates ({percent(row['improved'])}), at "
            f"{number(row['mse_ratio'])} times the squared and {number(row['relmse_ratio'])} times "
            f"the relative squared error, with a bias of {percent(row['bias'], sign=True)}.",
            f"improved {percent(row['improved'])}",
        )


def _without_reference(trained: SelfTraining) -> FindingRow:
    found = self_training_content(trained)
    return FindingRow(
        f"How good is an estimate from {found['n']} samples without a reference?",
        f"Trained on them alone, ours has {found['mse_ratio']} times the squared and "
        f"{found['relmse_ratio']} times the relative squared error of their mean, and improves "
        f"{found['improved']} of the pixels, with a bias of {found['bias']}; {found['at_90']} of "
        "its intervals of 90\N{NO-BREAK SPACE}% contain the reference.",
        f"MSE × {found['mse_ratio']}",
    )


def _name(name: str) -> str:
    return NAMES.get(name, name)


# --- tables -------------------------------------------------------------------------------------


def scene_content(data: SceneData, scene: Overview) -> dict[str, Any]:
    """Return the entries of the report on the samples and their analysis, by their names."""
    dataset = data.analysis
    prefix = "threshold_"
    return {
        "title": data.samples.name,
        "remake": remake_note([data.samples]),
        "spp": data.samples.spp,
        "provenance": _provenance_table(data.samples),
        "regions": _region_table(data),
        "families": _family_table(dataset),
        "patterns": _pattern_table(scene),
        "alpha": percent(float(dataset.attrs["false_discovery_rate"])),
        "thresholds": {
            str(name).removeprefix(prefix): number(float(value))
            for name, value in dataset.attrs.items()
            if str(name).startswith(prefix)
        },
        "n_means": int(dataset.attrs.get("n_means", 0)),
    }


def _provenance_table(samples: Samples) -> list[tuple[str, str]]:
    """Return the settings that render the same samples again, by name."""
    attrs = samples.attrs
    height, width, channels, spp = samples.shape
    integrator = dict(attrs.get("integrator") or {})
    kind = integrator.pop("type", "")
    settings = ", ".join(f"{name} {value}" for name, value in integrator.items())
    seconds = float(attrs.get("render_seconds") or 0)
    rows = {
        "Scene": f"{samples.name} ({attrs.get('scene_source', 'samples given')})",
        "Scene hash": str(attrs.get("scene_hash", ""))[:16],
        "Integrator": f"{kind} ({settings})" if settings else kind,
        "Image": f"{width} × {height} pixels, {channels} channels, {spp} samples per pixel",
        "Random numbers": f"{attrs['sampler']} sampler, seed {attrs['seed']}"
        if "seed" in attrs
        else "",
        "Filter": str(attrs.get("filter", "")),
        "Renderer": f"Mitsuba {attrs['mitsuba_version']}, {attrs['backend']}"
        if "mitsuba_version" in attrs
        else "",
        "Rendering time": f"{seconds:.0f} s" if seconds else "",
        "Note": "; ".join(attrs.get("notes") or []),
    }
    return [(name, value) for name, value in rows.items() if value]


def _region_table(data: SceneData) -> list[dict[str, Any]]:
    """Return a row for each region, with the numbers of the pixel in its middle."""
    rows = []
    colors = qualitative(len(data.regions))
    for region, color in zip(data.regions, colors, strict=True):
        y, x = region.center(*data.samples.shape[:2])
        found = data.analysis.isel(y=y, x=x)
        family = names_of(found["luminance_family"])[int(found["luminance_family"])]
        rows.append(
            {
                "name": region.name,
                "pixel": f"({x}, {y})",
                "note": region.note,
                "color": color,
                "radiance": [number(v) for v in np.atleast_1d(found["mean"].values)],
                "nulls": percent(float(found["null_share"])),
                "variation": number(float(found["coefficient_of_variation"])),
                "tail": between(
                    float(found["long_tail_statistic"]), 2 * float(found["long_tail_se"])
                ),
                "family": family,
            }
        )
    return rows


def _family_table(found: xr.Dataset) -> list[dict[str, str]]:
    """Return the share of each family by both criteria, over all channels."""
    criteria = {"bic": "best_family", "held_out": "held_out_best_family"}
    columns = {key: pooled_shares(found, name) for key, name in criteria.items() if name in found}
    return [
        {"name": _name(name)}
        | {
            key: f"{percent(shares[name].share)} [{percent(shares[name].low)}, "
            f"{percent(shares[name].high)}]"
            for key, shares in columns.items()
        }
        for name in columns["bic"]
    ]


def _pattern_table(scene: Overview) -> list[dict[str, str]]:
    """Return the rows of the table of patterns, the most frequent first."""
    return [
        {
            "name": _name(p.name),
            "share": percent(scene.patterns[p.name]),
            "meaning": p.meaning,
            "statistic": p.statistic,
            "rule": p.rule,
        }
        for p in sorted(PATTERNS, key=lambda p: -scene.patterns[p.name])
    ]


def atlas_content(found: Atlas) -> dict[str, str]:
    """Return how many shapes recur, and how far these can be trusted."""
    return {
        "count": str(len(found.share)),
        "repeatable": percent(found.repeatable),
        "stability": number(found.stability),
    }


def estimator_table(comparison: Comparison) -> dict[str, Any]:
    """Return the measures of each estimator, and the settings of the comparison."""
    rows = [
        {
            "name": _name(row["estimator"]),
            "mse": number(row["mse"]),
            "mse_ratio": _with_interval(row, "mse_ratio"),
            "relmse_ratio": _with_interval(row, "relmse_ratio"),
            "improved": "" if row["estimator"] == "mean" else percent(row["improved"]),
            "bias": percent(row["bias"], sign=True),
            "fireflies": number(row["fireflies_left"]),
        }
        for row in comparison.table()
    ]
    trained = [m for m in comparison.models.values() if isinstance(m, MLP)]
    return {
        "rows": rows,
        "n": comparison.n,
        "batches": comparison.batches,
        "excluded": comparison.excluded,
        "test_pixels": int(comparison.test_pixels.sum()),
        "iterations": int(trained[0].history.iteration[-1]) if trained else 0,
        "train_pixels": len(trained[0].train_pixels) if trained else 0,
        "fewer_pixels": bool(trained) and len(trained[0].train_pixels) < trained[0].config.pixels,
    }


def _with_interval(row: Mapping[str, Any], name: str) -> str:
    low, high = number(row[f"{name}_low"]), number(row[f"{name}_high"])
    return f"{number(row[name])} [{low}, {high}]"


def self_training_content(trained: SelfTraining) -> dict[str, Any]:
    """Return the errors of an estimate without a reference, and the coverage of its intervals."""
    _, row = trained.comparison.table()
    shares = [percent(measured[LEVELS.index(0.9)]) for measured in trained.coverage.values()]
    return {
        "n": trained.comparison.n,
        "iterations": trained.iterations,
        "mse_ratio": number(row["mse_ratio"]),
        "relmse_ratio": number(row["relmse_ratio"]),
        "improved": percent(row["improved"]),
        "bias": percent(row["bias"], sign=True),
        "at_90": shares[0],
        "at_90_supervised": shares[1],
    }
