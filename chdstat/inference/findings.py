"""Findings: tests of a claim with intervals, and the verdict and reason that follow from them.

A claim has one or more tests. A `ClaimTest` compares the interval of a statistic with the range
that the claim states. A test is supported if the whole interval lies in the range, not supported if
all of it lies outside, and otherwise undecided. A claim is supported if all of its tests are, not
supported if any test is not, and otherwise undecided ("cannot tell").

The function that measures a claim returns a `Finding`, or raises `MissingDataError`. The claim adds
its own name and the scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np

from chdstat._core.arrays import Array, plain
from chdstat._core.display import Card, Shown, capital, number
from chdstat._core.resampling import LEVEL, Interval

T = TypeVar("T")
Verdict = Literal["supported", "not supported", "cannot tell"]

_MOST_SPP = 2**20
"""More samples than this are not recommended."""


class MissingDataError(Exception):
    """A claim cannot be tested: the message says what it needs."""


def require(enough: object, needed: str) -> None:
    """Raise `MissingDataError` if there is not enough data to test a claim."""
    if not enough:
        message = f"needs {needed}"
        raise MissingDataError(message)


def required(value: T | None, needed: str) -> T:
    """Return a value, or raise `MissingDataError` if it is None."""
    if value is None:
        message = f"needs {needed}"
        raise MissingDataError(message)
    return value


def level_of(tests: int) -> float:
    """Return the level of each of several simultaneous intervals (Bonferroni).

    A claim is supported only if all of its tests are, which needs no correction (Berger 1982,
    "Multiparameter hypothesis testing and acceptance sampling", doi:10.2307/1267823). But it is not
    supported if any test is not, which needs one.

    Examples
    --------
    >>> level_of(5)
    0.99
    """
    return 1 - (1 - LEVEL) / tests


@dataclass(frozen=True)
class ClaimTest:
    """One statistic of a claim, and the range that the claim states for it.

    Attributes
    ----------
    name
        The statistic in words.
    interval
        Its value with an interval; NaN without an interval, infinite at an open end.
    least, most
        Range of the claim; infinite at an open end.
    unit
        "1" for pure numbers.
    """

    name: str
    interval: Interval[float]
    least: float = -math.inf
    most: float = math.inf
    unit: str = "1"

    @property
    def verdict(self) -> Verdict:
        """Whether the interval lies inside the range, outside of it, or neither."""
        low, high = self.interval.low, self.interval.high
        if low >= self.least and high <= self.most:
            return "supported"
        return "not supported" if high < self.least or low > self.most else "cannot tell"

    @property
    def margin(self) -> float:
        """Distance from the value to an end of the range, over the interval's length on that side.

        It is the smaller one for both ends. Above 1, the interval does not reach the end. It is 0
        if the interval is open on that side, NaN without an interval.
        """
        value, low, high = self.interval.value, self.interval.low, self.interval.high
        arms = [value - low if end < value else high - value for end in self.limits]
        if not arms or not min(arms) > 0:
            return math.nan
        return min(abs(value - end) / arm for end, arm in zip(self.limits, arms, strict=True))

    @property
    def limits(self) -> tuple[float, ...]:
        """The ends of the range of the claim that are numbers."""
        return tuple(end for end in (self.least, self.most) if math.isfinite(end))

    @property
    def claimed(self) -> str:
        """Range of the claim in words."""
        if math.isinf(self.least):
            return f"at most {_number(self.most)}"
        if math.isinf(self.most):
            return f"at least {_number(self.least)}"
        return f"{_number(self.least)} to {_number(self.most)}"

    def __str__(self) -> str:
        interval = self.interval.ends(number, beside=self.limits) or "no interval"
        return f"{self.name} is {_number(self.interval.value)} ({interval}), claimed {self.claimed}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        numbers = self.interval.to_dict() | {"level": self.interval.level}
        numbers |= {"least": self.least, "most": self.most}
        return {"name": self.name, "unit": self.unit, **plain(numbers), "verdict": self.verdict}


@dataclass(frozen=True)
class PlotData:
    """Data of a small figure.

    Attributes
    ----------
    kind
        "curves": a line for each series; "points": a mark for each place; "bars": one value each,
        named by the series; "map": one image (y, x), named by the series.
    series
        By name: x and y, each of shape (point,). A bar has its value in y, a map has an image (y,
        x).
    x_label, y_label
        Labels of the axes, with units.
    """

    kind: Literal["curves", "points", "bars", "map"] = "curves"
    series: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    x_label: str = ""
    y_label: str = ""

    @classmethod
    def bars(cls, values: Mapping[str, float], y_label: str) -> PlotData:
        """Return bars of values by name."""
        series = {name: (np.zeros(1), np.array([value])) for name, value in values.items()}
        return cls("bars", series, y_label=y_label)


@dataclass(frozen=True, repr=False)
class Finding(Shown):
    """The verdict on one claim, with its tests and the reason.

    Attributes
    ----------
    tests
        Tests of everything that the claim says, each with its verdict; their intervals are
        simultaneous.
    missing
        What could not be measured, as sentences.
    p_value
        p-value of the null hypothesis; None if there is none.
    null_hypothesis
        The null hypothesis of the p-value, in words.
    plot_data
        Data of its figure.
    model
        Name of the tested model if there are several; the reason names it.
    other_models
        Findings for other models, by name; the verdict does not depend on them.
    few
        What would narrow a wide interval, if not more samples.
    number, name
        Number and name of the claim in `chdstat.studies.claims.CLAIMS`.
    claim
        One sentence.
    scene
        Name of the scene, or of the scenes.
    about
        What the verdict is about, in sentences: this image or this model, not the scene in general;
        and which scenes are remakes of the paper's.
    spp
        Samples per pixel.
    disagree
        The verdicts of the seeds if they are opposite; then there is no verdict.
    """

    tests: tuple[ClaimTest, ...] = ()
    missing: tuple[str, ...] = ()
    p_value: float | None = None
    null_hypothesis: str = ""
    plot_data: PlotData = field(default_factory=PlotData)
    model: str = ""
    other_models: Mapping[str, Finding] = field(default_factory=dict)
    few: str = ""
    number: int = 0
    name: str = ""
    claim: str = ""
    scene: str = ""
    about: str = ""
    spp: int = 0
    disagree: str = ""

    def on(self, **about: Any) -> Finding:
        """Return the finding with other attributes, also in the findings for other models."""
        others = {name: other.on(**about) for name, other in self.other_models.items()}
        return replace(self, other_models=others, **about)

    @property
    def test(self) -> ClaimTest | None:
        """The deciding test: the first of those with the weakest verdict; None without tests."""
        order: tuple[Verdict, ...] = ("not supported", "cannot tell", "supported")
        return min(self.tests, key=lambda test: order.index(test.verdict), default=None)

    @property
    def verdict(self) -> Verdict:
        """The weakest verdict of the tests; a claim with missing parts is not supported."""
        test = self.test
        if test is None or self.disagree:
            return "cannot tell"
        if test.verdict == "not supported":
            return "not supported"
        return "cannot tell" if self.missing else test.verdict

    @property
    def reason(self) -> str:
        """Reason of the verdict, in one sentence; for "cannot tell" with what would be needed."""
        test, verdict = self.test, self.verdict
        if self.disagree:
            return self.disagree
        if verdict == "cannot tell" and self.missing:
            text = "; ".join(self.missing)
        elif test is None:
            text = "nothing was measured"
        else:
            text = {
                "supported": "; ".join(str(test) for test in self.tests),
                "not supported": str(test),
                "cannot tell": f"{test}; {self._advice(test)}",
            }[verdict]
            text = f"for {self.model}: {text}" if self.model else text
        return f"{capital(text)}."

    def _advice(self, test: ClaimTest) -> str:
        """Return how many samples would decide, if intervals shrink with their square root."""
        if self.few:
            return f"more {self.few} would decide"
        interval = test.interval
        if not math.isfinite(interval.low):
            return "there are too few pixels or samples for an interval"
        if math.isinf(interval.high) and interval.value < test.least:
            return f"{self.spp} spp do not show how far its tail reaches, many more would decide"
        needed = self.spp * (1.2 / test.margin) ** 2 if test.margin > 0 else math.inf
        if not needed < _MOST_SPP:
            return (
                "the value is too near the border for any number of samples, or needs more pixels"
            )
        rounded = 2 ** math.ceil(math.log2(needed))
        return (
            f"about {rounded} spp would decide if noise makes it wide, more pixels if these differ"
        )

    def confirmed(self, again: Finding | None) -> Finding:
        """Return the finding, without a verdict if another seed gives the opposite one."""
        if again is None or {self.verdict, again.verdict} != {"supported", "not supported"}:
            return self
        reason = f"Seeds disagree. The first: {self.reason} Another: {again.reason}"
        return replace(self, disagree=reason)

    def _card(self) -> Card:
        facts = {"claim": self.claim, "verdict": self.verdict, "reason": self.reason}
        facts |= {"about": self.about}
        rows = [
            {
                "statistic": t.name,
                "value": t.interval.shown(beside=t.limits),
                "claimed": t.claimed,
                "verdict": t.verdict,
            }
            for t in self.tests
        ]
        return Card(f"Finding on claim {self.number}, {self.name}, in {self.scene}", facts, rows)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the plot data, ready for JSON; NaN and infinity are None."""
        test = self.test or ClaimTest(self.name, Interval.unknown())
        interval = {n: getattr(test.interval, n) for n in ("low", "high", "level")}
        as_they_are = ("number", "name", "scene", "claim", "about", "verdict", "reason")
        found: dict[str, Any] = plain(
            {
                **{name: getattr(self, name) for name in as_they_are},
                "statistic": {"name": test.name, "value": test.interval.value, "unit": test.unit},
                "interval": interval,
                "p_value": self.p_value,
                "null_hypothesis": self.null_hypothesis,
                "parts": [test.to_dict() for test in self.tests],
                "beside": {name: other.to_dict() for name, other in self.other_models.items()},
            }
        )
        return found


def _number(value: float) -> str:
    """Return a number in three digits, with a real minus sign."""
    return "unknown" if math.isnan(value) else f"{value:.3g}".replace("-", "−")
