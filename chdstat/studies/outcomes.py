"""Outcomes: how tests of a claim, each with an interval, become its verdict and the reason.

A claim consists of one part or several; a `ClaimTest` compares the interval of a statistic with the
range that the claim states. A part is supported where the whole interval lies in that range, not
supported where all of it lies outside, and otherwise undecided. A claim is supported where all of
its parts are, not supported where any is not, and otherwise undecided ("cannot tell").

What measures a claim returns an `Outcome`; `conclude` makes it a `Finding`, the public result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import LEVEL, Interval

__all__ = [
    "ClaimTest",
    "Finding",
    "Outcome",
    "PlotData",
    "Statistic",
    "Verdict",
    "conclude",
    "level_of",
    "number",
    "plain",
]

_MOST_SPP = 2**20
"""More samples than these are no advice."""


@dataclass(frozen=True)
class Outcome:
    """What was measured of a claim; the registry adds number, name and claim.

    Attributes
    ----------
    parts, missing
        What was measured, and what could not be, each as a sentence.
    p_value, details, plot_data
        As for `Finding`.
    subject
        What was measured, where it could be one thing or another: the reason names it.
    beside
        The same of others, by name; the verdict does not rest on it.
    few
        What there are too few of where an interval is wide, if it is not samples.
    """

    parts: tuple[ClaimTest, ...] = ()
    missing: tuple[str, ...] = ()
    p_value: float | None = None
    details: Mapping[str, Any] = field(default_factory=dict)
    plot_data: PlotData = field(default_factory=lambda: PlotData("curves"))
    subject: str = ""
    beside: Mapping[str, Outcome] = field(default_factory=dict)
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
    def deciding(self) -> ClaimTest | None:
        """The part that the verdict rests on: the first of the weakest."""
        for verdict in ("not supported", "cannot tell", "supported"):
            for part in self.parts:
                if part.verdict == verdict:
                    return part
        return None


def conclude(
    found: Outcome,
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
        plot_data=found.plot_data,
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


def _reason(found: Outcome, spp: int) -> str:
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


def _needed(part: ClaimTest, spp: int, few: str) -> str:
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


Verdict = Literal["supported", "not supported", "cannot tell"]


@dataclass(frozen=True)
class Statistic:
    """A number with its name and unit.

    Attributes
    ----------
    name
        What it is, in words.
    value
        NaN where it could not be computed.
    unit
        "1" for pure numbers.
    """

    name: str
    value: float
    unit: str = "1"


@dataclass(frozen=True)
class ClaimTest:
    """One statistic of a claim and the range in which the claim has it.

    Attributes
    ----------
    statistic
        The number.
    low, high
        Its interval, in the same unit; NaN where there is none, infinite where it is open.
    level
        Coverage of the interval.
    least, most
        Range of the claim; infinite where it is open.
    """

    statistic: Statistic
    low: float
    high: float
    level: float
    least: float = -math.inf
    most: float = math.inf

    @classmethod
    def of(
        cls,
        name: str,
        found: Interval[float],
        *,
        least: float = -math.inf,
        most: float = math.inf,
        unit: str = "1",
    ) -> ClaimTest:
        """Make a part of a number with its interval."""
        return cls(
            Statistic(name, found.value, unit), found.low, found.high, found.level, least, most
        )

    @property
    def verdict(self) -> Verdict:
        """Whether the interval lies inside the range, outside, or neither."""
        if self.low >= self.least and self.high <= self.most:
            return "supported"
        if self.high < self.least or self.low > self.most:
            return "not supported"
        return "cannot tell"

    @property
    def margin(self) -> float:
        """Distance of the value to an end of the range over that to the interval's end beyond it.

        Of the end that is less sure; above 1, the interval does not reach it. 0 where the interval
        is open to that side, NaN without an interval.
        """
        value = self.statistic.value
        ends = [end for end in (self.least, self.most) if math.isfinite(end)]
        arms = [value - self.low if end < value else self.high - value for end in ends]
        if not ends or not min(arms) > 0:
            return math.nan
        return min(abs(value - end) / arm for end, arm in zip(ends, arms, strict=True))

    def between(self, write: Callable[[float], str]) -> str:
        """Return the interval in words, each of its ends as `write` has it; "" without one."""
        if math.isnan(self.low) or math.isnan(self.high):
            return ""
        rest = "or more" if math.isinf(self.high) else f"to {write(self.high)}"
        return f"{write(self.low)} {rest}"

    def __str__(self) -> str:
        value = f"{self.statistic.name} is {number(self.statistic.value)}"
        return f"{value} ({self.between(number) or 'no interval'}), claimed {self._range()}"

    def _range(self) -> str:
        if math.isinf(self.least):
            return f"at most {number(self.most)}"
        if math.isinf(self.most):
            return f"at least {number(self.least)}"
        return f"{number(self.least)} to {number(self.most)}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {
            "name": self.statistic.name,
            "value": plain(self.statistic.value),
            "unit": self.statistic.unit,
            "low": plain(self.low),
            "high": plain(self.high),
            "level": self.level,
            "least": plain(self.least),
            "most": plain(self.most),
            "verdict": self.verdict,
        }


@dataclass(frozen=True)
class PlotData:
    """What the figure of a finding draws.

    Attributes
    ----------
    kind
        "curves": a line for each series; "points": a mark for each place; "bars": one value each,
        named by the series; "map": one image (y, x), named by the series.
    series
        By name: x and y, each of shape (point,); for a map, (an empty array, the image).
    x_label, y_label
        What the axes show, with the unit.
    """

    kind: Literal["curves", "points", "bars", "map"]
    series: Mapping[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]] = field(default_factory=dict)
    x_label: str = ""
    y_label: str = ""


@dataclass(frozen=True)
class Finding:
    """What the samples say of one claim.

    Attributes
    ----------
    number, name
        Which claim, 1 to 16.
    scene
        Of which scene, or which scenes.
    claim
        One sentence.
    statistic
        Of the part that decides.
    interval
        Low end, high end and level, in the unit of the statistic; NaN where there is none.
    p_value
        Of a null hypothesis that the details name; None where it would mean nothing.
    verdict
        "supported", "not supported" or "cannot tell".
    reason
        One sentence; for "cannot tell" with what would be needed.
    parts
        All that the claim says, each with its own verdict; their intervals hold together.
    details
        Further numbers by region or channel, ready for JSON.
    plot_data
        What its figure draws.
    beside
        The same asked of what the claim is not about, by name, such as of another estimator; the
        verdict does not rest on it.
    about
        What the verdict is about, in sentences: this image or this model, and not the scene; and
        which scenes are remakes of the paper's.
    """

    number: int
    name: str
    scene: str
    claim: str
    statistic: Statistic
    interval: tuple[float, float, float]
    p_value: float | None
    verdict: Verdict
    reason: str
    parts: tuple[ClaimTest, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    plot_data: PlotData = field(default_factory=lambda: PlotData("curves"))
    beside: Mapping[str, Finding] = field(default_factory=dict)
    about: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the plot data, ready for JSON; what is not finite is None."""
        low, high, level = self.interval
        return {
            "number": self.number,
            "name": self.name,
            "scene": self.scene,
            "claim": self.claim,
            "about": self.about,
            "statistic": plain(vars(self.statistic)),
            "interval": {"low": plain(low), "high": plain(high), "level": plain(level)},
            "p_value": plain(self.p_value),
            "verdict": self.verdict,
            "reason": self.reason,
            "parts": [part.to_dict() for part in self.parts],
            "details": plain(self.details),
            "beside": {name: found.to_dict() for name, found in self.beside.items()},
        }


def plain(value: Any) -> Any:
    """Return a value ready for JSON: arrays as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (str, bool, np.bool_)):
        return bool(value) if isinstance(value, np.bool_) else value
    if isinstance(value, (int, np.integer)):
        return int(value)
    return float(value) if math.isfinite(value) else None


def number(value: float) -> str:
    """Return a number in three digits."""
    return "unknown" if math.isnan(value) else f"{value:.3g}"
