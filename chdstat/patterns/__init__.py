"""Patterns: which pixels are null-heavy, long-tailed, bimodal, constant, and what the rest is.

`PATTERNS` is the table: what a pattern means, its statistic, and the rule that turns it into a flag
at a threshold. `classify` applies them all to the luminance of each pixel. Flags do not exclude
each other, but for those that describe a plain body; `Label` says which comes first. `atlas` finds
the shapes that an image has, without labels: pixels that differ only in brightness have the same.

CHDs with known labels measure how well patterns are found: use `CHD` for one of your own,
`simulate` for an image whose regions have given CHDs, `truth_of` for what is true of that image,
and `random_chds` for a population. A label is true or false only outside of an indifference zone
around the threshold that decides it: `truth` lists the zones and gives None inside, and
`random_chds` draws nothing there.
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
