"""Content of reports: results as text and tables, ready for JSON.

`report_content` is for a report on a scene, `analysis_content` for an analysis alone. Findings on
claims, and the tables of regions, families, patterns and estimators follow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from chdstat._core.display import NumberWriter, number, percent, step_of, with_margin
from chdstat._core.resampling import Interval
from chdstat.analysis import (
    Overview,
    bodies_of,
    key_intervals,
    noise_intervals,
    pooled_shares,
)
from chdstat.comparison import Comparison
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATE
from chdstat.comparison.metrics import in_words, shown_ratio
from chdstat.estimators import Combination
from chdstat.estimators.elek2019 import PAPER
from chdstat.patterns import PATTERNS, Atlas, Label
from chdstat.rendering.recipes import remake_of
from chdstat.reporting.headlines import (
    FEW_PIXELS,
    FEW_SAMPLES,
    LITTLE,
    bias_in_words,
    headlines,
    pixels_of,
    row_of,
    rows_by_label,
)
from chdstat.samples import Samples
from chdstat.samples.samples import provenance
from chdstat.studies.claims import CLAIMS, Claim, ClaimTest, Finding, SceneData
from chdstat.studies.paper_study import PUBLISHED
from chdstat.studies.studies import SceneStudy
from chdstat.viz.maps import LABEL_COLORS, names_of
from chdstat.viz.styling import NAMES, called, estimator_name, qualitative

if TYPE_CHECKING:
    import xarray as xr

Contents = Literal["short", "full", "claims"]
"""Kinds of a report on a scene."""

_LITTLE = 5e-4
"""Share below which a number counts as none."""
_TINY = 1e-4

_FLAGS = {pattern.name for pattern in PATTERNS}
_BODIES = {
    "gamma": "A gamma distribution: many small contributions add up",
    "lognormal": "A log-normal distribution: many factors multiply",
    "mixture": "A mixture: several modes, as of several kinds of paths",
    "neither": "One mode, which neither of these two describes",
}
"""What describes samples, in words."""


# --- the report on a scene ----------------------------------------------------------------------


def report_content(
    found: SceneStudy, contents: Contents, estimate: Combination | None
) -> dict[str, Any]:
    """Return the entries of the report, by their names, ready for JSON.

    `estimate` is the default estimate from all samples, if there is one.
    """
    data, scene, dataset = found.data, found.overview, found.data.analysis
    height, width, channels, spp = data.samples.shape
    pixels, each = f"{width} × {height} pixel{'s' * (height * width > 1)}", data.samples.spp_range
    about = f"{pixels}, {each} sample{'s' * (spp > 1)} each"
    entries: dict[str, Any] = {
        "title": data.samples.name,
        "remake": remake_note([data.samples]),
        "about": about + ", one channel" * (channels == 1),
        "bad_samples": _bad_samples(scene, data.samples),
        "rendered": "mitsuba_version" in data.samples.attrs,
        "provenance": list(provenance(data.samples.attrs, data.samples.shape).items()),
    }
    if contents != "claims":
        entries |= {
            "spp": each,
            "key_figures": _key_figures(found),
            "findings": headlines(found, estimate),
            "regions": _region_table(data),
            "regions_chosen": found.chosen,
            "alpha": percent(float(dataset.attrs["threshold_alpha"])),
            "misfit": percent(float(dataset.attrs["threshold_misfit"])),
            "order": ", ".join(
                called(label.name.lower()) for label in Label if label.name.lower() in _FLAGS
            ),
        }
        if found.noise and spp >= FEW_SAMPLES and scene.pixels >= FEW_PIXELS:
            entries["noise"] = _noise_table(found)
            entries["shapes"] = _shape_table(data)
        if found.comparison is not None:
            entries["estimators"] = _estimator_table(found.comparison)
    if contents != "short":
        tested = [finding for finding in found.findings if finding.tests]
        entries |= {
            "claims": [finding_content(finding) for finding in tested],
            "untested": _untested(found.findings),
            "deviations": _deviations(found),
        }
    if contents == "full":
        prefix = "threshold_"
        entries |= {
            "families": _family_table(dataset),
            "fit": _fit_content(scene),
            "patterns": _pattern_table(scene),
            "thresholds": {
                str(name).removeprefix(prefix): f"{float(value):g}"
                for name, value in dataset.attrs.items()
                if str(name).startswith(prefix)
            },
            "n_means": int(dataset.attrs.get("n_means", 0)),
            "agreement": number(scene.label_agreement),
        }
        if found.atlas is not None:
            entries["atlas"] = atlas_content(found.atlas)
    return entries


def analysis_content(samples: Samples, dataset: xr.Dataset) -> dict[str, Any]:
    """Return the text of a report on an analysis: sentences, findings, families and patterns.

    `dataset` is what `chdstat.analyze` returned for the samples.
    """
    found = SceneStudy(SceneData(samples.name, samples, given=dataset), ())
    scene, noise = found.overview, found.noise
    where = (
        f"The noisiest tenth of the pixels holds {percent(noise.noisiest)} of the relative "
        f"variance; {pixels_of(noise.label)} hold {percent(noise.share[noise.label])} of it."
    )
    return {
        "sentences": [
            f"{samples.name}: {samples.shape[1]} × {samples.shape[0]} pixels with "
            f"{samples.spp_range} samples each.",
            f"In the median pixel their standard deviation is {number(scene.variation[1])} times "
            f"their mean, and {percent(scene.null_share)} of all samples carry no light.",
            where if noise else "The samples of no pixel vary.",
            _bad_samples(scene, samples),
        ],
        "findings": [f"{row['finding']} {row['because']}" for row in headlines(found, None)],
        "families": _family_table(dataset),
        "patterns": _pattern_table(scene),
    }


def _key_figures(found: SceneStudy) -> list[dict[str, str]]:
    """Return up to four numbers, with 95 % intervals over blocks of pixels if possible."""
    scene = found.overview
    of_image = key_intervals(found.data.analysis, found.data.whole().blocks)
    nulls = of_image["null_share"]
    if scene.pixels == 1:  # there are no blocks of pixels, but its samples
        ends = found.data.analysis["null_heavy_interval"].values.ravel()
        nulls = Interval(scene.null_share, *map(float, ends))
    shown = [(*_known(nulls, percent), "of the samples find no light")]
    if scene.spp >= FEW_SAMPLES:
        spread = of_image["coefficient_of_variation"]
        label = "standard deviation of the samples over their mean"
        label += ", in the median pixel" * (scene.pixels > 1)
        shown.append((*_known(spread, number), label))
        if scene.pixels >= FEW_PIXELS:
            label = "of the relative variance is in the noisiest tenth of the pixels"
            shown.append((percent(found.noise.noisiest), "", label))
    row = row_of(found.comparison, DEFAULT_ESTIMATE)
    if found.comparison is not None and row is not None:
        ratio = Interval(*(row[f"mse_ratio{end}"] for end in ("", "_low", "_high")))
        label = f"squared error of the default estimate over the mean's, {found.comparison.n} "
        shown.append((*_known(ratio, number, beside=[1.0]), f"{label}samples"))
    names = ("value", "interval", "label")
    return [dict(zip(names, row, strict=True)) for row in shown if row[0] != "—"]


def _known(
    found: Interval[float], write: NumberWriter, beside: Sequence[float] = ()
) -> tuple[str, str]:
    """Return a number and the ends of its interval, if they say more, with the digits it has."""
    ends = found.ends(write, beside=beside)
    value = write(found.value, step=step_of(found.low, found.high, beside=beside))
    return value, "" if ends == f"{value} to {value}" else ends


def _bad_samples(scene: Overview, samples: Samples) -> str:
    total = scene.pixels * scene.spp - samples.absent()
    if scene.bad_samples:
        return f"{scene.bad_samples:,} of {total:,} samples are NaN or infinite."
    return f"None of {total:,} samples is NaN or infinite."


def _deviations(found: SceneStudy) -> list[str]:
    """Return deviations from Elek et al. 2019, as sentences."""
    height, width, _, spp = found.data.samples.shape
    edge, there = PUBLISHED.edge, []
    if spp < PUBLISHED.spp:
        there.append(f"{spp} samples per pixel in place of {PUBLISHED.spp}")
    if max(height, width) < edge:
        there.append(f"{width} × {height} pixels in place of {edge} × {edge}")
    network: Any = None if found.comparison is None else found.comparison.models.get(PAPER)
    return there if network is None else there + network.deviations()


# --- claims -------------------------------------------------------------------------------------


def remake_note(samples: Iterable[Samples]) -> str:
    """Return a note on scenes that are remakes of the paper's; "" if there are none."""
    found = {s.name: original for s in samples if (original := remake_of(s))}
    if not found:
        return ""
    listed = ", ".join(f"{name} remakes the paper's {original}" for name, original in found.items())
    return (
        f"{listed}: made for this library after the paper's figures, with other geometry and "
        "materials. What holds here need not hold in the original."
    )


def with_others(found: Mapping[str, Finding]) -> dict[str, Finding]:
    """Return findings by scene, each followed by the findings on other estimators."""
    rows = {}
    for scene, finding in found.items():
        rows[scene] = finding
        rows |= {f"{scene}, {called(n)}": other for n, other in finding.other_models.items()}
    return rows


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
    hypotheses = [finding.null_hypothesis for finding in found.values()]
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
    """Return one finding with all its tests, ready for JSON."""
    hypothesis = finding.null_hypothesis
    return {
        "number": finding.number,
        "name": finding.name,
        "claim": finding.claim,
        "about": next(
            f"About {c.about}." * bool(c.subject) for c in CLAIMS if c.number == finding.number
        ),
        "verdict": finding.verdict,
        "parts": [_test_content(test) for test in finding.tests],
        "needs": finding.reason if finding.verdict == "cannot tell" else "",
        "p": f"{_p_value(finding)} Null hypothesis: {hypothesis}." if hypothesis else "",
        "beside": [
            {**finding_content(other), "name": called(name)}
            for name, other in finding.other_models.items()
        ],
    }


def _untested(findings: Iterable[Finding]) -> list[str]:
    """Return which claims were not tested in a scene and why, grouped by reason."""
    reasons: dict[str, list[str]] = {
        "compare renders or scenes, as a study does": [
            _numbered(claim) for claim in CLAIMS if not claim.alone
        ]
    }
    for finding in findings:
        if not finding.tests:
            reason = f"{finding.reason[0].lower()}{finding.reason[1:].rstrip('.')}"
            reasons.setdefault(reason, []).append(_numbered(finding))
    return [f"{', '.join(names)} {reason}" for reason, names in reasons.items() if names]


def _numbered(claim: Claim | Finding) -> str:
    return f"{claim.number} ({claim.name})"


def _test_content(test: ClaimTest) -> dict[str, str]:
    unit = test.unit
    value, ends = _known(test.interval, number, beside=test.limits)
    written = f"√{unit.removesuffix('^1/2')}" if unit.endswith("^1/2") else unit
    return {
        "name": test.name + ("" if unit == "1" else f" ({written})"),
        "value": value,
        "interval": ends or "—",
        "claimed": test.claimed,
        "verdict": test.verdict,
    }


# --- tables -------------------------------------------------------------------------------------


def _fit_content(scene: Overview) -> dict[str, str]:
    """Return numbers of how well the families and the log-normal describe the pixels."""
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
    """Return a row for each region, with numbers of its central pixel."""
    rows = []
    colors = qualitative(len(data.regions))
    for region, color in zip(data.regions, colors, strict=True):
        y, x = region.center(*data.samples.shape[:2])
        found = data.analysis.isel(y=y, x=x)
        rows.append(
            {
                "name": NAMES.get(region.name, region.name),
                "pixel": f"({x}, {y})",
                "note": region.note,
                "color": color,
                "radiance": [number(v) for v in np.atleast_1d(found["mean"].values)],
                "nulls": percent(float(found["null_share"])),
                "variation": number(float(found["coefficient_of_variation"])),
                "tail": with_margin(
                    float(found["luminance_tail_index"]), 2 * float(found["long_tail_se"])
                ),
                "family": names_of(found["luminance_family"])[int(found["luminance_family"])],
            }
        )
    return rows


def _noise_table(found: SceneStudy) -> list[dict[str, str]]:
    """Return a row for each primary label: its share of image and noise, and what helps.

    Labels with few pixels have no ratio of errors.
    """
    noise, data = found.noise, found.data
    told = rows_by_label(found.comparison, noise, found.overview.pixels)
    own = {
        label: shown_ratio(row, "relmse_ratio")
        for label, rows in told.items()
        for row in rows
        if row["estimator"] == DEFAULT_ESTIMATE
    }
    shares = noise_intervals(data.analysis, noise, data.whole().blocks).share
    return [
        {
            "name": called(label),
            "color": LABEL_COLORS[called(label)],
            "pixels": percent(noise.pixels[label]),
            "share": shares[label].shown(percent),
            "meaning": Label[label.upper()].meaning,
            "cure": Label[label.upper()].cure_by(data.samples.attrs),
            "estimate": own.get(label, "—"),
        }
        for label, share in noise.share.items()
        if max(share, noise.pixels[label]) >= LITTLE
    ]


def _shape_table(data: SceneData) -> dict[str, Any] | None:
    """Return what describes the samples, and from how many on averages are Gaussian."""
    found = bodies_of(data.analysis, data.whole().blocks)
    if found is None:
        return None
    averages = [*found.gaussian_averages.items()]
    # The first, one in the middle and the last N.
    chosen = sorted({0, len(averages) // 2, len(averages) - 1}) if averages else []
    gaussian = {"Logarithms of single samples": found.gaussian_logarithms}
    gaussian |= {f"Averages of {n} samples": share for n, share in (averages[i] for i in chosen)}
    return {
        "bodies": [
            {"name": _BODIES[name], "share": share.shown(percent)}
            for name, share in found.bodies.items()
        ],
        "gaussian": [
            {"name": name.replace("of 1 samples", "of 1 sample"), "share": share.shown(percent)}
            for name, share in gaussian.items()
        ],
        "level": percent(found.level),
        "n_means": found.n_means,
    }


def _family_table(found: xr.Dataset) -> list[dict[str, str]]:
    """Return the share of each family under both criteria, over all channels."""
    criteria = {"bic": "best_family", "held_out": "held_out_best_family"}
    columns = {key: pooled_shares(found, name) for key, name in criteria.items() if name in found}
    return [
        {"name": called(name)}
        | {key: shares[name].shown(percent) for key, shares in columns.items()}
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
    """Return how many shapes recur, and how reliable they are."""
    return {
        "count": f"{len(found.share)} shape{'s recur' if len(found.share) > 1 else ' recurs'}",
        "repeatable": percent(found.repeatable),
        "stability": number(found.stability),
    }


def _estimator_table(comparison: Comparison) -> dict[str, Any]:
    """Return the measures of each estimator, and the settings of the comparison."""
    network: Any = comparison.models.get(PAPER)
    rows = [
        in_words(row)
        | {"name": estimator_name(row["estimator"]) + " *" * row["uses_neighbours"]}
        | {"bias": bias_in_words(row) if row["estimator"] != "mean" else ""}
        for row in comparison.table()
    ]
    return {
        "rows": rows,
        "left_out": comparison.notes.get("left out", ""),
        "n": comparison.n,
        "batches": comparison.batches,
        "excluded": comparison.excluded,
        "test_pixels": int(comparison.test_pixels.sum()),
        **({"iterations": 0} if network is None else network.effort()),
    }
