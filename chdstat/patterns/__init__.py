"""Patterns: which pixels are null-heavy, long-tailed, bimodal, constant, and what the rest is.

`PATTERNS` is the table: what a pattern means, its statistic, and the rule that turns it into a flag
at a threshold. `classify` applies them all to the luminance of each pixel. Flags do not exclude
each other, but for those that describe a plain body; `Label` says which comes first.
"""

from chdstat.patterns.of_pixels import (
    PATTERNS,
    Agreement,
    Label,
    Pattern,
    Patterns,
    Thresholds,
    agreement,
    classify,
    finish_patterns,
    luminance_part,
    patterns_of_part,
    patterns_variables,
)

__all__ = [
    "PATTERNS",
    "Agreement",
    "Label",
    "Pattern",
    "Patterns",
    "Thresholds",
    "agreement",
    "classify",
    "finish_patterns",
    "luminance_part",
    "patterns_of_part",
    "patterns_variables",
]
