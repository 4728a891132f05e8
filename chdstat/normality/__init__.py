"""Normality: how far samples, their logarithms and their averages are from Gaussian.

Use `gaussianity` on the positive samples of a CHD, `gaussianity_of_means` on pixel estimates.
"""

from chdstat.normality.of_averages import (
    MORE_THAN_TESTED,
    N_MEANS,
    UNTESTED,
    GaussianityOfMeans,
    finish_means,
    gaussianity_of_means,
    means_of_block,
    means_variables,
    sizes_of_means,
)
from chdstat.normality.of_samples import (
    TESTS,
    TRANSFORMS,
    Gaussianity,
    TestName,
    Transform,
    finish_gaussianity,
    gaussianity,
    gaussianity_of_part,
    gaussianity_variables,
)

__all__ = [
    "MORE_THAN_TESTED",
    "N_MEANS",
    "TESTS",
    "TRANSFORMS",
    "UNTESTED",
    "Gaussianity",
    "GaussianityOfMeans",
    "TestName",
    "Transform",
    "finish_gaussianity",
    "finish_means",
    "gaussianity",
    "gaussianity_of_means",
    "gaussianity_of_part",
    "gaussianity_variables",
    "means_of_block",
    "means_variables",
    "sizes_of_means",
]
