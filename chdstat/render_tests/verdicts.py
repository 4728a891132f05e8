"""Verdicts: what a render test checks, and what was found.

This module loads nothing heavy: every session of pytest imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

Outcome = Literal[
    "no difference found",
    "differ",
    "cannot tell",
    "bad pixels",
    "too weak",
    "written",
    "replaced",
    "kept",
    "refused",
]
"""``bad pixels``: no sample of a pixel is finite, which the reference has. ``too weak``: a loss as
small as the test asked for would not have been found. ``written``, ``replaced`` and ``kept`` are
outcomes of an update; ``refused`` is what cannot be compared at all."""

PASSED: Sequence[Outcome] = ("no difference found", "written", "replaced", "kept")


@dataclass(frozen=True)
class RenderCheck:
    """What a call of `same_light` compares, and how strictly.

    Attributes
    ----------
    name
        Name of the reference.
    reference
        Its file.
    page
        Name of the picture and page of the report, without suffix.
    test
        The test, as pytest calls it.
    alpha
        Largest chance of a false alarm of this call.
    spp
        Samples per pixel, for functions and scenes; None for a third of those of the reference.
    seed
        Another number chooses other random numbers.
    finds
        Relative loss in the whole image that the test must be able to find; None for any.
    update
        Whether to write the reference.
    report
        Folder for pictures and pages.
    always
        Whether to write them even if nothing differs.
    claim
        Says that the reference is written now; refuses that if another test has written it.
    """

    name: str
    reference: Path
    page: str
    test: str
    alpha: float
    spp: int | None = None
    seed: int = 0
    finds: float | None = None
    update: bool = False
    report: Path = Path("render-report")
    always: bool = False
    claim: Callable[[Path], None] = field(default=lambda _: None)


@dataclass(frozen=True)
class RenderVerdict:
    """What a call of `same_light` found, in plain values, which processes can send.

    Attributes
    ----------
    name, test, alpha
        As in the `RenderCheck`.
    outcome
        What was found.
    sentence
        The same in words.
    looks
        How often the render was drawn: 2 if what was found is confirmed by other samples.
    spp, reference_spp
        Samples per pixel of the last look, and of the reference; None if unknown.
    p_value
        P-value of equal means; None without a test.
    image, tenth
        Smallest relative loss in the image, and in a tenth of it, that would have been found with a
        probability of 90 %; None if unknown.
    numbers
        Rows of a table of numbers, in words.
    page, picture
        Files of the report, relative to its folder; "" if there are none.
    thumbnails
        Small PNG images by name, as text in base64.
    """

    name: str
    test: str
    alpha: float
    outcome: Outcome
    sentence: str
    looks: int = 0
    spp: int | None = None
    reference_spp: int | None = None
    p_value: float | None = None
    image: float | None = None
    tenth: float | None = None
    numbers: dict[str, str] = field(default_factory=dict)
    page: str = ""
    picture: str = ""
    thumbnails: dict[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether the test passes, as far as this call goes."""
        return self.outcome in PASSED

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)

    def properties(self) -> dict[str, Any]:
        """Return what JUnit XML says of it."""
        said = {
            "outcome": self.outcome,
            "p_value": self.p_value,
            "alpha": self.alpha,
            "spp": self.spp,
            "smallest_loss_image": self.image,
            "smallest_loss_tenth": self.tenth,
        }
        return {f"{self.name}.{key}": value for key, value in said.items() if value is not None}
