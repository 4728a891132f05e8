"""Claims: findings on claims of the paper as words, tables and figures, for a report or a study."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat.rendering.recipes import remake_of
from chdstat.reporting.typst import NAMES, number
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Claim, ClaimTest, Finding
from chdstat.viz.claims import VERDICTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "asked",
    "chips",
    "claim_content",
    "claim_figures",
    "finding_content",
    "plot_findings",
    "remake_note",
]

_TINY = 1e-4


def chips() -> dict[str, dict[str, str]]:
    """Return colour and mark of each verdict."""
    return {verdict: {"color": c, "mark": m} for verdict, (c, m) in VERDICTS.items()}


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


def asked(found: Mapping[str, Finding]) -> dict[str, Finding]:
    """Return findings by scene, each followed by those that stand beside it."""
    rows = {}
    for scene, finding in found.items():
        rows[scene] = finding
        rows |= {f"{scene}, {NAMES.get(n, n)}": other for n, other in finding.beside.items()}
    return rows


# --- words --------------------------------------------------------------------------------------


def claim_content(claim: Claim, found: Mapping[str, Finding]) -> dict[str, Any]:
    """Return a claim with its verdicts and reasons in several scenes, ready for JSON.

    Parameters
    ----------
    claim
        What was claimed.
    found
        What was found on it, by scene.
    """
    hypotheses = [_null_hypothesis(finding) for finding in found.values()]
    return {
        "number": claim.number,
        "name": claim.name,
        "claim": claim.claim,
        "about": f"About {claim.about}.",
        "method": (inspect.getdoc(claim.measure) or "").splitlines()[0],
        "rows": _rows(asked(found)),
        "null_hypothesis": next(filter(None, hypotheses), ""),
    }


def _null_hypothesis(finding: Finding) -> str:
    return str(finding.details.get("null_hypothesis", ""))


def _rows(found: Mapping[str, Finding]) -> list[dict[str, Any]]:
    """Return rows of verdict and reason; scenes with the same ones share a row."""
    scenes_of: dict[tuple[str, str], list[str]] = {}
    for name, finding in found.items():
        reason = f"{finding.reason} {_p_value(finding)}".rstrip()
        scenes_of.setdefault((finding.verdict, reason), []).append(name)
    return [
        {"scenes": names, "verdict": verdict, "reason": reason}
        for (verdict, reason), names in scenes_of.items()
    ]


def _p_value(finding: Finding) -> str:
    p = finding.p_value
    if p is None or not math.isfinite(p):
        return ""
    return f"p {f'= {number(p)}' if p >= _TINY else '< 0.0001'}."


def finding_content(finding: Finding) -> dict[str, Any]:
    """Return one finding with every part that was measured, ready for JSON."""
    hypothesis = _null_hypothesis(finding)
    return {
        "number": finding.number,
        "name": finding.name,
        "claim": finding.claim,
        "about": next(f"About {c.about}." for c in FINDINGS if c.number == finding.number),
        "verdict": finding.verdict,
        "parts": [_part_content(part) for part in finding.parts],
        "needs": finding.reason if finding.verdict == "cannot tell" else "",
        "p": f"{_p_value(finding)} Null hypothesis: {hypothesis}." if hypothesis else "",
        "beside": [
            {**finding_content(other), "name": NAMES.get(name, name)}
            for name, other in finding.beside.items()
        ],
    }


def _part_content(part: ClaimTest) -> dict[str, str]:
    unit = "" if part.statistic.unit == "1" else f" ({_unit(part.statistic.unit)})"
    return {
        "name": f"{part.statistic.name}{unit}",
        "value": number(part.statistic.value),
        "interval": part.between(number) or "—",
        "claimed": " ".join(_claimed(part)),
        "verdict": part.verdict,
    }


def _unit(unit: str) -> str:
    return f"√{unit.removesuffix('^1/2')}" if unit.endswith("^1/2") else unit


def _claimed(part: ClaimTest) -> Iterator[str]:
    """Yield the range of a claim, in words."""
    if math.isfinite(part.least) and math.isfinite(part.most):
        yield f"{number(part.least)} to {number(part.most)}"
    elif math.isfinite(part.least):
        yield f"at least {number(part.least)}"
    elif math.isfinite(part.most):
        yield f"at most {number(part.most)}"


# --- figures ------------------------------------------------------------------------------------


def claim_figures(claim: int, found: Mapping[str, Finding]) -> dict[str, Figure]:
    """Draw what was found on one claim, by scene: intervals, and what the findings show."""
    rows, drawn = asked(found), {}
    measured = _measured(rows.values())
    if measured:
        names = [name for name, finding in rows.items() if finding.parts]
        drawn[f"claim{claim}"] = viz.claim_intervals(measured, names)
    # What is about all scenes, or the only one, needs no title.
    titles = found if len(found) > 1 else [""] * len(found)
    shown = plot_findings(dict(zip(titles, found.values(), strict=True)))
    if shown is not None:
        drawn[f"exhibit{claim}"] = shown
    return drawn


def plot_findings(found: Mapping[str, Finding]) -> Figure | None:
    """Draw what findings show, each under its title; None where none has anything to show."""
    shown = [
        viz.Display(data.kind, data.series, data.x_label, data.y_label, title)
        for title, data in ((title, finding.plot_data) for title, finding in found.items())
        if any(np.isfinite(np.asarray(y)).any() for _, y in data.series.values())
    ]
    if len({(display.x_label, display.y_label) for display in shown}) > 1:
        # Each panel has labels of its own, in several lines.
        return viz.displays(shown, columns=3, height=1.6)
    return viz.displays(shown) if shown else None


def _measured(findings: Iterable[Finding]) -> list[viz.Measured]:
    """Return the parts of a claim with their values by scene."""
    known = [f for f in findings if f.parts]
    kinds: dict[tuple[str, float, float], ClaimTest] = {}
    for finding in known:
        for part in finding.parts:
            kinds.setdefault(_kind(part), part)
    return [_part(kind, part, known) for kind, part in kinds.items()]


def _kind(part: ClaimTest) -> tuple[str, float, float]:
    return part.statistic.name, part.least, part.most


def _part(
    kind: tuple[str, float, float], part: ClaimTest, findings: Sequence[Finding]
) -> viz.Measured:
    each = [next((p for p in f.parts if _kind(p) == kind), None) for f in findings]
    return viz.Measured(
        part.statistic.name,
        [np.nan if p is None else p.statistic.value for p in each],
        [np.nan if p is None else p.low for p in each],
        [np.nan if p is None else p.high for p in each],
        part.least,
        part.most,
        part.statistic.unit,
    )
