r"""Errors of the progressive estimator: how far to follow its network, and how wrong it may be.

`validate` lets the network estimate from some samples of a pixel; the other samples are the target.

An estimate ``m + a (g - m)`` lies between the mean m and the network's g. If t is an unbiased
target from other samples, the share a with the least squared error under weights w is

.. math:: \alpha = \sum w (t - m) (g - m) / \sum w (g - m)^2

and every share below :math:`2 \alpha` is better than the mean (Stein's shrinkage with a known
target; Rousselle et al. 2012, doi:10.1145/2366145.2366214, choose between filters likewise).
`reference_shares` finds shares for pixels of each brightness, brightened and darkened separately.

`ErrorModel` predicts the squared error as a sum of error terms with non-negative weights, fitted by
least squares. The radiance of a pixel is then modelled as gamma distributed, with the estimate as
mean and the predicted squared error as variance. Its quantiles are calibrated by split conformal
prediction (Lei et al. 2018, doi:10.1080/01621459.2017.1307116), separately for dark and for bright
estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
from scipy import interpolate, optimize, special

from chdstat._core.arrays import Indices, Reals
from chdstat.errors import InputError

if TYPE_CHECKING:
    from chdstat.estimators.progressive.learning import TrainingSet
    from chdstat.estimators.progressive.network import Network

__all__ = [
    "BRIGHTNESS",
    "FLOOR",
    "FULL",
    "LOSSES",
    "ErrorModel",
    "check_loss_weight",
    "error_terms",
    "of_size",
    "ratio",
    "reference_shares",
    "share_of",
    "shares_at",
    "validate",
]

LOSSES = ("mse", "relmse")
"""Losses that the estimates of a network minimise."""
BRIGHTNESS = tuple(range(-8, 5, 2))
"""Levels of the mean, in octaves of the unit, by which pixels are grouped."""
FLOOR = 0.01
"""Share of the image's squared mean radiance that keeps relative errors finite."""
ERROR_TERMS = 6
GROUPS = 2 * len(BRIGHTNESS)
"""Groups of pixels with their own share: for each brightness, brightened and darkened pixels."""
FULL = np.ones(1), np.ones((1, len(LOSSES), GROUPS))
"""Shares that follow the network entirely."""
_LARGEST = 1.5
"""Largest share of a move: above 1 where other moves are reduced and the image would lose light."""
_RIDGE = 1e-3
"""Moves shares without evidence towards 0."""
DARK = 0.02
"""Radiance, in units of the image's, below which errors no longer decrease with it."""
_DRAWS, _TIMES, _SAMPLES = 16, 4, 256
"""Per size: splits, splits of each pixel on average, and fewest samples of a pixel over all its
splits. Few samples of a lamp or a firefly are noisy."""
_ROWS, _ENOUGH = 1024, 1 << 17
"""Rows of a minibatch, and rows of a size that are enough even if a pixel is rarely drawn."""
Validation = dict[str, npt.NDArray[Any]]
"""Estimates from splits of pixels, in units of the image's radiance, by name:

``size`` (samples of each estimate) and ``rows`` (pixels), shape (row,); ``estimate``, shape (loss,
row, channel); ``certainty``, shape (loss, row); ``mean`` (of the input samples) and ``target``
(mean of the others), ``noise`` (unbiased variance of the target) and ``variance`` (of the mean),
shape (row, channel)."""
_BY_LOSS = ("estimate", "certainty")


def validate(
    network: Network,
    training_set: TrainingSet,
    *,
    pixels: Indices,
    rng: np.random.Generator,
    samples: int = _SAMPLES,
    noise: bool = False,
) -> Validation:
    """Estimate from splits of some pixels, at all training sizes.

    There are one or more splits per pixel. If there are few pixels, the splits of a size use at
    least `samples` samples of each. Measuring the `noise` of the targets takes as long as the
    estimates, so it is optional.
    """
    import torch

    found = []
    for n in sorted(set(training_set.sizes)):
        count, least = 0, _DRAWS
        wanted = min(max(_TIMES, samples / n) * len(pixels), max(_ENOUGH, len(pixels)))
        while least > 0 or count < wanted:
            rows, drawn = training_set.draw(pixels, n, _ROWS, rng)
            profile, described, target = training_set.minibatch(rows, drawn)
            with torch.inference_mode():
                estimate, mean, certainty = (
                    t.cpu().numpy().astype(np.float64) for t in network(profile, described)
                )
            found.append(
                {
                    "size": np.full(len(rows), n),
                    "rows": rows,
                    "estimate": np.moveaxis(estimate, 1, 0),
                    "certainty": certainty.T,
                    "mean": mean,
                    "target": target.astype(np.float64),
                    "variance": profile.variance_of_mean(),
                }
            )
            if noise:
                found[-1]["noise"] = training_set.noise(rows, drawn, rng)
            count, least = count + len(rows), least - 1
    return {
        name: np.concatenate([one[name] for one in found], axis=int(name in _BY_LOSS))
        for name in found[0]
    }


def of_size(validation: Validation, size: int) -> Validation:
    """Return the estimates from one number of samples."""
    rows = np.flatnonzero(validation["size"] == size)
    return {name: a.take(rows, axis=int(name in _BY_LOSS)) for name, a in validation.items()}


def error_terms(estimate: Reals, mean: Reals, certainty: Reals, variance: Reals) -> Reals:
    """Return the terms of squared errors, shape (..., row, channel, term), float64.

    The terms are a constant for dark pixels; the squared estimate; its squared distance to the
    mean; the variance of the mean; this variance times the uncertainty; and the squared mean times
    the certainty.

    Parameters
    ----------
    estimate
        Shape (..., row, channel).
    certainty
        Shape (..., row).
    mean, variance
        Mean of the samples and variance of that mean, shape (row, channel).
    """
    sure = certainty[..., np.newaxis]
    terms = (
        np.full_like(estimate, DARK**2),
        estimate**2,
        (estimate - mean) ** 2,
        np.broadcast_to(variance, estimate.shape),
        (1 - sure) ** 2 * variance,
        sure**2 * mean**2,
    )
    return np.stack(terms, axis=-1)


def between_sizes(sizes: Reals, count: npt.NDArray[Any]) -> tuple[Indices, Indices, Reals]:
    """Return where numbers of samples lie among ascending sizes, on a logarithmic scale.

    Returns
    -------
    below, above
        Indices of the sizes below and above; beyond the ends, both are the last one.
    part
        Fraction of the way from `below` to `above`, 0 to 1.
    """
    last = len(sizes) - 1
    place = np.interp(np.log2(np.maximum(count, 1)), np.log2(sizes), np.arange(last + 1))
    below = np.floor(place).astype(np.int64)
    return below, np.minimum(below + 1, last), place - below


def check_loss_weight(loss_weight: float) -> None:
    """Raise InputError if a loss weight is not between 0 and 1."""
    if not 0 <= loss_weight <= 1:
        message = f"loss_weight must lie between 0 (MSE) and 1 (relMSE), got {loss_weight}"
        raise InputError(message)


# --- how far to follow a network ---------------------------------------------------------------


def shares_at(sizes: Reals, shares: Reals, count: npt.NDArray[Any]) -> Reals:
    """Return the shares for numbers of samples, shape (row, loss, group)."""
    below, above, part = between_sizes(sizes, count)
    part = part[:, np.newaxis, np.newaxis]
    return np.asarray((1 - part) * shares[below] + part * shares[above])


def reference_shares(validation: Validation) -> tuple[Reals, Reals]:
    """Return how far to move from the mean towards the estimate of a network.

    The shares have the least error under two conditions: neither MSE nor relMSE exceeds that of the
    mean, and the image keeps its mean radiance.

    Parameters
    ----------
    validation
        Estimates of pixels at several numbers of samples, from `validate`.

    Returns
    -------
    sizes : ndarray
        Numbers of samples for which shares are known, ascending.
    shares : ndarray
        0 for the mean, 1 for the estimate, above 1 where other moves are reduced; shape (size,
        loss, group), with the groups of `network.group_weights`.
    """
    sizes = np.unique(validation["size"])
    shares = [[_best_shares(of_size(validation, n), k) for k in range(len(LOSSES))] for n in sizes]
    return sizes.astype(np.float64), np.array(shares)


def _best_shares(validation: Validation, loss: int) -> Reals:
    """Return the share of each group that minimises one of the errors.

    Neither error exceeds the mean's, and the image keeps its mean.
    """
    import torch

    from chdstat.estimators.progressive.network import group_weights

    rows, mean, target = (validation[name] for name in ("rows", "mean", "target"))
    move = validation["estimate"][loss] - mean
    group = group_weights(torch.from_numpy(mean), torch.from_numpy(move)).numpy()
    # Each pixel counts once, however often it was drawn.
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
        share_of(rows, step, target - mean, (target**2 + FLOOR) ** -power, beyond=1.0)
        for power in (0.0, 1.0)
    )
    return shares * certain


def _least(gains: Sequence[tuple[Reals, Reals]], loss: int, radiance: Reals) -> Reals:
    """Minimise ``a squares a - 2 along a`` for one loss, with the values of both at most 0."""
    ridge = _RIDGE * np.eye(GROUPS) * max(np.trace(gains[loss][1]), 1e-12) / GROUPS

    def gain(shares: Reals, k: int) -> float:
        along, squares = gains[k]
        return float(2 * along @ shares - shares @ squares @ shares)

    def slope(shares: Reals, k: int) -> Reals:
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


def share_of(
    pixels: Indices,
    move: Reals,
    wanted: Reals,
    weight: Reals | float = 1.0,
    *,
    beyond: float = 0.0,
) -> float:
    r"""Return a share of a move, 0 to 1, that reduces the weighted squared error with confidence.

    Let a be the slope of `wanted` over `move`, and s its standard error over pixels. The share is
    :math:`\min(a + k s, 2 (a - s))`: every share below 2 a is better than none.

    Parameters
    ----------
    pixels
        Pixel of each row, shape (row,).
    move, wanted, weight
        Shape (row, channel).
    beyond
        k, how many standard errors the share may exceed a.
    """
    along, squares = (
        np.bincount(pixels, (weight * move * other).sum(axis=-1)) for other in (wanted, move)
    )
    share, error = ratio(along, squares)
    if not np.isfinite(error):  # too few pixels to tell
        return 0.0
    return float(np.clip(min(share + beyond * error, 2 * (share - error)), 0, 1))


def ratio(above: npt.NDArray[Any], below: npt.NDArray[Any]) -> tuple[float, float]:
    """Return a ratio of sums over pixels and its standard error; inf for fewer than two pixels.

    Parameters
    ----------
    above, below
        One value per pixel; pixels where both are 0 are ignored.
    """
    total, pixels = float(below.sum()), int(np.count_nonzero(below))
    if not total > 0 or pixels < 2:
        return 0.0, np.inf
    found = float(above.sum()) / total
    squares = float(np.sum((above - found * below) ** 2))
    return found, float(np.sqrt(squares * pixels / (pixels - 1))) / total


# --- how large its errors are ------------------------------------------------------------------


LEVELS = np.array([0.005, 0.025, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.975, 0.995])
"""Probabilities at which quantiles are calibrated."""
LOSS_WEIGHTS = np.array([0.0, 0.5, 1.0])
"""Loss weights for which quantiles are calibrated; others are interpolated."""

_CALIBRATED = (len(LOSS_WEIGHTS), len(BRIGHTNESS), len(LEVELS))
_CHANCE = 0.5
"""Standard errors by which quantiles are moved outwards; then seven of ten are far enough."""
_FEW = 5
"""Pixels of a brightness that count as much as all other pixels."""


@dataclass(frozen=True)
class ErrorModel:
    """Expected errors of estimates, in units of the image's radiance.

    Attributes
    ----------
    weights
        Weights of the error terms, shape (loss, term).
    sizes
        Numbers of samples for which quantiles were calibrated, ascending.
    normal
        Calibrated normal quantiles at `LEVELS`, shape (size, loss weight, brightness, level).
    """

    weights: Reals
    sizes: Reals
    normal: Reals

    def __post_init__(self) -> None:
        expected = (len(LOSSES), ERROR_TERMS), (len(self.sizes), *_CALIBRATED)
        received = self.weights.shape, self.normal.shape
        if expected != received:
            message = f"weights and normal must have shapes {expected}, got {received}"
            raise ValueError(message)

    @classmethod
    def learn(
        cls,
        network: Network,
        training_set: TrainingSet,
        *,
        pixels: Indices,
        rng: np.random.Generator,
    ) -> Self:
        """Learn from splits of pixels that did not train the network."""
        held_out = validate(network, training_set, pixels=pixels, rng=rng, noise=True)
        losses = range(len(LOSSES))
        weights = np.array([least_squares(held_out, loss) for loss in losses])
        # Rare lamps are hardly found in the tenth of the pixels that is held out.
        pixels = np.arange(len(training_set))
        everywhere = validate(network, training_set, pixels=pixels, rng=rng, samples=0)
        sizes = np.unique(held_out["size"])
        normal = [calibrate(weights, of_size(held_out, n), of_size(everywhere, n)) for n in sizes]
        return cls(weights, sizes.astype(np.float64), np.array(normal))

    def variance(self, terms: Reals, loss_weight: float) -> Reals:
        """Return expected squared errors of mixed estimates, from terms (loss, ..., term)."""
        return _expected(self.weights, terms, loss_weight)

    def quantile(
        self,
        estimate: Reals,
        variance: Reals,
        count: npt.NDArray[Any],
        *,
        loss_weight: float,
        level: float,
    ) -> Reals:
        """Return a quantile; estimate and variance (row, channel), samples (row,).

        For a negative estimate, as of signed samples, it is a quantile of a normal distribution.
        """
        wanted = special.ndtri(level)
        # Beyond the calibrated levels, tails continue as those of a normal distribution.
        levels = special.ndtri(LEVELS)
        beyond = wanted - np.clip(wanted, levels[0], levels[-1])
        at_level = interpolate.interp1d(levels, self.normal)(wanted - beyond)
        mixed = interpolate.interp1d(LOSS_WEIGHTS, at_level, axis=1)(loss_weight)
        known = mixed @ _brightness_weights(estimate).T + beyond
        below, above, part = between_sizes(self.sizes, count)
        rows = np.arange(len(count))
        z = (1 - part) * known[below, rows] + part * known[above, rows]
        z = z[:, np.newaxis]
        mean = np.maximum(estimate, 0) + DARK
        root = 1 - variance / (9 * mean**2) + z * np.sqrt(variance) / (3 * mean)
        found = np.maximum(mean * np.maximum(root, 0) ** 3 - DARK, 0)
        return np.asarray(np.where(estimate < 0, estimate + z * np.sqrt(variance), found))


def _mixed(of_losses: Reals, loss_weight: float) -> Reals:
    """Mix the values of both losses, shape (loss, ...)."""
    return np.asarray((1 - loss_weight) * of_losses[0] + loss_weight * of_losses[1])


def _expected(weights: Reals, terms: Reals, loss_weight: float) -> Reals:
    """Return expected squared errors from weights (loss, term) and terms (loss, ..., term)."""
    return _mixed(np.stack([t @ w for t, w in zip(terms, weights, strict=True)]), loss_weight)


def least_squares(validation: Validation, loss: int) -> Reals:
    """Return the weights of the error terms by least squares, errors relative to the radiance."""
    estimate = validation["estimate"][loss]
    own = validation["mean"], validation["certainty"][loss], validation["variance"]
    terms = error_terms(estimate, *own).reshape(-1, ERROR_TERMS)
    # Unbiased: the noise of the target is subtracted.
    squared = (estimate - validation["target"]) ** 2 - validation["noise"]
    scale = 1 / terms[:, :4].sum(axis=1)
    # Normal equations: there are tens of thousands of rows, but only six weights.
    scaled = terms * scale[:, np.newaxis]
    gram = np.linalg.cholesky(scaled.T @ scaled + 1e-9 * np.eye(ERROR_TERMS) * len(scaled))
    target = scaled.T @ (squared.reshape(-1) * scale)
    weights, _ = optimize.nnls(gram.T, np.linalg.solve(gram, target))
    weights[0] = max(weights[0], 1e-4)
    return np.asarray(weights)


def calibrate(weights: Reals, held_out: Validation, everywhere: Validation) -> Reals:
    """Return the normal quantiles of the truth, shape (loss weight, brightness, level).

    They come from pixels that did not train. The difference between pixels of a brightness and all
    pixels, measured on all pixels, is added (Mondrian conformal prediction separates categories
    likewise: Vovk 2013, doi:10.1007/s10994-013-5355-6).
    """
    found = []
    for loss_weight in LOSS_WEIGHTS:
        outside = _quantiles(*_normals(weights, held_out, loss_weight)[:2])
        normal, share, near = _normals(weights, everywhere, loss_weight)
        usual, counts = _quantiles(normal, share), share @ near
        own = [
            _quantiles(normal, share * weight) if count > 0 else usual
            for weight, count in zip(near.T, counts, strict=True)
        ]
        known = counts / (counts + _FEW)
        found.append(outside + known[:, np.newaxis] * (np.array(own) - usual))
    return np.array(found)


def _quantiles(normal: Reals, share: Reals) -> Reals:
    """Return quantiles at `LEVELS`, each moved outwards by its sampling error.

    Otherwise, with few pixels, too many would lie farther out (Vovk 2013, as above). Without any
    pixel, they are those of a normal distribution.
    """
    if not len(normal):
        return np.asarray(special.ndtri(LEVELS))
    error = _CHANCE * np.sqrt(LEVELS * (1 - LEVELS) / share.sum())
    levels = np.clip(LEVELS + np.sign(LEVELS - 0.5) * error, 0, 1)
    return np.asarray(np.quantile(normal, levels, weights=share, method="inverted_cdf"))


def _normals(
    weights: Reals, validation: Validation, loss_weight: float
) -> tuple[Reals, Reals, Reals]:
    """Return normal scores of the targets, their weights, and how bright their estimates are.

    The cube root of a gamma variable is near normal (Wilson and Hilferty 1931,
    doi:10.1073/pnas.17.12.684).
    """
    estimate = _mixed(validation["estimate"], loss_weight)
    own = (validation[name] for name in ("estimate", "mean", "certainty", "variance"))
    variance = _expected(weights, error_terms(*own), loss_weight)
    truth, rows = validation["target"] + DARK, validation["rows"]
    mean = estimate + DARK
    usable = mean >= DARK
    mean = np.where(usable, mean, DARK)
    spread = np.sqrt(variance) / (3 * mean)
    normal = (np.cbrt(truth / mean) - 1 + spread**2) / spread
    share = usable / (np.bincount(rows)[rows] * estimate.shape[-1])[:, np.newaxis]
    near = _brightness_weights(estimate)[:, np.newaxis]
    near = np.broadcast_to(near, (*estimate.shape, len(BRIGHTNESS)))
    return normal[usable], share[usable], near[usable]


def _brightness_weights(estimate: Reals) -> Reals:
    """Return the weights of estimates (row, channel) at each of `BRIGHTNESS`; rows sum to 1."""
    octave = np.log2(np.maximum(estimate.mean(axis=-1), 1e-12))
    return np.stack(
        [np.interp(octave, BRIGHTNESS, level) for level in np.eye(len(BRIGHTNESS))], axis=-1
    )
