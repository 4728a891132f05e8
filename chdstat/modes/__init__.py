"""Modes: whether the samples of a pixel come from one kind of light path, or from several.

`modality` looks at the positive samples in the log domain, in three ways: Hartigan's dip test,
which assumes nothing but continuity and has calibrated p-values but little power; mixtures of
log-normal or gamma components, which say how many modes there are, where, and how far apart; and
Silverman's critical bandwidths, which say how much smoothing leaves one mode, or two.
"""

from chdstat.modes.of_samples import (
    MODES,
    Modality,
    bandwidths_of_part,
    finish_modality,
    mixture_and_modes_of_part,
    modality,
    modality_of_part,
    modality_variables,
)

__all__ = [
    "MODES",
    "Modality",
    "bandwidths_of_part",
    "finish_modality",
    "mixture_and_modes_of_part",
    "modality",
    "modality_of_part",
    "modality_variables",
]
