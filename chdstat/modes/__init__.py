"""Modes: whether the samples of a pixel come from one kind of light path, or from several.

`modality` looks at the positive samples in the log domain, in two ways: Hartigan's dip test,
which assumes nothing but continuity and has calibrated p-values but little power; and mixtures of
log-normal or gamma components, which say how many modes there are, where, and how far apart.
"""

from chdstat.modes.of_samples import (
    MODES,
    Modality,
    finish_modality,
    mixture_and_modes_of_part,
    modality,
    modality_of_part,
    modality_variables,
)

__all__ = [
    "MODES",
    "Modality",
    "finish_modality",
    "mixture_and_modes_of_part",
    "modality",
    "modality_of_part",
    "modality_variables",
]
