"""Truth: which patterns a known CHD has, and where there is no telling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat.patterns import Label
from chdstat.simulation._chd import CHD
from chdstat.simulation._component import Kind

__all__ = ["ALIKE", "FIREFLY_ZONE", "NULL_ZONE", "SEPARATION_ZONE", "TAIL_ZONE", "Truth", "truth"]

NULL_ZONE = (0.45, 0.55)
"""Shares of nulls that are neither heavy nor light."""
TAIL_ZONE = (0.1, 0.3)
"""Tail indices that are neither long nor short."""
SEPARATION_ZONE = (1.5, 2.5)
"""Ashman's D at which two components are neither two modes nor one."""
ALIKE = 0.365
"""Standard deviation of log x below which gamma and log-normal are alike."""
FIREFLY_ZONE = (0.0, 0.2)
"""Planted shares of the sum that neither dominate a pixel nor leave it alone."""


@dataclass(frozen=True)
class Truth:
    """What is true of a CHD.

    Attributes
    ----------
    flags
        By the name of each flag of `chdstat.patterns`: whether it holds, None where the CHD lies in
        the indifference zone of the flag.
    label
        First `Label` that holds; UNDETERMINED where one that would come first is None.
    tail_index
        Of the excesses over the quantile 0.9 of what is not null; NaN for a constant.
    modes
        Components; 0 for a black pixel.
    separations
        Ashman's D of neighbouring components, shape (components - 1,).
    mean
        Expectation of radiance, a planted firefly left out, in W sr-1 m-2.
    """

    flags: Mapping[str, bool | None]
    label: Label
    tail_index: float
    modes: int
    separations: npt.NDArray[np.float64]
    mean: float


def truth(chd: CHD) -> Truth:
    """Say what is true of a CHD.

    A label is true or false only outside of an indifference zone around the threshold that decides
    it; inside, its flag is None:

    * null-heavy: a share of nulls within 0.05 of 1/2 (`NULL_ZONE`: 512 samples cannot tell).
    * long tail: a tail index in (0.1, 0.3), `TAIL_ZONE`. That of a body without a grafted tail is
      the penultimate one at its quantile 0.9, so that a log-normal body of sigma 1 or more is
      long-tailed, one of sigma 0.65 or less is not, and what lies between is left out. A gamma
      body is not, whatever its shape.
    * modes: neighbouring components with Ashman's D below 2.5, the end of `SEPARATION_ZONE`, or
      components that do not show as many maxima of the density of log x.
    * gamma-like and log-normal-like: bodies whose logarithm has a standard deviation below 0.365
      (`ALIKE`), that of a gamma distribution of shape 8, are described by both; with a light
      grafted tail, a body is neither.
    * firefly-dominated: a planted share of the sum below 0.2, `FIREFLY_ZONE`. A heavy tail may grow
      a firefly by chance: the label is one of the samples, and those that are drawn decide.

    References
    ----------
    Smith, "Estimating tails of probability distributions", 1987, doi:10.1214/aos/1176350499.
    Ashman, Bird and Zepf, "Detecting bimodality in astronomical datasets", 1994,
    doi:10.1086/117248.

    Examples
    --------
    >>> from chdstat.simulation import Component
    >>> found = truth(CHD((Component("gamma", 2.0),), tail_index=0.5, null_share=0.7))
    >>> found.label.name, found.flags["null_heavy"], found.flags["bimodal"]
    ('LONG_TAIL', True, False)
    """
    black = chd.null_share == 1
    tail_index = np.nan if black else chd.penultimate_index()
    flags = _flags(chd, tail_index)
    return Truth(
        flags=flags,
        label=Label.BLACK if black else _label(flags),
        tail_index=tail_index,
        modes=0 if black else len(chd.body),
        separations=chd.separations(),
        mean=chd.mean(),
    )


def _flags(chd: CHD, tail_index: float) -> dict[str, bool | None]:
    if chd.null_share == 1:
        absent = ("constant", "firefly_dominated", "long_tail", "bimodal", "multimodal")
        return {
            "null_heavy": True,
            **dict.fromkeys((*absent, "gamma_like", "lognormal_like"), False),
        }
    several = _has_modes(chd)
    exponential = chd.tail_index is None and all(c.family == "gamma" for c in chd.body)
    long_tail = False if chd.is_constant or exponential else _above(tail_index, TAIL_ZONE)
    return {
        "null_heavy": _above(chd.null_share, NULL_ZONE),
        "constant": chd.is_constant and not chd.firefly_share,
        "firefly_dominated": chd.firefly_share > 0 and _above(chd.firefly_share, FIREFLY_ZONE),
        "long_tail": long_tail,
        "bimodal": several and len(chd.body) == 2,
        "multimodal": several and len(chd.body) > 2,
        "gamma_like": _is_like(chd, "gamma", long_tail),
        "lognormal_like": _is_like(chd, "lognormal", long_tail),
    }


def _above(value: float, zone: tuple[float, float]) -> bool | None:
    """Say whether a value is above a zone; None inside."""
    return None if zone[0] < value < zone[1] else value >= zone[1]


def _has_modes(chd: CHD) -> bool | None:
    """Say whether every component shows as a mode; None where it is hard to tell."""
    if len(chd.body) == 1:
        return False
    apart = chd.separations().min() >= SEPARATION_ZONE[1]
    return True if apart and chd.maxima() == len(chd.body) else None


def _is_like(chd: CHD, family: Kind, long_tail: bool | None) -> bool | None:
    if len(chd.body) > 1 or chd.is_constant or long_tail:
        return False
    alike = chd.body[0].log_deviation < ALIKE
    if long_tail is None or chd.tail_index is not None or alike:
        return None
    return chd.body[0].family == family


def _label(flags: Mapping[str, bool | None]) -> Label:
    for label in Label:
        holds = flags.get(label.name.lower(), False)
        if holds is None:
            return Label.UNDETERMINED
        if holds:
            return label
    return Label.UNDETERMINED
