"""Trainings: how much the measures of what learns depend on the random numbers it is trained with.

Pixels stay the same, those that train and those that judge: what varies is the first weights and
the minibatches, as when somebody else trains the same network on the same picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison._contestants import Contestants
from chdstat.comparison._sums import MEASURES
from chdstat.comparison._tally import Tally, Units, judge
from chdstat.estimators.heldout import Totals
from chdstat.samples import Samples

__all__ = ["spread_over_trainings"]

Array = npt.NDArray[np.float64]


def spread_over_trainings(
    contestants: Contestants,
    tally: Tally,
    samples: Samples,
    totals: Totals,
    units: Units,
    *,
    n: int,
    seeds: Sequence[int],
    limit: int | None,
    progress: bool | None,
) -> dict[str, Array]:
    """Return the standard deviation of every measure over trainings.

    Parameters
    ----------
    contestants, tally
        The first training, and what it came to.
    samples, totals, units, n, limit, progress
        As `judge` takes them.
    seeds
        Of the further trainings, one after the other; of each only its measures are kept.

    Returns
    -------
    dict of ndarray
        By the names of `MEASURES`, shape (estimator, channel + 1); NaN where nothing is learned.
        Empty without seeds.
    """
    if not seeds:
        return {}
    values = [_values(tally)]
    for seed in seeds:
        again = contestants.trained_anew(samples, sizes=[n], seed=seed, progress=progress)
        if not again.entries:
            break
        judged = judge(
            again.taking(n),
            samples,
            totals,
            units,
            n=n,
            limit=limit,
            pictures=False,
            progress=progress,
        )
        row = np.full_like(values[0], np.nan)
        row[:, [contestants.names.index(name) for name in again.names]] = _values(judged)
        values.append(row)
    if len(values) == 1:
        return dict.fromkeys(MEASURES, np.full_like(values[0][0], np.nan))
    return dict(zip(MEASURES, np.std(values, axis=0, ddof=1), strict=True))


def _values(tally: Tally) -> npt.NDArray[Any]:
    """Return all measures, shape (measure, estimator, channel + 1).

    Batches and pixels add up to the same; there are fewer batches.
    """
    found = tally.by_batch.measures(seed=0)
    return np.stack([found[name].value for name in MEASURES])
