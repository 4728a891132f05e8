"""Combination: the mean, an outlier-free mean and denoised images of both, weighted per pixel."""

from chdstat.estimators.combining.weighting import (
    LEAST,
    Combination,
    CombinationStream,
    combination,
    combine,
)

__all__ = ["LEAST", "Combination", "CombinationStream", "combination", "combine"]
