"""Comparison: estimators side by side, on the same samples and against a held-out reference.

`compare` measures estimators on batches of n samples; its `Comparison` holds every measure, the
`Breakdown` of them by pattern, and `PixelEstimates` to look at one by one. `error_curve` does the
same for many n, and returns an `ErrorCurve`. `DEFAULT_ESTIMATORS` is what they, `bench`,
`chdstat.study`, `chdstat.report` and the explorer compare by default. `denoised` puts a denoiser
after an estimator. `bench` compares on several scenes against converged references, and
returns a `Bench`. `MEASURES` says what is measured; each measure is an `Interval`.
"""

from __future__ import annotations

from chdstat._core.resampling import Interval
from chdstat.comparison.benchmark import Bench, Case, bench
from chdstat.comparison.comparisons import (
    Breakdown,
    Comparison,
    PixelEstimates,
    compare,
)
from chdstat.comparison.entries import DEFAULT_ESTIMATORS, Denoised, curve_sizes, denoised
from chdstat.comparison.error_curves import ErrorCurve, error_curve
from chdstat.comparison.metrics import MEASURES

__all__ = [
    "DEFAULT_ESTIMATORS",
    "MEASURES",
    "Bench",
    "Breakdown",
    "Case",
    "Comparison",
    "Denoised",
    "ErrorCurve",
    "Interval",
    "PixelEstimates",
    "bench",
    "compare",
    "curve_sizes",
    "denoised",
    "error_curve",
]


def __dir__() -> list[str]:
    return sorted(__all__)
