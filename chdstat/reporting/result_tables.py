"""Results in reports: findings on claims as words and figures, and tables.

Tables have rows of regions, families, patterns and estimators, as they are shown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat._core.display import between, number, percent, with_interval
from chdstat.analysis import Overview, pooled_shares
from chdstat.comparison import Comparison
from chdstat.comparison.tables import in_words
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS, Atlas
from chdstat.rendering.recipes import remake_of
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Claim, ClaimTest, Finding, SceneData
from chdstat.viz.estimators import NAMES
from chdstat.viz.maps import names_of
from chdstat.viz.styling import qualitative

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = [
    "atlas_content",
    "claim_content",
    "claim_figures",
    "estimator_table",
    "family_table",
    "finding_content",
    "fit_content",
    "label_of",
    "pattern_table",
    "plot_findings",
    "region_table",
    "remake_note",
    "with_others",
]

_TINY = 1e-4


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
        rows |= {f"{scene}, {NAMES.get(n, n)}": other for n, other in finding.other_models.items()}
    return rows


# --- words on claims ----------------------------------------------------------------------------


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
            {**finding_content(other), "name": NAMES.get(name, name)}
            for name, other in finding.other_models.items()
        ],
    }


def _test_content(test: ClaimTest) -> dict[str, str]:
    unit, least, most = test.unit, test.least, test.most
    written = f"√{unit.removesuffix('^1/2')}" if unit.endswith("^1/2") else unit
    claimed = f"{number(least)} to {number(most)}"
    if math.isinf(least):
        claimed = f"at most {number(most)}"
    elif math.isinf(most):
        claimed = f"at least {number(least)}"
    return {
        "name": test.name + ("" if unit == "1" else f" ({written})"),
        "value": number(test.interval.value),
        "interval": test.between(number) or "—",
        "claimed": claimed,
        "verdict": test.verdict,
    }


# --- figures of claims --------------------------------------------------------------------------


def claim_figures(claim: int, found: Mapping[str, Finding]) -> dict[str, Figure]:
    """Draw findings on one claim, by scene: intervals, and what the findings show."""
    drawn = {}
    tests = {name: finding.tests for name, finding in with_others(found).items() if finding.tests}
    if tests:
        drawn[f"claim{claim}"] = viz.claim_intervals(tests)
    # What is about all scenes, or the only one, needs no title.
    titles = found if len(found) > 1 else [""] * len(found)
    shown = plot_findings(dict(zip(titles, found.values(), strict=True)))
    if shown is not None:
        drawn[f"plots{claim}"] = shown
    return drawn


def plot_findings(found: Mapping[str, Finding]) -> Figure | None:
    """Draw what findings show, each under its title; None where none has anything to show."""
    shown = {
        title: finding.plot_data
        for title, finding in found.items()
        if any(np.isfinite(np.asarray(y)).any() for _, y in finding.plot_data.series.values())
    }
    return viz.finding_plots(shown) if shown else None


# --- tables -------------------------------------------------------------------------------------


def label_of(name: str) -> str:
    """Return what text calls an estimator, a family or a pattern."""
    return NAMES.get(name, name)


def fit_content(scene: Overview) -> dict[str, str]:
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


def region_table(data: SceneData) -> list[dict[str, Any]]:
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


def family_table(found: xr.Dataset) -> list[dict[str, str]]:
    """Return the share of each family by both criteria, over all channels."""
    criteria = {"bic": "best_family", "held_out": "held_out_best_family"}
    columns = {key: pooled_shares(found, name) for key, name in criteria.items() if name in found}
    return [
        {"name": label_of(name)}
        | {
            key: with_interval(shares[name].share, shares[name].low, shares[name].high, percent)
            for key, shares in columns.items()
        }
        for name in columns["bic"]
    ]


def pattern_table(scene: Overview) -> list[dict[str, str]]:
    """Return the rows of the table of patterns, the most frequent first."""
    return [
        {
            "name": label_of(p.name),
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
