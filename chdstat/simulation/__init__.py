"""Simulation: CHDs with known labels, as single distributions, images and a whole population.

Use `CHD` for a distribution of your own, `simulate` for an image whose regions have given CHDs,
`truth_of` for what is true of that image, and `random_chds` to measure how well patterns are told.

A label is true or false only outside of an indifference zone around the threshold that decides it:
`truth` lists the zones and gives None inside, and `random_chds` draws nothing there.
"""

from chdstat.simulation.of_images import (
    ALIKE,
    CHD,
    CHDS,
    FIREFLY_ZONE,
    NULL_ZONE,
    SEPARATION_ZONE,
    TAIL_ZONE,
    Component,
    FlagScore,
    Truth,
    flag_scores,
    random_chds,
    simulate,
    truth,
    truth_of,
)

__all__ = [
    "ALIKE",
    "CHD",
    "CHDS",
    "FIREFLY_ZONE",
    "NULL_ZONE",
    "SEPARATION_ZONE",
    "TAIL_ZONE",
    "Component",
    "FlagScore",
    "Truth",
    "flag_scores",
    "random_chds",
    "simulate",
    "truth",
    "truth_of",
]
