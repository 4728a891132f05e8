r"""Shrinkage: how far it pays to move from the sample mean to what a network estimates.

An estimate ``m + a (g - m)`` lies between the mean m and the network's g. Where t is an unbiased
target that neither has seen, the share with the least squared error under weights w is

.. math:: \alpha = \sum w (t - m) (g - m) / \sum w (g - m)^2

and every share below :math:`2 \alpha` is better than the mean (Stein's shrinkage with a known
target; Rousselle et al. 2012, doi:10.1145/2366145.2366214, choose between filters by two halves of
the samples likewise). Three cases differ in what is known:

With a reference, `reference_trust` finds shares for pixels of each brightness, brightened and
darkened apart: those with the least error among those under which neither MSE nor relMSE exceeds
the mean's, and the image keeps its mean radiance.

Without one, `own_shares` are two, for brightened and for darkened pixels: the largest that the
measurement, on pixels that did not train the network, does not speak against and that is better
than the mean, one standard error off. A relative error needs the truth in its denominator, and
targets are too noisy to stand for it: radiances take their place that scatter about the estimates
as the truths do (`_likely`). `keeping_mean` then holds back the side that moves more light.

For a model of another scene, `shrinkage_factor` is measured on the image itself, between halves.
Truths need not lie about its estimates, so relative errors are judged twice: by the targets, and by
how far scattered truths pull the best estimate below their mean (`_pull`). At half the samples the
mean is worse and the share larger; that is safe: with an estimate of constant bias b and a mean of
variance v at all samples, ``a = 2 v / (2 v + b^2)``, and the mixture has the squared error
``v (1 - 4 / (b^2 / v + 2)^2) < v``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy import optimize, special

from chdstat.estimators.order import mean_of_good
from chdstat.estimators.progressive.error_model import ValidationBatch, ratio
from chdstat.estimators.progressive.inputs import FLOOR, GROUPS, LOSSES, MOST_TRUST
from chdstat.estimators.progressive.learned import Trust
from chdstat.estimators.progressive.profile import Profile

__all__ = [
    "Move",
    "keeping_mean",
    "own_shares",
    "reference_trust",
    "shrinkage_factor",
]

_GUARDED = (0.5, 0.75)
"""Powers of the weights of the errors that a trained network shall not make worse: those of its
loss, since at 0 and 1 few bright or many dark pixels decide, and the measurement is all noise."""
_FOREIGN = (0.0, *_GUARDED)
"""Those for a network of another scene, which is followed only where squared errors fall, too."""
_LEAST = 0.2
"""Share below which hardly anything is gained."""
_BRIGHTEST = 3.0
"""Target over estimate at most, where their scatter is measured."""
_SAME = 1e-6
"""Relative difference below which an estimate is the mean, summed in another order."""
_RIDGE = 1e-3
"""Draws shares to 0 that no pixel speaks for."""

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.floating[Any]]


def reference_trust(batches: Sequence[ValidationBatch]) -> Trust:
    """Return the shares that pay where targets are as good as the truth.

    Parameters
    ----------
    batches
        Of pixels of the image, at several numbers of samples.
    """
    sizes = sorted({batch.size for batch in batches})
    of_size = [[batch for batch in batches if batch.size == n] for n in sizes]
    shares = [[_best_shares(found, loss) for loss in range(len(LOSSES))] for found in of_size]
    return Trust(np.array(sizes, np.float64), np.array(shares))


def _best_shares(batches: Sequence[ValidationBatch], loss: int) -> Floats:
    """Return the share of each group under which one of the errors is least.

    Neither error exceeds the mean's, and the image keeps its mean.
    """
    import torch

    from chdstat.estimators.progressive.network import group_weights

    rows = np.concatenate([batch.rows for batch in batches])
    mean = np.concatenate([batch.mean for batch in batches])
    target = np.concatenate([batch.target for batch in batches])
    move = np.concatenate([batch.estimate[loss] for batch in batches]) - mean
    group = group_weights(torch.from_numpy(mean), torch.from_numpy(move)).numpy()
    # Each pixel counts once, however often it was drawn: lamps are few.
    once = 1 / np.bincount(rows)[rows][:, np.newaxis]
    radiance = group.T @ (once * move).sum(axis=-1)
    size = np.abs(radiance).sum()
    noise = ((target - mean) ** 2).sum()
    if not min(size, noise) > 0:
        return np.zeros(GROUPS)
    gains = []
    for power in (0.0, 1.0):
        weight = once * (target**2 + FLOOR) ** -power
        along = group.T @ (weight * move * (target - mean)).sum(axis=-1)
        squares = group.T @ ((weight * move**2).sum(axis=-1)[:, np.newaxis] * group)
        scale = (weight * (target - mean) ** 2).sum()
        gains.append((along / scale, squares / scale))
    shares = _least(gains, loss, radiance / size)
    step = (group @ shares)[:, np.newaxis] * move
    certain = min(
        _share(rows, step, target - mean, (target**2 + FLOOR) ** -power, 1.0)
        for power in (0.0, 1.0)
    )
    return shares * certain


def _least(gains: Sequence[tuple[Floats, Floats]], loss: int, radiance: Floats) -> Floats:
    """Minimise ``a squares a - 2 along a`` of one loss, that of neither being above 0."""
    ridge = _RIDGE * np.eye(GROUPS) * max(np.trace(gains[loss][1]), 1e-12) / GROUPS

    def excess(shares: Floats, k: int) -> float:
        along, squares = gains[k]
        return float(shares @ squares @ shares - 2 * along @ shares)

    def slope(shares: Floats, k: int) -> Floats:
        along, squares = gains[k]
        return np.asarray(2 * (squares @ shares - along))

    found = optimize.minimize(
        lambda a: excess(a, loss) + a @ ridge @ a,
        np.zeros(GROUPS),
        jac=lambda a: slope(a, loss) + 2 * ridge @ a,
        method="SLSQP",
        bounds=[(0, MOST_TRUST)] * GROUPS,
        constraints=[
            {"type": "eq", "fun": lambda a: radiance @ a, "jac": lambda _: radiance},
            *(
                {
                    "type": "ineq",
                    "fun": lambda a, k=k: -excess(a, k),
                    "jac": lambda a, k=k: -slope(a, k),
                }
                for k in range(len(gains))
            ),
        ],
        options={"maxiter": 200},
    )
    return np.asarray(np.clip(found.x, 0, MOST_TRUST))


@dataclass(frozen=True)
class Move:
    """Estimates of pixels beside their means, and targets that neither has seen.

    Attributes
    ----------
    rows
        Which pixels, shape (row,).
    mean, estimate, target
        In units of the image's radiance, shape (row, channel).
    noise
        Unbiased for the variance of the target, shape (row, channel).
    """

    rows: npt.NDArray[np.int64]
    mean: Floats
    estimate: Floats
    target: Floats
    noise: Floats

    @classmethod
    def joined(cls, moves: Iterable[Move]) -> Self:
        """Return all of several as one, those that are not finite or move nothing as means."""
        arrays = zip(*(vars(move).values() for move in moves), strict=True)
        rows, mean, found, target, noise = (np.concatenate(parts) for parts in arrays)
        usable = np.isfinite(found - mean) & np.isfinite(target) & np.isfinite(noise)
        mean, found, target, noise = (np.where(usable, a, 0) for a in (mean, found, target, noise))
        same = np.abs(found - mean) <= _SAME * np.abs(mean)
        return cls(rows, mean, np.where(same, mean, found), target, noise)

    @property
    def change(self) -> Floats:
        """What estimates add to means."""
        return self.estimate - self.mean

    @property
    def darker(self) -> Floats:
        """The darker one of estimate and mean."""
        return np.minimum(self.estimate, self.mean)

    @property
    def up(self) -> npt.NDArray[np.bool_]:
        """Which pixels are brightened, in all channels alike, shape (row, channel)."""
        return np.broadcast_to(self.change.sum(axis=-1, keepdims=True) > 0, self.mean.shape)

    @classmethod
    def of(cls, batch: ValidationBatch) -> Self:
        """Return that of a batch, whose estimates without a reference are nearly one."""
        return cls(batch.rows, batch.mean, batch.estimate.mean(axis=0), batch.target, batch.noise)

    @classmethod
    def of_profiles(cls, profile: Profile, estimate: Array, other: Profile) -> Self:
        """Return that of an estimate (..., channel) from profiles, and of other samples."""
        mean, found, target, noise = (
            (np.asarray(a, np.float64) / scale).reshape(-1, profile.channels)
            for a, scale in (
                (profile.mean(), profile.unit),
                (estimate, profile.unit),
                (other.mean(), profile.unit),
                (other.variance_of_mean(), 1.0),
            )
        )
        return cls(np.arange(len(mean)), mean, found, target, noise)

    @classmethod
    def between(cls, samples: Array, estimate: Array, others: Array, *, unit: float) -> Self:
        """Return that of an estimate (..., channel), and of other samples of the same pixels.

        Parameters
        ----------
        samples, others
            Shape (..., channel, sample), at least 2 others.
        estimate
            In the unit of the samples.
        unit
            Mean radiance of the image.
        """
        channels = samples.shape[-2]
        mean, found, *parts = (
            (np.asarray(a, np.float64) / unit).reshape(-1, channels)
            for a in (
                mean_of_good(samples),
                estimate,
                mean_of_good(others[..., 0::2]),
                mean_of_good(others[..., 1::2]),
            )
        )
        noise = (parts[0] - parts[1]) ** 2 / 4
        return cls(np.arange(len(mean)), mean, found, (parts[0] + parts[1]) / 2, noise)


def shrinkage_factor(moves: Iterable[Move]) -> float:
    r"""Return how far it pays to follow a network of another scene, 0 to 1.

    With the standard error s over pixels of the share :math:`\alpha`, it is
    :math:`\min(\alpha, 2 (\alpha - s))`, the smallest one for several weights of the errors, and 0
    where little is left of it.

    Parameters
    ----------
    moves
        Of pixels of the image at hand.
    """
    all_of_it = Move.joined(moves)
    target = all_of_it.target
    # It is not even presumed that truths lie about the estimates.
    pull = _pull(all_of_it)
    wanted = [(target, all_of_it.darker, power) for power in _FOREIGN]
    wanted += [(target, target, 1.0), (pull * target, pull * all_of_it.estimate, 1.0)]
    return _smallest_share(all_of_it, wanted, standard_errors=0.0)


def own_shares(moves: Iterable[Move]) -> tuple[float, float]:
    r"""Return how far it pays to brighten and to darken pixels, 0 to 1, without a reference.

    With the standard error s over pixels of the share :math:`\alpha`, it is
    :math:`\min(\alpha + s, 2 (\alpha - s))`, the smallest one for several weights of the errors,
    and 0 where little is left of it.

    Parameters
    ----------
    moves
        Of pixels that did not train the network, but are of the same image.
    """
    both = Move.joined(moves)
    likely = _likely(both)
    wanted = [(both.target, both.darker, power) for power in _GUARDED]
    wanted += [(likely, likely, 1.0)]
    up, down = (
        _smallest_share(both, wanted, standard_errors=1.0, side=side)
        for side in (both.up, ~both.up)
    )
    return up, down


def keeping_mean(brightened: float, darkened: float, change: Floats) -> Trust:
    """Return trust of at most these shares under which an image keeps its mean, which is unbiased.

    Parameters
    ----------
    brightened, darkened
        As of `own_shares`.
    change
        What the network adds to the mean of all samples of each pixel, shape (pixel, channel).
    """
    radiance = change.sum(axis=-1)
    up, down = radiance[radiance > 0].sum(), -radiance[radiance < 0].sum()
    moved = min(brightened * up, darkened * down)
    if not moved > 0:
        return Trust.even(0.0)
    trust = Trust.even(1.0)
    half = GROUPS // 2
    return replace(trust, shares=trust.shares * np.repeat([moved / up, moved / down], half))


def _likely(moves: Move) -> Floats:
    """Return radiances that scatter about the estimates as the truths do.

    Targets scatter more than the truths, by their noise, and best guesses of the truths less, while
    relative errors hang on the darkest truths (Louis 1984, doi:10.1080/01621459.1984.10478062, asks
    for such an ensemble). These are log-normal about the estimates, in the order of the targets,
    which know nothing of the noise of the means. The variance of their logarithm is the covariance
    of two halves of the targets, relative to the estimates and cut at `_BRIGHTEST`, and one
    standard error more, by the square of what the cut leaves of a relative change.
    """
    rows, found, target, noise = moves.rows, moves.estimate, moves.target, moves.noise
    scale = np.sqrt(found**2 + FLOOR)
    # Two halves of equal size have this mean and this variance of it.
    halves = [(target + side * np.sqrt(np.maximum(noise, 0))) / scale for side in (-1, 1)]
    cut = [np.minimum(half, _BRIGHTEST) for half in halves]
    likely = found.copy()
    for pixels in (moves.up, ~moves.up):
        weight = np.where(pixels, (moves.change / scale) ** 2, 0)
        below = np.bincount(rows, weight.sum(axis=-1))
        if not below.any():
            continue
        middle = sum((weight * half).sum() for half in cut) / (2 * below.sum())
        one, other = (half - middle for half in cut)
        most = float((weight * (one**2 + other**2)).sum() / (2 * below.sum()))
        shared, error = ratio(np.bincount(rows, (weight * one * other).sum(axis=-1)), below)
        # A relative change of the truths changes what is cut by so much.
        slope = sum((weight * half * (half < _BRIGHTEST)).sum() for half in halves)
        slope /= 2 * below.sum()
        if slope > 0:
            width = float(np.clip(shared + error, 0, most)) / slope**2
            likely[pixels] *= _log_normal(width, (target / scale)[pixels])
    return likely


def _log_normal(width: float, like: Floats) -> Floats:
    """Return log-normal numbers of mean 1 with the ranks of `like`, ties broken at random.

    `width` is the variance of their logarithm.
    """
    order = np.random.default_rng(0).permutation(len(like))
    rank = np.empty(len(like))
    rank[order[np.argsort(like[order], kind="stable")]] = np.arange(len(like)) + 0.5
    return np.asarray(np.exp(np.sqrt(width) * special.ndtri(rank / len(like)) - width / 2))


def _pull(moves: Move) -> Floats:
    r"""Return the part of the truth's mean that has the least relative error, for each estimate.

    Of log-normal truths with the mean y and the variance :math:`c^2 y^2` it is
    :math:`(1 + c^2)^{-2}`: dark pixels that are brightened to the mean of their like have large
    relative errors. The variance is that of the truths about their estimates, and one standard
    error more; where relative errors have their floor, it counts for less. Darkened pixels are
    only nearer to it: for them it is 1.
    """
    rows, found, target, noise = moves.rows, moves.estimate, moves.target, moves.noise
    scale = found**2 + FLOOR
    up = moves.change > 0
    weight = np.where(up, moves.change**2 / scale, 0)
    below = np.bincount(rows, weight.sum(axis=-1))
    if not below.any():
        return np.ones_like(found)
    first = float((weight * target / np.sqrt(scale)).sum() / below.sum())
    second, error = ratio(
        np.bincount(rows, (weight * (target**2 - noise) / scale).sum(axis=-1)), below
    )
    scatter = max(second + error - first**2, 0.0) / max(first, _SAME) ** 2
    return np.where(up, (1 + scatter * found**2 / scale) ** -2.0, 1.0)


def _smallest_share(
    moves: Move,
    wanted: Sequence[tuple[Floats, Floats, float]],
    *,
    standard_errors: float,
    side: npt.NDArray[np.bool_] | None = None,
) -> float:
    """Return the smallest share that pays, of those for (truth, radiance, power of its weight)."""
    change = moves.change if side is None else np.where(side, moves.change, 0)
    share = min(
        _share(
            moves.rows, change, truth - moves.mean, (radiance**2 + FLOOR) ** -power, standard_errors
        )
        for truth, radiance, power in wanted
    )
    return share if share >= _LEAST else 0.0


def _share(
    rows: npt.NDArray[np.int64],
    move: Floats,
    wanted: Floats,
    weight: Floats,
    standard_errors: float,
) -> float:
    """Return the share of a move that reduces the weighted error, 0 to 1.

    At most so many standard errors above the measured one are allowed.
    """
    along, squares = (
        np.bincount(rows, (weight * move * other).sum(axis=-1)) for other in (wanted, move)
    )
    share, error = ratio(along, squares)
    return float(np.clip(min(share + standard_errors * error, 2 * (share - error)), 0, 1))
