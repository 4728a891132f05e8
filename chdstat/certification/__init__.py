"""Certification: pixels of real scenes with certified answers.

`certified` loads them: mean, variance, quantiles, coverage of error bars, tail index, modes and
more of 512 pixels, from a million samples each, with standard errors. `draw` draws any number of
samples of these pixels again; `hold` and `separation` score a method of your own on them, and
`bench` this library's own answers. `certify` certifies pixels of another scene, and `save` writes
them to a file.
"""

from __future__ import annotations

from chdstat.certification.certifying import certified, certify, draw, of_scenes, save
from chdstat.certification.scores import (
    COUNTS,
    CertifiedBench,
    Score,
    bench,
    hold,
    separation,
)

__all__ = [
    "COUNTS",
    "CertifiedBench",
    "Score",
    "bench",
    "certified",
    "certify",
    "draw",
    "hold",
    "of_scenes",
    "save",
    "separation",
]


def __dir__() -> list[str]:
    return sorted(__all__)
