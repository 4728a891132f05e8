"""Content of reports: from results to words and tables, ready for JSON.

First the report on a scene: `scene_content`, and of an analysis alone `analysis_content`. Then
findings on claims, and the tables of regions, families, patterns and estimators.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.display import between, number, percent, with_interval
from chdstat._core.resampling import Interval
from chdstat.analysis import (
    Noise,
    Overview,
    key_intervals,
    noise_of,
    pooled_shares,
)
from chdstat.comparison import Comparison
from chdstat.comparison.tables import in_words, shown_ratio
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS, Atlas
from chdstat.patterns.attribution import largest_part
from chdstat.rendering.recipes import remake_of
from chdstat.samples import Samples
from chdstat.samples.samples import provenance
from chdstat.studies.claims import FINDINGS, Claim, ClaimTest, Finding, SceneData
from chdstat.studies.run import SceneStudy
from chdstat.viz.estimators import called
from chdstat.viz.maps import names_of
from chdstat.viz.styling import qualitative

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "PUBLISHED_SIZE",
    "PUBLISHED_SPP",
    "analysis_content",
    "atlas_content",
    "claim_content",
    "finding_content",
    "remake_note",
    "scene_content",
    "with_others",
]

PUBLISHED_SPP, PUBLISHED_SIZE = 2000, 800
"""Samples per pixel, and pixels along each edge, of the images of Elek et al. 2019."""
_TINY = 1e-4
_MEANING = {p.name: p.meaning for p in PATTERNS}


# --- the report on a scene ----------------------------------------------------------------------


def scene_content(found: SceneStudy) -> dict[str, Any]:
    """Return the entries of the report, by their names, ready for JSON."""
    data, scene, dataset = found.data, found.overview, found.data.analysis
    prefix = "threshold_"
    noise = noise_of(dataset)
    entries = {
        "title": data.samples.name,
        "remake": remake_note([data.samples]),
        "spp": data.samples.spp,
        "luminance": data.samples.shape[2] == 3,
        "abstract": _abstract(found, noise),
        "key_figures": _key_figures(found),
        "findings": _headlines(found, noise),
        "claims": [finding_content(finding) for finding in found.findings],
        "provenance": list(provenance(data.samples.attrs, data.samples.shape).items()),
        "regions": _region_table(data),
        "families": _family_table(dataset),
        "fit": _fit_content(scene),
        "patterns": _pattern_table(scene),
        "alpha": percent(float(dataset.attrs["false_discovery_rate"])),
        "thresholds": {
            str(name).removeprefix(prefix): number(float(value))
            for name, value in dataset.attrs.items()
            if str(name).startswith(prefix)
        },
        "n_means": int(dataset.attrs.get("n_means", 0)),
        "agreement": number(scene.label_agreement),
        "bad_samples": _bad_samples(scene),
        "deviations": _deviations(found),
    }
    if found.atlas is not None:
        entries["atlas"] = atlas_content(found.atlas)
    if found.comparison is not None:
        entries["estimators"] = _estimator_table(found.comparison)
    return entries


def analysis_content(samples: Samples, dataset: xr.Dataset) -> dict[str, Any]:
    """Return the text of a report on an analysis: sentences, findings, families and patterns.

    `dataset` is what `chdstat.analyze` returned for the samples.
    """
    found = SceneStudy(SceneData(samples.name, samples, given=dataset), ())
    scene, noise = found.overview, noise_of(dataset)
    return {
        "sentences": [
            f"{samples.name}: {samples.shape[1]} × {samples.shape[0]} pixels with {samples.spp} "
            "samples each.",
            *_on_noise(scene, noise),
            _bad_samples(scene),
        ],
        "findings": [f"{row['finding']} {row['because']}" for row in _headlines(found, noise)],
        "families": _family_table(dataset),
        "patterns": _pattern_table(scene),
    }


def _abstract(found: SceneStudy, noise: Noise) -> list[str]:
    """Return the report in four sentences."""
    height, width, _, spp = found.data.samples.shape
    sentences = [
        f"This report looks at the {spp} samples of radiance that each of the {width} × {height} "
        f"pixels of {found.data.samples.name} received before they are averaged.",
        *_on_noise(found.overview, noise),
    ]
    best = _best(found.comparison)
    if best is None or found.comparison is None:
        return [*sentences, "There are too few samples to compare estimators."]
    return [
        *sentences,
        f"From {found.comparison.n} samples, {called(best['estimator'])} estimates best, "
        f"with {number(best['relmse_ratio'])} times the relative and "
        f"{number(best['mse_ratio'])} times the squared error of the sample mean.",
    ]


def _on_noise(scene: Overview, noise: Noise) -> list[str]:
    """Return two sentences on how much the samples vary, and where."""
    where = (
        f"The noisiest tenth of the pixels holds {percent(noise.noisiest)} of the relative "
        f"variance; {_pixels(noise.label)} hold {percent(noise.share)} of it."
    )
    return [
        f"In the median pixel their standard deviation is {number(scene.variation[1])} times their "
        f"mean, and {percent(scene.null_share)} of all samples carry no light.",
        where if math.isfinite(noise.share) else "The samples of no pixel vary.",
    ]


def _key_figures(found: SceneStudy) -> list[dict[str, str]]:
    """Return four numbers with 95 % intervals, three of the samples and one of the estimators."""
    of_image = key_intervals(found.data.analysis, found.data.whole().blocks)
    labels: dict[str, tuple[Callable[[float], str], str]] = {
        "null_share": (percent, "of the samples are null"),
        "coefficient_of_variation": (number, "standard deviation over mean, median pixel"),
        "long_tail": (percent, "of the pixels have a long tail"),
    }
    shown = [
        (write(of_image[name].value), label, _between(of_image[name], write))
        for name, (write, label) in labels.items()
    ]
    best = _best(found.comparison)
    if best is not None and found.comparison is not None:
        name, n = called(best["estimator"]), found.comparison.n
        low, high = (number(best[f"relmse_ratio_{end}"]) for end in ("low", "high"))
        label = f"relative squared error of {name} over that of the mean of {n} samples"
        shown.append((f"{number(best['relmse_ratio'])}×", label, f"{low} to {high}"))
    return [dict(zip(("value", "label", "interval"), row, strict=True)) for row in shown]


def _headlines(found: SceneStudy, noise: Noise) -> list[dict[str, str]]:
    """Return at most six findings in plain words, each with what stands behind it.

    What is noisy, why, what helps, and by how much.
    """
    scene = found.overview
    rows = [
        *_where_noise_is(noise),
        *_which_paths(found.data),
        (
            f"{percent(scene.null_share)} of all samples find no light.",
            f"In {percent(scene.patterns['null_heavy'])} of the pixels null samples are "
            "significantly more than half: better light sampling would help there.",
        ),
        *_trust(scene),
    ]
    if scene.patterns["firefly_dominated"] > 0 and noise.label != "firefly_dominated":
        rows.append(
            (
                f"One sample decides {percent(scene.patterns['firefly_dominated'])} of the pixels.",
                f"There a single one of {scene.spp} samples carries so much of the mean that the "
                "pixel is a firefly, or would be one without it.",
            )
        )
    if found.comparison is not None:
        rows += _what_helps(found.comparison)
    return [dict(zip(("finding", "because"), row, strict=True)) for row in rows[:6]]


def _where_noise_is(noise: Noise) -> Iterator[tuple[str, str]]:
    """Yield which pattern holds most of the noise; nothing where there is none."""
    if math.isfinite(noise.share):
        yield (
            f"The largest part of the noise is in {_pixels(noise.label)}.",
            f"By the first pattern of each, they are {percent(noise.pixels)} of the image and "
            f"hold {percent(noise.share)} of its relative variance: "
            f"{_MEANING.get(noise.label, 'no pattern of the table applies')}.",
        )


def _which_paths(data: SceneData) -> Iterator[tuple[str, str]]:
    """Yield which paths and lights make most of the variance, where samples are known by them."""
    samples = data.samples
    known = {"depth": samples.depths, "light": samples.lights}
    for by in ("depth", "light"):
        part = largest_part(samples, data.whole().blocks, by=by) if known[by] else None
        if part is None:
            continue
        if by == "light":
            who = "Other light makes" if part.place < 0 else f"Light from {part.name} makes"
        else:
            who = f"Paths of {part.name} make" if part.place else "Emitted and direct light makes"
        yield (
            f"{who} the largest part of the variance.",
            f"In the average pixel that is {percent(part.share.value)} of it "
            f"[{_between(part.share, percent)}], and {percent(part.mean)} of the light.",
        )


def _pixels(label: str) -> str:
    """Return what to call the pixels of a primary label."""
    return f"{called(label)} pixels" if label in _MEANING else f"pixels labelled '{called(label)}'"


def _trust(scene: Overview) -> Iterator[tuple[str, str]]:
    """Yield how far error bars can be trusted."""
    if not any(math.isfinite(share) for share in scene.averages.values()):
        return
    most = max(scene.averages)
    rejected = scene.averages[most]
    yield (
        f"Averages of {most} samples are not Gaussian in {percent(rejected)} of the channels.",
        "There, error bars that presume it mislead. In "
        f"{percent(scene.doubtful_variance)} the estimated tail index is at least 1/2: the "
        "variance may be infinite, and no error bar holds.",
    )


def _what_helps(comparison: Comparison) -> Iterator[tuple[str, str]]:
    best = _best(comparison)
    if best is None:
        return
    name = called(best["estimator"])
    if not best["relmse_ratio_high"] < 1:
        yield (
            "No estimator is clearly better than the mean.",
            f"The best, {name}, has {shown_ratio(best, 'relmse_ratio')} times its relative "
            "squared error.",
        )
        return
    yield (
        f"{name[0].upper()}{name[1:]} helps most.",
        f"From {comparison.n} samples it has {shown_ratio(best, 'relmse_ratio')} times the "
        f"relative and {shown_ratio(best, 'mse_ratio')} times the squared error of the mean, "
        f"and improves {percent(best['improved'])} of the estimates, with a bias of "
        f"{percent(best['bias'], sign=True)}.",
    )


def _between(interval: Interval[float], write: Callable[[float], str]) -> str:
    known = math.isfinite(interval.low) and math.isfinite(interval.high)
    return f"{write(interval.low)} to {write(interval.high)}" if known else ""


def _best(comparison: Comparison | None) -> dict[str, Any] | None:
    """Return the row of the estimator with the least relative squared error; None without any.

    Those that raise the squared error stand back, as they buy the one error with the other.
    """
    rows = [] if comparison is None else comparison.table()
    rows = [row for row in rows if row["estimator"] != "mean"]
    rows = [row for row in rows if not row["mse_ratio_low"] > 1] or rows
    return min(rows, key=lambda row: row["relmse_ratio"], default=None)


def _bad_samples(scene: Overview) -> str:
    total = scene.pixels * scene.spp
    if scene.bad_samples:
        return f"{scene.bad_samples} of {total} samples are NaN or infinite."
    return f"None of {total} samples is NaN or infinite."


def _deviations(found: SceneStudy) -> list[str]:
    """Return what was not done as Elek et al. 2019 did it, in words."""
    height, width, _, spp = found.data.samples.shape
    there = []
    if spp < PUBLISHED_SPP:
        there.append(f"{spp} samples per pixel in place of {PUBLISHED_SPP}")
    if max(height, width) < PUBLISHED_SIZE:
        there.append(f"{width} × {height} pixels in place of {PUBLISHED_SIZE} × {PUBLISHED_SIZE}")
    for model in [] if found.comparison is None else found.comparison.models.values():
        if isinstance(model, MLP):
            done, published = int(model.history.iteration[-1]), model.config.iterations
            if done < published:
                there.append(f"{done} minibatches train its network in place of {published}")
            used = len(model.train_pixels)
            if used < model.config.pixels:
                there.append(f"{used} pixels train it in place of {model.config.pixels}")
    return there


# --- claims -------------------------------------------------------------------------------------


def remake_note(samples: Iterable[Samples]) -> str:
    """Return a note on the scenes that are remakes of the paper's; "" where none is."""
    found = {s.name: original for s in samples if (original := remake_of(s))}
    if not found:
        return ""
    listed = ", ".join(f"{name} (of {original})" for name, original in found.items())
    one = len(found) == 1
    return (
        f"{'A remake' if one else 'Remakes'} of the paper's scene{'s' * (not one)}: {listed}. "
        f"{'It was' if one else 'They were'} made for this library after the paper's figures, with "
        f"other geometry and materials: what holds here need not hold of the paper's own."
    )


def with_others(found: Mapping[str, Finding]) -> dict[str, Finding]:
    """Return findings by scene, each followed by those on other estimators."""
    rows = {}
    for scene, finding in found.items():
        rows[scene] = finding
        rows |= {f"{scene}, {called(n)}": other for n, other in finding.other_models.items()}
    return rows


# --- claims ----------------------------------------------------------------------------


def claim_content(claim: Claim, found: Mapping[str, Finding]) -> dict[str, Any]:
    """Return a claim with its verdicts and reasons in several scenes, ready for JSON.

    Scenes with the same verdict and reason share a row.

    Parameters
    ----------
    claim
        The claim.
    found
        Findings on it, by scene.
    """
    scenes_of: dict[tuple[str, str], list[str]] = {}
    for name, finding in with_others(found).items():
        reason = f"{finding.reason} {_p_value(finding)}".rstrip()
        scenes_of.setdefault((finding.verdict, reason), []).append(name)
    hypotheses = [finding.details.get("null_hypothesis", "") for finding in found.values()]
    return {
        "number": claim.number,
        "name": claim.name,
        "claim": claim.claim,
        "about": f"About {claim.about}.",
        "method": claim.method,
        "rows": [
            {"scenes": names, "verdict": verdict, "reason": reason}
            for (verdict, reason), names in scenes_of.items()
        ],
        "null_hypothesis": next(filter(None, hypotheses), ""),
    }


def _p_value(finding: Finding) -> str:
    p = finding.p_value
    if p is None or not math.isfinite(p):
        return ""
    return f"p {f'= {number(p)}' if p >= _TINY else '< 0.0001'}."


def finding_content(finding: Finding) -> dict[str, Any]:
    """Return one finding with every test that was made, ready for JSON."""
    hypothesis = finding.details.get("null_hypothesis", "")
    return {
        "number": finding.number,
        "name": finding.name,
        "claim": finding.claim,
        "about": next(f"About {c.about}." for c in FINDINGS if c.number == finding.number),
        "verdict": finding.verdict,
        "parts": [_test_content(test) for test in finding.tests],
        "needs": finding.reason if finding.verdict == "cannot tell" else "",
        "p": f"{_p_value(finding)} Null hypothesis: {hypothesis}." if hypothesis else "",
        "beside": [
            {**finding_content(other), "name": called(name)}
            for name, other in finding.other_models.items()
        ],
    }


def _test_content(test: ClaimTest) -> dict[str, str]:
    unit = test.unit
    written = f"√{unit.removesuffix('^1/2')}" if unit.endswith("^1/2") else unit
    return {
        "name": test.name + ("" if unit == "1" else f" ({written})"),
        "value": number(test.interval.value),
        "interval": test.between(number) or "—",
        "claimed": test.claimed,
        "verdict": test.verdict,
    }


# --- tables -------------------------------------------------------------------------------------


def _fit_content(scene: Overview) -> dict[str, str]:
    """Return how well the families and the log-normal describe the pixels, in numbers."""
    misfit, skewness = scene.misfit, scene.log_skewness
    return {
        "decided": percent(scene.decided),
        "misfit": percent(misfit[1]),
        "misfit_quartiles": f"{percent(misfit[0])} and {percent(misfit[2])}",
        "log_rejected": percent(scene.log_rejected),
        "log_skewness": number(skewness[1]),
        "log_skewness_quartiles": f"{number(skewness[0])} and {number(skewness[2])}",
        "doubtful": percent(scene.doubtful_variance),
        "unidentified": percent(scene.unidentified_variance),
    }


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
        {"name": called(name)}
        | {
            key: with_interval(shares[name].share, shares[name].low, shares[name].high, percent)
            for key, shares in columns.items()
        }
        for name in columns["bic"]
    ]


def _pattern_table(scene: Overview) -> list[dict[str, str]]:
    """Return the rows of the table of patterns, the most frequent first."""
    return [
        {
            "name": called(p.name),
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


def _estimator_table(comparison: Comparison) -> dict[str, Any]:
    """Return the measures of each estimator, and the settings of the comparison."""
    trained = [m for m in comparison.models.values() if isinstance(m, MLP)]
    return {
        "rows": [in_words(row) for row in comparison.table()],
        "notes": comparison.notes,
        "n": comparison.n,
        "batches": comparison.batches,
        "excluded": comparison.excluded,
        "test_pixels": int(comparison.test_pixels.sum()),
        "iterations": int(trained[0].history.iteration[-1]) if trained else 0,
        "train_pixels": len(trained[0].train_pixels) if trained else 0,
        "fewer_pixels": bool(trained) and len(trained[0].train_pixels) < trained[0].config.pixels,
    }
