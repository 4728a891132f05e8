"""Claims: findings on claims of the paper as words, tables and figures, for a report or a study."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat._core.display import number
from chdstat.rendering.recipes import remake_of
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Claim, ClaimTest, Finding
from chdstat.viz.estimators import NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "claim_content",
    "claim_figures",
    "finding_content",
    "plot_findings",
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


# --- words --------------------------------------------------------------------------------------


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
        "method": (inspect.getdoc(claim.measure) or "").splitlines()[0],
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


# --- figures ------------------------------------------------------------------------------------


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
