r"""Shrinkage: how far it pays to move from the sample mean to what a network estimates.

An estimate ``m + a (g - m)`` lies between the mean m and the network's g. Where t is an unbiased
target that neither has seen, the share with the least squared error under weights w is

.. math:: \alpha = \sum w (t - m) (g - m) / \sum w (g - m)^2

and every share below :math:`2 \alpha` is better than the mean (Stein's shrinkage with a known
target; Rousselle et al. 2012, doi:10.1145/2366145.2366214, choose between filters by two halves of
the samples likewise). Three cases differ in what is known:

With a reference, `reference_shares` finds shares for pixels of each brightness, brightened and
darkened separately: those with the least error among those under which neither MSE nor relMSE
exceeds the mean's, and the image keeps its mean radiance.

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

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import optimize, special

from chdstat._core.arrays import spans
from chdstat.estimators.progressive import error_model
from chdstat.estimators.progressive.dataset import Floats, Indices, TrainingSet
from chdstat.estimators.progressive.error_model import BRIGHTNESS, FLOOR, LOSSES, ratio, validate
from chdstat.estimators.registry import mean_of_good

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = [
    "FULL",
    "checked_shares",
    "measure_shrinkage",
    "moves_between",
    "shares_at",
    "shrinkage_factor",
]

GROUPS = 2 * len(BRIGHTNESS)
"""Groups of pixels with a share of their own: of each brightness, brightened and darkened ones."""
_LARGEST = 1.5
"""Share of a move at most: beyond 1 where others are held back and the image would lose light."""
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
_ROWS_AT_ONCE = 1024

Array = npt.NDArray[Any]
FULL = np.ones(1), np.ones((1, len(LOSSES), GROUPS))
"""Shares that follow all estimates all the way."""
Moves = tuple[Indices, Floats, Floats, Floats, Floats]
"""Estimates of pixels beside their means, and targets that neither has seen: rows, which pixels,
shape (row,); mean, estimate and target, in units of the image's radiance, and noise, unbiased for
the variance of the target, all of shape (row, channel)."""


def measure_shrinkage(
    network: Network, training_set: TrainingSet, validation: Indices, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return how far from the mean it pays to go to what a network estimates.

    Returns
    -------
    sizes : ndarray
        Numbers of samples that shares are known for, ascending.
    shares : ndarray
        0 for the mean, 1 for the estimate, beyond 1 where others are held back; shape (size, loss,
        group), groups of pixels as of `network.group_weights`.
    """
    if training_set.reference:
        # Rare lamps and fireflies are in all pixels, hardly in a tenth of them.
        pixels = np.arange(len(training_set))
        return reference_shares(validate(network, training_set, pixels=pixels, rng=rng))
    held_out = validate(network, training_set, pixels=validation, rng=rng, noise=True)
    # Without a reference the two estimates are nearly one.
    others = (held_out[name] for name in ("target", "noise"))
    moves = held_out["rows"], held_out["mean"], held_out["estimate"].mean(axis=0), *others
    shares = shares_keeping_mean(*own_shares(*moves), _mean_change(network, training_set))
    return np.ones(1), np.tile(shares, (1, len(LOSSES), 1))


def checked_shares(sizes: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Return shares as of `measure_shrinkage`.

    Raises
    ------
    ValueError
        If they have another shape, or lie out of range.
    """
    if shares.shape != (len(sizes), len(LOSSES), GROUPS) or not len(sizes):
        expected = f"(size, {len(LOSSES)}, {GROUPS}), size {len(sizes)}"
        message = f"shares must have shape {expected}, got {shares.shape}"
        raise ValueError(message)
    if not ((shares >= 0) & (shares <= _LARGEST)).all():
        message = f"shares must lie between 0 and {_LARGEST}"
        raise ValueError(message)
    return sizes, shares


def shares_at(sizes: Floats, shares: Floats, count: npt.NDArray[Any]) -> Floats:
    """Return the shares for numbers of samples, shape (row, loss, group)."""
    below, above, part = error_model.between_sizes(sizes, count)
    part = part[:, np.newaxis, np.newaxis]
    return np.asarray((1 - part) * shares[below] + part * shares[above])


def _mean_change(network: Network, training_set: TrainingSet) -> Floats:
    """Return what a network adds to the mean of all samples of pixels, shape (pixel, channel).

    It is the mean of what it adds under each loss, in units of the image's radiance, and nothing
    where all samples are the same light: there the mean is kept.
    """
    import torch

    everything, found = np.arange(len(training_set.counts)), []
    for block in spans(len(training_set), _ROWS_AT_ONCE):
        rows = np.arange(block.start, block.stop)
        profile, auxiliary, _ = training_set.minibatch(rows, everything)
        with torch.inference_mode():
            estimate, mean, _ = network(profile, auxiliary)
        found.append((estimate.mean(dim=1) - mean).numpy().astype(np.float64))
    noisy = training_set.variance.any(axis=-1, keepdims=True)
    lit = training_set.mean.any(axis=-1, keepdims=True)
    return np.where(noisy | ~lit, np.concatenate(found), 0)


def reference_shares(validation: dict[str, Array]) -> tuple[Floats, Floats]:
    """Return the shares that pay where targets are as good as the truth; see `measure_shrinkage`.

    Parameters
    ----------
    validation
        Estimates of pixels of the image, at several numbers of samples, as of `validate`.
    """
    sizes = np.unique(validation["size"])
    shares = [
        [_best_shares(error_model.of_size(validation, n), k) for k in range(len(LOSSES))]
        for n in sizes
    ]
    return sizes.astype(np.float64), np.array(shares)


def _best_shares(validation: dict[str, Array], loss: int) -> Floats:
    """Return the share of each group under which one of the errors is least.

    Neither error exceeds the mean's, and the image keeps its mean.
    """
    import torch

    from chdstat.estimators.progressive.network import group_weights

    rows, mean, target = (validation[name] for name in ("rows", "mean", "target"))
    move = validation["estimate"][loss] - mean
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

    def gain(shares: Floats, k: int) -> float:
        along, squares = gains[k]
        return float(2 * along @ shares - shares @ squares @ shares)

    def slope(shares: Floats, k: int) -> Floats:
        along, squares = gains[k]
        return np.asarray(2 * (along - squares @ shares))

    found = optimize.minimize(
        lambda a: a @ ridge @ a - gain(a, loss),
        np.zeros(GROUPS),
        jac=lambda a: 2 * ridge @ a - slope(a, loss),
        method="SLSQP",
        bounds=[(0, _LARGEST)] * GROUPS,
        constraints=[
            {"type": "eq", "fun": lambda a: radiance @ a, "jac": lambda _: radiance},
            *({"type": "ineq", "fun": gain, "jac": slope, "args": (k,)} for k in range(len(gains))),
        ],
        options={"maxiter": 200},
    )
    return np.asarray(np.clip(found.x, 0, _LARGEST))


def moves_between(samples: Array, estimate: Array, others: Array, *, unit: float) -> Moves:
    """Return the moves to an estimate (..., channel) from the means of samples.

    Parameters
    ----------
    samples, others
        Of the same pixels, shape (..., channel, sample), at least 2 others.
    estimate
        In the unit of the samples.
    unit
        Mean radiance of the image.
    """
    one, two = (mean_of_good(others[..., first::2]) for first in range(2))
    mean, found, one, two = (
        (np.asarray(a, np.float64) / unit).reshape(-1, samples.shape[-2])
        for a in (mean_of_good(samples), estimate, one, two)
    )
    return np.arange(len(mean)), mean, found, (one + two) / 2, (one - two) ** 2 / 4


def shrinkage_factor(moves: Sequence[Moves]) -> float:
    r"""Return how far it pays to follow a network of another scene, 0 to 1.

    With the standard error s over pixels of the share :math:`\alpha`, it is
    :math:`\min(\alpha, 2 (\alpha - s))`, the smallest one for several weights of the errors, and 0
    where little is left of it.

    Parameters
    ----------
    moves
        Of pixels of the image at hand.
    """
    rows, *arrays = map(np.concatenate, zip(*moves, strict=True))
    mean, estimate, target, noise = _cleaned(*arrays)
    darker = np.minimum(estimate, mean)
    # It is not even presumed that truths lie about the estimates.
    pull = _pull(rows, mean, estimate, target, noise)
    wanted = [(target, darker, power) for power in _FOREIGN]
    wanted += [(target, target, 1.0), (pull * target, pull * estimate, 1.0)]
    return _smallest_share(rows, mean, estimate - mean, wanted, standard_errors=0.0)


def own_shares(
    rows: Indices, mean: Floats, estimate: Floats, target: Floats, noise: Floats
) -> tuple[float, float]:
    r"""Return how far it pays to brighten and to darken pixels, 0 to 1, without a reference.

    With the standard error s over pixels of the share :math:`\alpha`, it is
    :math:`\min(\alpha + s, 2 (\alpha - s))`, the smallest one for several weights of the errors,
    and 0 where little is left of it. The arguments are `Moves` of pixels that did not train the
    network, but are of the same image.
    """
    mean, estimate, target, noise = _cleaned(mean, estimate, target, noise)
    change = estimate - mean
    sides = _sides(change)
    likely = _likely(rows, estimate, target, noise, change)
    darker = np.minimum(estimate, mean)
    wanted = [(target, darker, power) for power in _GUARDED] + [(likely, likely, 1.0)]
    up, down = (
        _smallest_share(rows, mean, np.where(side, change, 0), wanted, standard_errors=1.0)
        for side in sides
    )
    return up, down


def _cleaned(mean: Floats, estimate: Floats, target: Floats, noise: Floats) -> list[Floats]:
    """Return moves in which those that are not finite, or hardly move, stay at the mean."""
    usable = np.isfinite(estimate - mean) & np.isfinite(target) & np.isfinite(noise)
    mean, estimate, target, noise = (
        np.where(usable, a, 0) for a in (mean, estimate, target, noise)
    )
    same = np.abs(estimate - mean) <= _SAME * np.abs(mean)
    return [mean, np.where(same, mean, estimate), target, noise]


def _sides(change: Floats) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which pixels are brightened, and which are not, in all channels the same."""
    up = np.broadcast_to(change.sum(axis=-1, keepdims=True) > 0, change.shape)
    return up, ~up


def shares_keeping_mean(brightened: float, darkened: float, change: Floats) -> Floats:
    """Return shares of the groups under which an image keeps its mean, which is unbiased.

    Parameters
    ----------
    brightened, darkened
        Shares at most, as of `own_shares`.
    change
        What the network adds to the mean of all samples of each pixel, shape (pixel, channel).
    """
    radiance = change.sum(axis=-1)
    up, down = radiance[radiance > 0].sum(), -radiance[radiance < 0].sum()
    moved = min(brightened * up, darkened * down)
    if not moved > 0:
        return np.zeros(GROUPS)
    return np.repeat([moved / up, moved / down], GROUPS // 2)


def _likely(rows: Indices, found: Floats, target: Floats, noise: Floats, change: Floats) -> Floats:
    """Return radiances that scatter about the estimates as the truths do.

    Targets scatter more than the truths, by their noise, and best guesses of the truths less, while
    relative errors hang on the darkest truths (Louis 1984, doi:10.1080/01621459.1984.10478062, asks
    for such an ensemble). These are log-normal about the estimates, in the order of the targets,
    which know nothing of the noise of the means. The variance of their logarithm is the covariance
    of two halves of the targets, relative to the estimates and cut at `_BRIGHTEST`, and one
    standard error more, by the square of what the cut leaves of a relative change.
    """
    scale = np.sqrt(found**2 + FLOOR)
    # Two halves of equal size have this mean and this variance of it.
    halves = [(target + side * np.sqrt(np.maximum(noise, 0))) / scale for side in (-1, 1)]
    cut = [np.minimum(half, _BRIGHTEST) for half in halves]
    likely = found.copy()
    for pixels in _sides(change):
        weight = np.where(pixels, (change / scale) ** 2, 0)
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


def _pull(rows: Indices, mean: Floats, found: Floats, target: Floats, noise: Floats) -> Floats:
    r"""Return the part of the truth's mean that has the least relative error, for each estimate.

    Of log-normal truths with the mean y and the variance :math:`c^2 y^2` it is
    :math:`(1 + c^2)^{-2}`: dark pixels that are brightened to the mean of their like have large
    relative errors. The variance is that of the truths about their estimates, and one standard
    error more; where relative errors have their floor, it counts for less. Darkened pixels are
    only nearer to it: for them it is 1.
    """
    scale, change = found**2 + FLOOR, found - mean
    up = change > 0
    weight = np.where(up, change**2 / scale, 0)
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
    rows: Indices,
    mean: Floats,
    change: Floats,
    wanted: Sequence[tuple[Floats, Floats, float]],
    *,
    standard_errors: float,
) -> float:
    """Return the smallest share that pays, of those for (truth, radiance, power of its weight)."""
    share = min(
        _share(rows, change, truth - mean, (radiance**2 + FLOOR) ** -power, standard_errors)
        for truth, radiance, power in wanted
    )
    return share if share >= _LEAST else 0.0


def _share(
    rows: Indices, move: Floats, wanted: Floats, weight: Floats, standard_errors: float
) -> float:
    """Return the share of a move that reduces the weighted error, 0 to 1.

    At most so many standard errors above the measured one are allowed.
    """
    along, squares = (
        np.bincount(rows, (weight * move * other).sum(axis=-1)) for other in (wanted, move)
    )
    share, error = ratio(along, squares)
    return float(np.clip(min(share + standard_errors * error, 2 * (share - error)), 0, 1))
