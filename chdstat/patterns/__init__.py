"""Patterns: which pixels are null-heavy, long-tailed, bimodal or constant, and how the rest looks.

`PATTERNS` is the table: what a pattern means, its statistic, and the rule that turns it into a flag
at a threshold. `classify` applies all rules to the luminance of each pixel. A pixel may have
several flags, except those that describe a plain body; `Label` says which one comes first. `atlas`
finds the shapes that an image has, without labels: pixels that differ only in brightness have the
same shape.

CHDs with known labels measure how well patterns are found. Use `CHD` for your own, `simulate` for
an image whose regions have given CHDs, `truth_of` for the truth of that image, and `random_chds`
for a population. Around the threshold of a label lies an indifference zone, where the label is
neither true nor false. `truth` lists the zones and gives None inside; `random_chds` draws nothing
there.
"""

from __future__ import annotations

from chdstat.patterns.atlases import Atlas, atlas
from chdstat.patterns.attribution import attribute
from chdstat.patterns.classification import (
    Agreement,
    Label,
    Patterns,
    agreement,
    choose_regions,
    classify,
)
from chdstat.patterns.definitions import PATTERNS, Pattern, Thresholds
from chdstat.patterns.pixel import Pixel, Regions
from chdstat.patterns.simulation import (
    BODY_ZONE,
    CHD,
    CHDS,
    FIREFLY_ZONE,
    INDISTINCT_SPREAD,
    NULL_ZONE,
    SEPARATION_ZONE,
    TAIL_ZONE,
    Component,
    FlagScore,
    Truth,
    flag_scores,
    random_chds,
    simulate,
    truth,
    truth_of,
)

__all__ = [
    "BODY_ZONE",
    "CHD",
    "CHDS",
    "FIREFLY_ZONE",
    "INDISTINCT_SPREAD",
    "NULL_ZONE",
    "PATTERNS",
    "SEPARATION_ZONE",
    "TAIL_ZONE",
    "Agreement",
    "Atlas",
    "Component",
    "FlagScore",
    "Label",
    "Pattern",
    "Patterns",
    "Pixel",
    "Regions",
    "Thresholds",
    "Truth",
    "agreement",
    "atlas",
    "attribute",
    "choose_regions",
    "classify",
    "flag_scores",
    "random_chds",
    "simulate",
    "truth",
    "truth_of",
]


def __dir__() -> list[str]:
    return sorted(__all__)
