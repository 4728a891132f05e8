"""Fits to the excesses of the largest samples over a threshold, and their results over an image.

The threshold is chosen for each row: the largest of a few shares of the samples whose fit the
Anderson-Darling test does not reject. `pareto_tail` fits the generalised Pareto distribution,
`hill_tail` the power law.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, spans
from chdstat._core.display import Card, Shown, each, reasons, with_interval
from chdstat._core.reasons import label_variables
from chdstat._core.resampling import q_values
from chdstat.fit.family import RADIANCE

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.samples import Mapped

__all__ = [
    "MINIMUM_EXCESSES",
    "Tail",
    "TailFits",
    "candidates",
    "finish_tail",
    "hill_tail",
    "pareto_tail",
    "tail_variables",
]

_LABELS = {
    "tail_index": "generalised Pareto tail index xi",
    "tail_index_se": "standard error of the tail index",
    "tail_interval": "interval of the tail index",
    "tail_p_value": "p-value of a tail index at most the tested one",
    "tail_p_exponential": "p-value of a tail no heavier than a gamma distribution's",
    "tail_q_value": "q-value of a tail index at most the tested one",
    "tail_q_exponential": "q-value of a tail no heavier than a gamma distribution's",
    "tail_index_far": "tail index of the largest samples alone",
    "tail_interval_far": "interval of the tail index of the largest samples alone",
    "tail_scale": "generalised Pareto scale",
    "tail_threshold": "radiance above which the tail begins",
    "tail_n": "samples above the threshold",
    "tail_share": "share of the positive samples above the threshold",
    "tail_hill": "Hill estimate of the tail index",
    "tail_hill_interval": "interval of the Hill estimate",
    "tail_hill_n": "samples of the Hill estimate",
    "tail_variance_suspect": "xi >= 1/2: do not trust the sample variance",
    "tail_variance_trusted": "no estimate of the tail contradicts a finite variance",
    "tail_variance_unidentified": "the samples do not determine whether the variance is finite",
    "tail_reason": "why there is no tail index",
}
_FIELDS = {"tail_index": "xi", "tail_index_se": "standard_error", "tail_index_far": "xi_far"}
"""Fields of `Tail` that have other names in an image than with the prefix ``tail_``."""


@dataclass(frozen=True, repr=False)
class Tail(Shown):
    """Tail of the positive part; arrays of the batch's shape, (...), NaN where `reason` says why.

    Attributes
    ----------
    xi, standard_error
        Tail index and its asymptotic standard error, ``(1 + xi) / sqrt(n)``, but at least
        ``0.9 / sqrt(n)``, as simulations of bounded tails show.
    interval
        Low and high end for xi, shape (..., 2), with the largest sample and without it; wide where
        that one carries more than half of the sum.
    xi_far, interval_far
        Tail index of the `FAR` largest samples alone, and its interval: it detects a few samples of
        a heavier tail than the rest, which `interval` does not account for.
    p_value
        One-sided, of the hypothesis that the tail index is at most `tested`.
    p_exponential
        One-sided, of the hypothesis that the tail is no heavier than that of an exponential, or of
        a gamma distribution whose logarithms vary as much as the samples' do.
    tested, level
        That index, and the level of the intervals.
    scale, threshold
        Generalised Pareto scale, and radiance above which the tail begins.
    n, share
        Excesses that were used, and their share of the positive samples.
    hill, hill_interval, hill_n
        Hill's estimate, for power laws only, since it is positive for every tail; its interval,
        shape (..., 2); the excesses that it was made of.
    variance_suspect
        Where xi >= 1/2: the variance may be infinite, the sample variance is not to be trusted, nor
        is any error bar made of it.
    variance_trusted
        Where the upper end of the interval is below 1/2, and neither the largest candidate nor the
        `FAR` largest samples are heavier than those of a gamma distribution; nor do fewer than 512
        samples vary more than those of one. A heavy tail of which few samples lie beyond the others
        is not seen: see the notes of `tail_index`.
    variance_unidentified
        Where neither holds: the samples do not determine whether their variance is finite.
    reason
        `Reason` codes; where it is not `OK`, none of the three holds.
    """

    xi: Floats
    standard_error: Floats
    interval: Floats
    xi_far: Floats
    interval_far: Floats
    p_value: Floats
    p_exponential: Floats
    tested: float
    level: float
    scale: Floats
    threshold: Floats
    n: Counts
    share: Floats
    hill: Floats
    hill_interval: Floats
    hill_n: Counts
    variance_suspect: Mask
    variance_trusted: Mask
    variance_unidentified: Mask
    reason: npt.NDArray[np.int8]

    def _card(self) -> Card:
        cases = {
            "trusted": self.variance_trusted,
            "suspect": self.variance_suspect,
            "not determined": self.variance_unidentified,
        }
        low, high = self.interval[..., 0], self.interval[..., 1]
        facts = {
            "tail index": each(with_interval, self.xi, low, high),
            "excesses": self.n,
            "above": self.threshold,
            "variance": np.select([*cases.values()], [*cases], "not known"),
            "not fitted": reasons(self.reason),
        }
        return Card("Tail", facts)


def tail_variables(tail: Tail) -> Mapped:
    """Return tails over (y, x, channel), or over (y, x), as variables for `Samples.map`."""
    first = ("channel",) if tail.n.ndim == 3 else ()
    variables = {}
    for name in _LABELS:
        if name not in ("tail_q_value", "tail_q_exponential"):
            value = getattr(tail, _FIELDS.get(name, name.removeprefix("tail_")))
            dims = (*first, "bound") if value.ndim > tail.n.ndim else first
            variables[name] = dims, value
    return variables


def finish_tail(dataset: xr.Dataset) -> xr.Dataset:
    """Add the q-values over the image, and set long names, units and flag meanings."""
    for name in ("value", "exponential"):
        p = dataset[f"tail_p_{name}"]
        dataset = dataset.assign({f"tail_q_{name}": p.copy(data=q_values(p.to_numpy()))})
    units = dict.fromkeys(("tail_scale", "tail_threshold"), RADIANCE)
    labels = {name: (text, units.get(name, "1")) for name, text in _LABELS.items()}
    return label_variables(dataset, labels)


MINIMUM_EXCESSES = 10
"""Fewer samples above the threshold give no tail index."""

_CHUNK = 2**17
"""Samples worked on at once: several float64 copies of them stay in the cache."""
_LARGEST_SHARE = 0.5
_STEPS = 3
_CELLS, _SINGLES = 32, 8
"""Groups that excesses are put into where they are averaged; the largest stay alone."""
_PRIOR_QUARTILE = 3.0
"""Zhang and Stephens' constant: how far their grid reaches beyond the largest excess."""
_LEAST = 1e-12
"""Least distribution function in the test: that of ties with the threshold."""


@dataclass(frozen=True)
class TailFits:
    """A fit to the excesses of each row, all of the batch's shape.

    Attributes
    ----------
    xi, scale
        Tail index, NaN where excesses are equal, and scale in units of the samples.
    threshold
        Largest sample that is no excess.
    n
        Excesses.
    first_xi
        Tail index of the first candidate, whether the test rejects it or not.
    """

    xi: Floats
    scale: Floats
    threshold: Floats
    n: Counts
    first_xi: Floats


@dataclass(frozen=True)
class _Excesses:
    """Excesses in ascending order, the largest in the last column, shape (row, excess).

    Attributes
    ----------
    y
        Relative to the largest, hence at most 1; 0 in the columns that a row does not need.
    rank
        1 for the smallest excess; not positive in columns that a row does not need.
    n, threshold, largest
        Excesses, the sample below them, and the largest excess, shape (row,).
    """

    y: Floats
    rank: Counts
    n: Counts
    threshold: Floats
    largest: Floats


_Model = Callable[[_Excesses], tuple[Floats, Floats, Mask]]
"""Returns xi, the scale relative to the largest excess, and where the test does not reject."""


def candidates(n: Counts, share: float | None) -> Counts:
    """Return numbers of excesses to try, largest first, shape (row, candidate).

    A given share is the only one. Otherwise the largest is ``1.1 n^(3/4)``, and at most half of the
    samples; each further one has a half of the last one's variance more.
    """
    if share is not None:
        return np.asarray(np.floor(share * n), dtype=np.int64)[:, np.newaxis]
    largest = np.minimum(1.1 * n**0.75, _LARGEST_SHARE * n)[:, np.newaxis]
    k = np.floor(largest * 2.0 ** (-np.arange(_STEPS) / 2)).astype(np.int64)
    return np.asarray(np.maximum(k, np.minimum(k[:, :1], MINIMUM_EXCESSES)))


def pareto_tail(ascending: npt.NDArray[Any], n: Counts, k: Counts, usable: Mask) -> TailFits:
    """Fit generalised Pareto distributions by Zhang and Stephens (2009).

    Parameters
    ----------
    ascending
        Samples of the usable rows in ascending order, shape (row, sample); the first `n` count.
    n
        Shape (row,).
    k
        Numbers of excesses to try, shape (row, candidate), the preferred one first.
    usable
        Where the rows belong in the batch, shape (...): other rows get NaN and 0.
    """
    return _fit_tails(ascending, n, k, usable, _generalised_pareto, log=False)


def hill_tail(ascending: npt.NDArray[Any], n: Counts, k: Counts, usable: Mask) -> TailFits:
    """Fit power laws by Hill (1975); arguments as of `pareto_tail`, the scale is the threshold."""
    return _fit_tails(ascending, n, k, usable, _power_law, log=True)


def _fit_tails(
    ascending: npt.NDArray[Any], n: Counts, k: Counts, usable: Mask, model: _Model, *, log: bool
) -> TailFits:
    values = np.full((5, usable.size), np.nan)
    place, order = np.flatnonzero(usable), np.argsort(k[:, 0], kind="stable")
    for part in spans(len(n), max(1, _CHUNK // int(k.max(initial=1)))):
        rows = order[part]
        values[:, place[rows]] = _choose(ascending, n, k, rows, model, log)
    xi, scale, threshold, count, first_xi = values.reshape(5, *usable.shape)
    return TailFits(xi, scale, threshold, np.nan_to_num(count).astype(np.int64), first_xi)


def _choose(
    ascending: npt.NDArray[Any], n: Counts, k: Counts, rows: Counts, model: _Model, log: bool
) -> Floats:
    """Take the first candidate whose fit is not rejected, or the last one that can be fitted.

    Returns xi, scale, threshold, excesses, and xi of the first candidate, shape (5, row).
    """
    found, open_ = np.full((5, len(rows)), np.nan), np.arange(len(rows))
    for tried in range(k.shape[1]):
        here = rows[open_]
        excesses = _excesses(ascending, n[here], k[here, tried], here, log)
        xi, scale, accepted = model(excesses)
        if tried == 0:
            found[4] = xi
        known = np.isfinite(xi)
        chosen = xi, scale * excesses.largest, excesses.threshold, excesses.n
        found[:4, open_[known]] = np.stack(chosen)[:, known]
        open_ = open_[~accepted]
        if not len(open_):
            break
    return found


def _excesses(
    ascending: npt.NDArray[Any], n: Counts, k: Counts, rows: Counts, log: bool
) -> _Excesses:
    width = int(k.max())
    columns = n[:, np.newaxis] - width + np.arange(width)
    top = ascending[rows[:, np.newaxis], np.maximum(columns, 0)].astype(np.float64)
    threshold = ascending[rows, n - 1 - k].astype(np.float64)
    rank = np.arange(width) - (width - k)[:, np.newaxis] + 1
    low = threshold[:, np.newaxis]
    top = np.maximum(top, low)
    excess = np.log(top) - np.log(low) if log else top - low
    largest = excess[:, -1].copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        excess /= largest[:, np.newaxis]
    return _Excesses(y=excess, rank=rank, n=k, threshold=threshold, largest=largest)


def _generalised_pareto(e: _Excesses) -> tuple[Floats, Floats, Mask]:
    """Average over the profile likelihood: Zhang and Stephens (2009), section 2.

    Their k is -xi and their theta is -xi / scale.
    """
    count, mean = _groups(e)
    # The first quartile of the excesses, as they define it.
    place = e.y.shape[1] - e.n + np.floor(e.n / 4 + 0.5).astype(np.int64) - 1
    quartile = np.take_along_axis(e.y, place[:, np.newaxis], axis=-1)[:, 0]
    points = 20 + np.sqrt(e.n).astype(np.int64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        weight, theta = _profile(count, mean, quartile, points, e.n)
        best = np.vecdot(weight, theta) / weight.sum(axis=-1)
        log = np.log1p(-best[:, np.newaxis] * e.y)
        xi = log.sum(axis=-1) / e.n
        passed = _anderson_darling(-log / xi[:, np.newaxis], e) <= _critical(xi, e.n)
        return xi, -xi / best, passed


def _profile(
    count: Floats, mean: Floats, quartile: Floats, points: Counts, n: Counts
) -> tuple[Floats, Floats]:
    """Return the likelihood of the points of their grid, relative to the largest, and the grid."""
    grid = np.arange(points.max()) + 0.5
    reach = 1 - np.sqrt(points[:, np.newaxis] / grid)
    theta = 1 + reach / (_PRIOR_QUARTILE * quartile[:, np.newaxis])
    theta[theta == 0] = _LEAST
    xi = np.empty(theta.shape)
    for i in range(len(grid)):
        # Logarithms of numbers near 1 lose digits only where xi is 0, to all that matters here.
        xi[:, i] = np.vecdot(count, np.log(1 - theta[:, i, np.newaxis] * mean))
    xi /= n[:, np.newaxis]
    log = n[:, np.newaxis] * (np.log(-theta / xi) - xi - 1)
    log[grid > points[:, np.newaxis]] = -np.inf
    return np.exp(log - log.max(axis=-1, keepdims=True)), theta


def _groups(e: _Excesses) -> tuple[Floats, Floats]:
    """Return counts and means of neighbouring excesses, shape (row, group)."""
    rows, width = e.y.shape
    # Sums from the smallest on keep the digits of small excesses.
    below = np.zeros((rows, width + 1))
    np.cumsum(e.y, axis=-1, out=below[:, 1:])
    single = np.minimum(e.n, _SINGLES)[:, np.newaxis]
    even = (e.n[:, np.newaxis] - single) * np.linspace(0, 1, _CELLS + 1)
    alone = e.n[:, np.newaxis] - np.minimum(np.arange(_SINGLES)[::-1], single)
    edges = np.concatenate([np.rint(even).astype(np.int64), alone], axis=-1)
    count = np.diff(edges, axis=-1).astype(np.float64)
    sums = np.take_along_axis(below, edges + (width - e.n)[:, np.newaxis], axis=-1)
    return count, np.diff(sums, axis=-1) / np.maximum(count, 1)


def _power_law(e: _Excesses) -> tuple[Floats, Floats, Mask]:
    """Average the log excesses: Hill (1975)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = e.y.sum(axis=-1) / e.n
        statistic = _anderson_darling(-e.y / mean[:, np.newaxis], e)
        xi = np.where(mean > 0, mean * e.largest, np.nan)
        # D'Agostino and Stephens (1986), table 4.14: 5 % of an exponential of unknown scale.
        passed = statistic * (1 + 0.6 / e.n) <= 1.321
        return xi, e.threshold / e.largest, np.asarray(passed)


def _anderson_darling(log_survival: Floats, e: _Excesses) -> Floats:
    """Return A^2 from the logarithms of 1 - F at the excesses."""
    log_below = np.log(np.maximum(1 - np.exp(log_survival), _LEAST))
    twice = 2.0 * e.rank
    terms = (twice - 1) * log_below + (2.0 * e.n[:, np.newaxis] - twice + 1) * log_survival
    return np.asarray(-e.n - np.sum(terms, axis=-1, where=e.rank > 0) / e.n)


def _critical(xi: Floats, n: Counts) -> Floats:
    """Return the 5 % point of A^2, both parameters fitted, as simulated for 15 to 400 excesses."""
    at_120, growth = np.interp(xi, _XI, _CRITICAL), np.interp(xi, _XI, _GROWTH)
    return np.asarray(at_120 + growth * np.log(n / 120))


_XI = np.array([-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
_CRITICAL = np.array([1.086, 1.019, 0.938, 0.873, 0.825, 0.788, 0.756])
_GROWTH = np.array([0.075, 0.061, 0.044, 0.030, 0.023, 0.015, 0.009])
"""Fitted to 25 000 to 200 000 samples per xi and number of excesses, to 0.01."""
