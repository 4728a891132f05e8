"""Best peaks: the modes of the mixture that describes each row best, if a single family does not.

The mixtures are those of 2 and more log-normal or gamma components; the smallest BIC decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat._positive import Counts, Floats, Mask, PositivePart
from chdstat.fit._cells import Cells
from chdstat.fit._grounds import SampleRows, Solution
from chdstat.fit._peaks import peaks_of
from chdstat.fit._search import Found, search
from chdstat.fit._unimodal_bic import edge_scores, log_samples

__all__ = ["BestPeaks", "best_peaks"]

_FIELDS = ("place", "weight", "ashman_d", "ashman_d_se")


@dataclass(frozen=True)
class BestPeaks:
    """Modes of every row; NaN where there are none.

    Attributes
    ----------
    count
        Modes, shape (...); 0 where the row is not usable.
    place, weight, ashman_d, ashman_d_se
        As of `Peaks`, shape (..., mode); the last entry of the two separations is not used.
    delta_bic
        Twice what the score of the best mixture is above that of the rival, shape (...).
    """

    count: npt.NDArray[np.int8]
    place: Floats
    weight: Floats
    ashman_d: Floats
    ashman_d_se: Floats
    delta_bic: Floats


def best_peaks(
    part: PositivePart,
    usable: Mask,
    rival: Floats,
    max_k: int,
    *,
    doubtful: Mask,
    also: Callable[[Found], None] = lambda _: None,
) -> BestPeaks:
    """Find the peaks of the usable rows.

    `rival` is the best score of distributions of one mode, see `unimodal_scores`, shape (...).
    Where one mode is not out of the question, `doubtful`, a mixture of more has to beat those of
    `edge_scores`, too. `also` gets to see the log-normal mixtures as they are found.
    """
    shape = part.n.shape
    log_n = log_samples(part.n).reshape(-1)
    count = np.zeros(part.n.size, dtype=np.int8)
    table = np.full((len(_FIELDS), part.n.size, max_k), np.nan)
    delta = np.full(part.n.size, np.nan)
    for found in search(part, usable, "lognormal", max_k, effort="fast", rival=rival):
        rows = found.rows
        count[rows], table[:, rows], gain = _of_piece(
            found, rival.reshape(-1)[rows], log_n[rows], max_k, doubtful.reshape(-1)[rows]
        )
        delta[rows] = np.where(np.isfinite(gain), 2 * gain, np.nan)
        also(found)
    place, weight, ashman_d, error = table.reshape(len(_FIELDS), *shape, max_k)
    return BestPeaks(count.reshape(shape), place, weight, ashman_d, error, delta.reshape(shape))


def _of_piece(
    found: Found, rival: Floats, log_n: Floats, max_k: int, doubtful: Mask
) -> tuple[Counts, Floats, Floats]:
    """Return modes, the fields of their peaks (4, row, mode), and the gain over the rival.

    Log-normal components come first. Where they make more than one mode, gamma components get the
    chance to make fewer, and distributions of one mode with hard edges that to make one.
    """
    one = np.full((len(_FIELDS), len(rival), max_k), np.nan)
    one[0, :, 0] = found.solutions[0].state[1, 0] + found.cells.origin
    one[1, :, 0] = 1.0
    count, table = np.ones(len(rival), dtype=np.int64), one.copy()
    best = rival.copy()
    everyone = np.arange(len(rival))
    gain = _enter(found.solutions, found.cells, everyone, log_n, best, count, table) - rival
    several = np.flatnonzero(count > 1)
    of_gamma = found.also("gamma", several)
    also = _enter(of_gamma, found.cells, several, log_n, best, count, table) - rival[several]
    gain[several] = np.maximum(gain[several], also)
    several = several[doubtful[several] & (count[several] > 1)]
    assert isinstance(found.ground, SampleRows)
    edge = edge_scores(found.ground.log_sorted[several], found.ground.n[several], best[several])
    gain[several] -= np.maximum(edge - rival[several], 0)
    beaten = several[edge >= best[several]]
    count[beaten], table[:, beaten] = 1, one[:, beaten]
    return count, table, gain


def _enter(
    solutions: list[Solution],
    cells: Cells,
    rows: Counts,
    log_n: Floats,
    best: Floats,
    count: Counts,
    table: Floats,
) -> Floats:
    """Enter the peaks of those of the rows whose best mixture raises `best`; return its score."""
    mixed = solutions[1:]
    scores = np.stack([_score(solution, log_n[rows]) for solution in mixed])
    which, highest = scores.argmax(axis=0), scores.max(axis=0)
    for i, solution in enumerate(mixed):
        at = np.flatnonzero((which == i) & (highest > best[rows]))
        peaks = peaks_of(solution.take(at), cells.take(rows[at]))
        count[rows[at]] = peaks.count
        table[:, rows[at]] = np.nan
        for name, target in zip(_FIELDS, table, strict=True):
            values = getattr(peaks, name)
            target[rows[at], : values.shape[1]] = values
    best[rows] = np.maximum(best[rows], highest)
    return np.asarray(highest)


def _score(solution: Solution, log_n: Floats) -> Floats:
    return np.asarray(solution.log_likelihood - 1.5 * solution.state.shape[1] * log_n)
