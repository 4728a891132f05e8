"""Groups: points that are near to each other, and how many groups the noise lets one distinguish.

`find_groups` is given every point three times: measured with all samples, and with two halves of
them. What one half predicts of the other is what repeats; the rest is noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from chdstat._core.arrays import Counts, Floats
from chdstat.errors import InputError

__all__ = ["Groups", "find_groups", "ratio"]

_LEARNT = 4096
"""Points that k-means learns from: the error of a mean of so many is far below that of a point."""
_NEGLIGIBLE = 1e-3
_SILHOUETTE = 1500
"""Points whose silhouettes are averaged; their cost grows with the square of this."""
_STARTS = 8
"""Runs of k-means. In half the samples, the closest groups may be those that split noise."""
_WORTH = 0.1
"""Share of what is unexplained that one more group must explain."""
_SURE = 3.0
"""Standard errors by which it must do so."""

Points = npt.NDArray[np.float32]
Labels = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Groups:
    """Groups of points, the largest first.

    Attributes
    ----------
    number
        How many; 0 of no points.
    labels, distance
        Group of each point and distance to its centre, shape (point,).
    medoids
        Index of the point that is nearest to each centre, shape (group,).
    candidates, explained, silhouettes
        Numbers tried, and how good they are, shape (candidate,).
    repeatable, stability
        As of `chdstat.patterns.Atlas`.
    """

    number: int
    labels: Labels
    distance: Floats
    medoids: Labels
    candidates: Counts
    explained: Floats
    silhouettes: Floats
    repeatable: float
    stability: float


class _Candidate(NamedTuple):
    """One number of groups: labels from all samples, and what the halves predict.

    `errors` are the squared errors, by point, of predicting a half from the other half's centres.
    """

    number: int
    labels: Labels
    errors: Floats
    silhouette: float
    stability: float
    smallest: float


def find_groups(
    whole: Points,
    halves: Sequence[Points],
    numbers: Sequence[int],
    *,
    min_share: float,
    rng: np.random.Generator,
) -> Groups:
    """Group points by k-means, as many groups as one half of the samples predicts in the other.

    Parameters
    ----------
    whole, halves
        Points from all samples and from two halves of them, each of shape (point, feature).
    numbers
        Numbers of groups to choose from, ascending.
    min_share
        Smallest share of the points in a group of a number that is chosen.
    rng
        Of which points k-means learns from, and where it starts.

    Raises
    ------
    InputError
        If only one number is given, and it is larger than the number of different points.
    """
    import sklearn.cluster  # noqa: F401 - its threads can be limited once it is there

    learnt = rng.permutation(len(whole))[:_LEARNT]
    seed = int(rng.integers(2**31 - _STARTS))
    parts = [whole[learnt], *(half[learnt] for half in halves)]
    most = min(len(np.unique(part, axis=0)) for part in parts)
    if 0 < most < numbers[0]:
        message = f"{numbers[0]} clusters need as many different shapes, got {most}"
        raise InputError(message)
    points, one, two = _rotated(*parts)
    # Threads wait longer for each other than so few points take, above all on a busy machine.
    with threadpool_limits(limits=1):
        tried = [_try(points, one, two, k, seed) for k in numbers if k <= most]
    noise = ((one - two) ** 2).sum(axis=-1, dtype=np.float64) / 2
    together = np.zeros(len(one), dtype=np.intp)
    alone = (_prediction_errors(one, two, together) + _prediction_errors(two, one, together)) / 2
    chosen = _choose(tried, noise, min_share)
    repeated = alone - noise
    sure = len(alone) > 0 and repeated.mean() > _SURE * _standard_error(repeated)
    variation = float(repeated.sum()) if sure else 0.0
    labels, distance = np.empty(0, dtype=np.intp), np.empty(0)
    if chosen is not None:
        from sklearn.metrics import pairwise_distances_argmin_min

        centers = _means(whole[learnt], chosen.labels)
        labels, distance = pairwise_distances_argmin_min(whole, centers)
    found, labels, count = np.unique(labels, return_inverse=True, return_counts=True)
    order = np.argsort(-count, kind="stable")
    labels = np.argsort(order)[labels]
    nearest = [np.where(labels == k, distance, np.inf).argmin() for k in range(len(found))]
    return Groups(
        number=len(found),
        labels=labels,
        distance=distance.astype(np.float64),
        medoids=np.array(nearest, dtype=np.intp),
        candidates=np.array([c.number for c in tried], dtype=np.int64),
        explained=np.array([ratio((alone - c.errors).sum(), variation) for c in tried]),
        silhouettes=np.array([c.silhouette for c in tried]),
        repeatable=float(ratio(variation, alone.sum())),
        stability=chosen.stability if chosen else np.nan,
    )


def _rotated(*parts: Points) -> list[Points]:
    """Rotate points to their principal axes, and leave out axes of hardly any variation.

    Distances stay what they are, within a thousandth of the variance; k-means takes a third of the
    time on distribution functions, whose values at neighbouring edges are nearly the same.
    """
    if not len(parts[0]):
        return list(parts)
    center = parts[0].mean(axis=0)
    variances, axes = np.linalg.eigh(sum((part - center).T @ (part - center) for part in parts))
    kept = np.cumsum(variances) > _NEGLIGIBLE * variances.sum()
    kept[-1] = True
    return [(part - center) @ axes[:, kept] for part in parts]


def _try(points: Points, one: Points, two: Points, number: int, seed: int) -> _Candidate:
    from sklearn.metrics import adjusted_rand_score, silhouette_score

    labels = _k_means(points, number, seed, starts=_STARTS)
    # To choose from a few starts by what they predict favours no number of groups by as much as
    # groups of noise lose.
    predicted = []
    for here, there in ((one, two), (two, one)):
        starts = range(seed, seed + (_STARTS if number > 1 else 1))
        runs = [_k_means(here, number, start, starts=1) for start in starts]
        errors = [_prediction_errors(here, there, run) for run in runs]
        best = int(np.argmin([error.sum() for error in errors]))
        predicted.append((runs[best], errors[best]))
    (of_one, errors_two), (of_two, errors_one) = predicted
    some = labels[:_SILHOUETTE]
    several = 1 < len(np.unique(some)) < len(some)
    return _Candidate(
        number=number,
        labels=labels,
        errors=(errors_one + errors_two) / 2,
        silhouette=float(silhouette_score(points[:_SILHOUETTE], some)) if several else np.nan,
        stability=float(adjusted_rand_score(of_one, of_two)),
        smallest=float(np.bincount(labels, minlength=number).min() / len(points)),
    )


def _k_means(points: Points, number: int, seed: int, *, starts: int) -> Labels:
    from sklearn.cluster import KMeans  # takes a third of a second
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # Points that differ by rounding alone: empty groups are left out further down.
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = KMeans(number, n_init=starts, random_state=seed)
        return np.asarray(model.fit_predict(points), dtype=np.intp)


def _prediction_errors(here: Points, there: Points, labels: Labels) -> Floats:
    """Return how wrong the centres of one half are about the other half of each point."""
    _, places = np.unique(labels, return_inverse=True)
    error = there - _means(here, labels)[places]
    return np.asarray(np.vecdot(error, error), dtype=np.float64)


def _means(points: Points, labels: Labels) -> Points:
    """Return the centres of the groups that have points."""
    means = [points[labels == k].mean(axis=0, dtype=np.float64) for k in np.unique(labels)]
    return np.array(means, dtype=np.float32).reshape(-1, points.shape[-1])


def _choose(tried: list[_Candidate], noise: Floats, min_share: float) -> _Candidate | None:
    """Return the largest number of groups that are worth it, the first if no other is."""
    if not tried:
        return None
    chosen = tried[0]
    for candidate in tried[1:]:
        more = candidate.number - chosen.number
        gain = chosen.errors - candidate.errors
        unexplained = float((chosen.errors - noise).mean())
        worth = max((1 - (1 - _WORTH) ** more) * unexplained, _SURE * _standard_error(gain))
        if candidate.smallest >= min_share and gain.mean() > worth:
            chosen = candidate
    return chosen


def _standard_error(values: Floats) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.inf


def ratio(part: npt.ArrayLike, whole: npt.ArrayLike) -> Floats:
    """Return a part over the whole; NaN where there is nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(whole) > 0, np.divide(part, whole), np.nan)
