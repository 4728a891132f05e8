"""Patterns: which pixels are null-heavy, long-tailed, bimodal or constant, and how the rest looks.

`PATTERNS` is the table: what a pattern means, its statistic, and the rule that turns it into a flag
at a threshold. `classify` applies all rules to the luminance of each pixel. A pixel may have
several flags, except those that describe a plain body; `Label` says which one comes first. `atlas`
finds the shapes that an image has, without labels: pixels that differ only in brightness have the
same shape.

Known distributions show how well patterns are found: `CHD` makes them, and `simulate` draws an
image whose regions have given ones.
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
from chdstat.patterns.film_splits import FilmSplit, film_split
from chdstat.patterns.pixel import Pixel, Regions
from chdstat.patterns.simulation import CHD, CHDS, Component, simulate

__all__ = [
    "CHD",
    "CHDS",
    "PATTERNS",
    "Agreement",
    "Atlas",
    "Component",
    "FilmSplit",
    "Label",
    "Pattern",
    "Patterns",
    "Pixel",
    "Regions",
    "Thresholds",
    "agreement",
    "atlas",
    "attribute",
    "choose_regions",
    "classify",
    "film_split",
    "simulate",
]


def __dir__() -> list[str]:
    return sorted(__all__)
