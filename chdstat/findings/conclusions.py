"""Conclusions: how parts with intervals become the verdict of a claim, with its reason.

A claim needs all of its parts: it is supported where all of them are, not supported where any is
not, and else there is no telling.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from chdstat.findings.resampling import LEVEL
from chdstat.findings.results import Exhibit, Finding, Part, Statistic, Verdict

__all__ = ["Conclusion", "conclude", "level_of"]

_MOST_SPP = 2**20
"""More samples than these are no advice."""


@dataclass(frozen=True)
class Conclusion:
    """What a claim's own module returns; the registry adds number, name and claim.

    Attributes
    ----------
    parts, missing
        What was measured, and what could not be, each as a sentence.
    p_value, details, exhibit
        As for `Finding`.
    subject
        What was measured, where it could be one thing or another: the reason names it.
    beside
        The same of others, by name; the verdict does not rest on it.
    few
        What there are too few of where an interval is wide, if it is not samples.
    """

    parts: tuple[Part, ...] = ()
    missing: tuple[str, ...] = ()
    p_value: float | None = None
    details: Mapping[str, Any] = field(default_factory=dict)
    exhibit: Exhibit = field(default_factory=lambda: Exhibit("curves"))
    subject: str = ""
    beside: Mapping[str, Conclusion] = field(default_factory=dict)
    few: str = ""

    @property
    def verdict(self) -> Verdict:
        """The verdict of the weakest part; nothing is supported while something is missing."""
        verdicts = {part.verdict for part in self.parts}
        if "not supported" in verdicts:
            return "not supported"
        if self.missing or not self.parts or "cannot tell" in verdicts:
            return "cannot tell"
        return "supported"

    @property
    def deciding(self) -> Part | None:
        """The part that the verdict rests on: the first of the weakest."""
        for verdict in ("not supported", "cannot tell", "supported"):
            for part in self.parts:
                if part.verdict == verdict:
                    return part
        return None


def conclude(
    found: Conclusion,
    *,
    number: int,
    name: str,
    claim: str,
    scene: str,
    spp: int,
    about: str = "",
) -> Finding:
    """Make a finding of what was measured."""
    part = found.deciding
    asked: Any = {"number": number, "name": name, "claim": claim, "scene": scene, "about": about}
    return Finding(
        **asked,
        statistic=part.statistic if part else Statistic(name, math.nan),
        interval=(part.low, part.high, part.level) if part else (math.nan, math.nan, LEVEL),
        p_value=found.p_value,
        verdict=found.verdict,
        reason=_reason(found, spp),
        parts=found.parts,
        details=found.details,
        exhibit=found.exhibit,
        beside={other: conclude(c, spp=spp, **asked) for other, c in found.beside.items()},
    )


def level_of(parts: int, level: float = LEVEL) -> float:
    """Return the level of each of several intervals that hold together (Bonferroni).

    A claim is supported only if all of its parts are, which alone would need no correction (Berger
    1982, "Multiparameter hypothesis testing and acceptance sampling", doi:10.2307/1267823); it is
    not supported if any part is not, which does.

    Examples
    --------
    >>> level_of(5)
    0.99
    """
    return 1 - (1 - level) / parts


def _reason(found: Conclusion, spp: int) -> str:
    part, verdict = found.deciding, found.verdict
    if verdict == "cannot tell" and found.missing:
        return _sentence("; ".join(found.missing))
    if part is None:
        return "Nothing was measured."
    said = {
        "supported": "; ".join(str(part) for part in found.parts),
        "not supported": str(part),
        "cannot tell": f"{part}; {_needed(part, spp, found.few)}",
    }[verdict]
    return _sentence(f"{found.subject}: {said}" if found.subject else said)


def _needed(part: Part, spp: int, few: str) -> str:
    """Say how many samples would decide, if the interval shrinks with their square root."""
    if few:
        return f"more {few} would decide"
    if not math.isfinite(part.low):
        return "there are too few pixels or samples for an interval"
    margin = part.margin
    if math.isinf(part.high) and part.statistic.value < part.least:
        return f"{spp} spp do not show how far its tail reaches, many more would decide"
    needed = spp * (1.2 / margin) ** 2 if margin > 0 else math.inf
    if not needed < _MOST_SPP:
        return "the value is too near the border for any number of samples, or needs more pixels"
    rounded = 2 ** math.ceil(math.log2(needed))
    return f"about {rounded} spp would decide if noise makes it wide, more pixels if these differ"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
