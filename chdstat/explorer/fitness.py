"""Fitness: whether each family describes a place, by bootstrap, a piece at a time.

It takes seconds, not the time of a click: whoever asks is told how far it is, and may end it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator, spans
from chdstat._positive import PositivePart
from chdstat.explorer.measured import Measured
from chdstat.fit.families import FAMILIES
from chdstat.fit.goodness_of_fit import FitTest, goodness_of_part
from chdstat.fit.mle import fit_part
from chdstat.fit.selection import SELECTED

__all__ = ["RESAMPLES", "Fitness", "fitness"]

RESAMPLES = 199
_PIECE = 20
_MOST = 4096
"""Samples that are tested: replicates of a region's would take minutes."""
_TESTS: tuple[FitTest, ...] = ("anderson-darling", "kolmogorov-smirnov")

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Fitness:
    """How well each family describes the rows of a place.

    Attributes
    ----------
    families
        Names.
    p_value
        Bootstrap p-values by Anderson and Darling's A², shape (family, row); NaN where a family
        could not be fitted.
    distance
        Kolmogorov's D, the largest gap of the distribution functions, shape (family, row).
    resamples
        Replicates B asked for.
    n
        Samples that were tested, nulls among them.
    """

    families: tuple[str, ...]
    p_value: Floats
    distance: Floats
    resamples: int
    n: int


def fitness(
    place: Measured,
    step: Callable[[float], None],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Fitness:
    """Test every family by the parametric bootstrap, see `chdstat.fit.goodness`.

    Parameters
    ----------
    place
        What is tested; of more than 4096 samples, the first.
    step
        Told the share that is done before each piece; whatever it raises ends the test.
    resamples, seed
        Replicates B, and their seed.
    """
    n = min(place.spp, _MOST)
    part = PositivePart.of_pixels(place.rows[: len(place.channels), :n], rows="both")
    # One generator for all pieces: their replicates are as independent as those of one call.
    rng = generator(seed)
    pieces = list(spans(resamples, _PIECE))
    p_values, distances = [], []
    for i, name in enumerate(SELECTED):
        farther = np.zeros(part.n.shape)
        drawn = np.zeros(part.n.shape)
        fit = fit_part(part, FAMILIES[name])
        for j, piece in enumerate(pieces):
            step((i + j / len(pieces)) / len(SELECTED))
            count = piece.stop - piece.start
            found = goodness_of_part(part, fit, tests=_TESTS, resamples=count, seed=rng)
            # p = (b + 1) / (B + 1) of the piece gives its b back.
            replicates = found.resamples[:, 0]
            farther += np.nan_to_num(found.p_value[:, 0] * (replicates + 1) - 1)
            drawn += replicates
        p_values.append(np.where(drawn > 0, (farther + 1) / (drawn + 1), np.nan))
        distances.append(found.effect[:, 1])
    return Fitness(tuple(SELECTED), np.stack(p_values), np.stack(distances), resamples, n)
