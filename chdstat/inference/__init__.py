"""Inference: tests of normality, tests of modality, and the distance between two CHDs.

`gaussianity` tests the positive samples of a CHD, `gaussianity_of_means` averages of them.
`modality` looks at the positive samples in the log domain in two ways: Hartigan's dip test, which
assumes nothing but continuity and has calibrated p-values but little power; and mixtures of
log-normal or gamma components, which tell how many modes there are, where, and how far apart.
`difference` compares two CHDs.
"""

from __future__ import annotations

from chdstat.inference.differences import Difference, difference
from chdstat.inference.modes import (
    MODES,
    Modality,
    finish_modality,
    mixture_and_modes_of_part,
    modality,
    modality_of_part,
    modality_variables,
)
from chdstat.inference.normality import (
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
from chdstat.inference.normality_of_means import (
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

__all__ = [
    "MODES",
    "MORE_THAN_TESTED",
    "N_MEANS",
    "TESTS",
    "TRANSFORMS",
    "UNTESTED",
    "Difference",
    "Gaussianity",
    "GaussianityOfMeans",
    "Modality",
    "TestName",
    "Transform",
    "difference",
    "finish_gaussianity",
    "finish_means",
    "finish_modality",
    "gaussianity",
    "gaussianity_of_means",
    "gaussianity_of_part",
    "gaussianity_variables",
    "means_of_block",
    "means_variables",
    "mixture_and_modes_of_part",
    "modality",
    "modality_of_part",
    "modality_variables",
    "sizes_of_means",
]
