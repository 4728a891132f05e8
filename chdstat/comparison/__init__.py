"""Comparison: estimators side by side, on the same samples and against a held-out reference.

`compare` measures estimators on batches of n samples. Its `Comparison` holds all measures, their
`Breakdown` by pattern, and `PixelEstimates` of single pixels. `error_curve` does the same for many
n, and returns an `ErrorCurve`; `chdstat.bench` compares on several scenes. `denoised` puts a
denoiser after an estimator. `DEFAULT_ESTIMATORS` are compared by default, also by `chdstat.bench`,
`chdstat.study`, `chdstat.report` and the explorer. `MEASURES` describes the measures; each one is
an `Interval`. `image_errors` measures finished images against a reference. A `Judge` is what
samples tell of the true radiance.
"""

from __future__ import annotations

from chdstat._core.resampling import Interval
from chdstat.comparison.comparisons import (
    Breakdown,
    Comparison,
    ErrorCurve,
    PixelEstimates,
    compare,
    error_curve,
)
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATORS, Denoised, curve_sizes, denoised
from chdstat.comparison.finished_images import ImageErrors, image_errors
from chdstat.comparison.judges import Judge
from chdstat.comparison.metrics import MEASURES

__all__ = [
    "DEFAULT_ESTIMATORS",
    "MEASURES",
    "Breakdown",
    "Comparison",
    "Denoised",
    "ErrorCurve",
    "ImageErrors",
    "Interval",
    "Judge",
    "PixelEstimates",
    "compare",
    "curve_sizes",
    "denoised",
    "error_curve",
    "image_errors",
]


def __dir__() -> list[str]:
    return sorted(__all__)
