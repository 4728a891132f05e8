"""Inference: tests of normality, tests of modality, and comparisons of CHDs and of renders.

- `gaussianity` tests the positive samples of a CHD, `gaussianity_of_means` averages of all samples.
- `modality` looks at the positive samples in the log domain in two ways. Hartigan's dip test
  assumes nothing but continuity and has calibrated p-values, but little power. Mixtures of
  log-normal or gamma components give the number of modes, their places and their separation.
- `difference` compares two CHDs, `contrast` two renders of a view, or a render and a `Reference`;
  it ranks several renders by their noise, a `NoiseRanking`.
"""

from __future__ import annotations

from chdstat.inference.averages import (
    MORE_THAN_TESTED,
    N_MEANS,
    UNTESTED,
    GaussianityOfMeans,
    gaussianity_of_means,
    sizes_of_means,
)
from chdstat.inference.contrasts import Contrast, Contrasts, contrast
from chdstat.inference.differences import Difference, difference
from chdstat.inference.modes import MODES, Modality, modality
from chdstat.inference.noise_rankings import NoiseRanking
from chdstat.inference.normality import TESTS, TRANSFORMS, Gaussianity, gaussianity
from chdstat.inference.references import Reference

__all__ = [
    "MODES",
    "MORE_THAN_TESTED",
    "N_MEANS",
    "TESTS",
    "TRANSFORMS",
    "UNTESTED",
    "Contrast",
    "Contrasts",
    "Difference",
    "Gaussianity",
    "GaussianityOfMeans",
    "Modality",
    "NoiseRanking",
    "Reference",
    "contrast",
    "difference",
    "gaussianity",
    "gaussianity_of_means",
    "modality",
    "sizes_of_means",
]


def __dir__() -> list[str]:
    return sorted(__all__)
