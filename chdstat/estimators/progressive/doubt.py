"""Doubt: how much of what an estimator proposes pays on the picture at hand, without a reference.

The samples of every pixel are cut in two halves. From one come the mean m and the estimate g; the
mean t of the other is independent of both and unbiased. So the share of the move from m to g that
has the least squared error against t,

    alpha = sum w (t - m) (g - m) / sum w (g - m)^2,

is also that with the least expected error against the truth, as in the cross-validated combination
of estimators (Stein 1956's shrinkage with a known target; Rousselle et al. 2012,
doi:10.1145/2366145.2366214, choose between filters by the two halves alike).

It is measured at half the samples, where the mean is worse and trust is larger. That is safe: with
an estimate g = y + b of constant bias b and a mean of variance v at all samples,
alpha = 2 v / (2 v + b^2), and the mixture has the squared error v (1 - 4 / (b^2 / v + 2)^2) < v.
What remains is the noise of alpha over the pixels: one standard error is taken off, so that what
only seems to pay is left alone (the rule of Breiman et al. 1984, doi:10.1201/9781315139470).

A network that was trained on the picture at hand is doubted likewise, on pixels that did not train
it. There the errors are its own, and the presumption is for it: `warranted_share`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.progressive.bounds import ratio
from chdstat.estimators.progressive.network import Answer, Network, Sight
from chdstat.estimators.progressive.training import FLOOR
from chdstat.estimators.progressive.trials import Trial

__all__ = ["Doubted", "paying_share", "warranted_share"]

_GUARDED = (0.5, 0.75)
"""Powers of the weights of the errors that a trained network shall not make worse: those of its
loss, since at 0 and 1 few bright or many dark pixels decide, and the measurement is all noise."""
_LEAST = 0.2
"""Share below which hardly anything is gained."""
_SAME = 1e-6
"""Relative difference below which an estimate is the mean, summed in another order."""

Array = npt.NDArray[Any]


class Doubted(nn.Module):
    """A network whose proposals are believed in part; its certainty falls likewise.

    Parameters
    ----------
    network
        The network.
    share
        How far to move from the mean to its estimate, 0 to 1.
    """

    def __init__(self, network: Network, share: float) -> None:
        super().__init__()
        self.network = network
        self.share = share
        self.shape = network.shape

    def forward(self, sight: Sight) -> Answer:
        """Estimate under every aim."""
        found = self.network(sight)
        mean = found.mean[:, None].expand_as(found.estimate)
        estimate = torch.lerp(mean, found.estimate, self.share)
        return Answer(estimate, found.mean, found.certainty * self.share)


def paying_share(
    samples: Array,
    estimate: Callable[..., Array],
    *,
    powers: Sequence[float],
    floor: float,
    unit: float,
    direct: Array | None = None,
) -> float:
    """Return the share of the move from the mean to the estimate that pays, 0 to 1.

    Both halves take either part, and all pixels and channels add up to one share. Pixels weigh
    ``1 / (s^2 + floor)^power``, as errors do with the truth for s. Here s is the mean of a quarter
    of the samples that neither the estimate nor its target has seen, so that the share is unbiased:
    weights that knew the mean would count pixels more where it is too dark by chance, and there
    every brighter estimate seems to pay. One standard error over pixels is taken off.

    Parameters
    ----------
    samples
        Shape (..., channel, sample), at least 2.
    estimate
        Returns radiance (..., channel) from some of the samples, and their direct part where there
        is one.
    powers
        The errors to guard, 0 for the squared and 1 for the relative one: of several shares, the
        smallest pays under each.
    floor
        Of squared radiance, in squared units of `unit`.
    unit
        Mean radiance of the picture.
    direct
        Direct part of the samples, of the same shape; None where `estimate` does not ask for it.
    """
    halves = samples[..., 0::2], samples[..., 1::2]
    parts = ((), ()) if direct is None else ((direct[..., 0::2],), (direct[..., 1::2],))
    means = [mean_of_good(half).astype(np.float64) / unit for half in halves]
    found = [
        estimate(half, *part).astype(np.float64) / unit
        for half, part in zip(halves, parts, strict=True)
    ]
    targets = [_targets(half) / unit for half in halves]
    shares = []
    for power in powers:
        sums = [
            _sums(mean, one, target, weighing, power, floor)
            for mean, one, (first, second) in zip(means, found, targets[::-1], strict=True)
            for target, weighing in ((first, second), (second, first))
        ]
        shares.append(_share(*(sum(parts) for parts in zip(*sums, strict=True))))
    return min(shares)


def _targets(half: Array) -> npt.NDArray[np.float64]:
    """Return the means of two parts of a half, which is both of them where it is one sample."""
    parts = (half[..., 0::2], half[..., 1::2]) if half.shape[-1] > 1 else (half, half)
    return np.stack([mean_of_good(part) for part in parts]).astype(np.float64)


def warranted_share(trials: Sequence[Trial]) -> float:
    r"""Return how far to believe a network that trained on other pixels of the picture, 0 to 1.

    A network that has learned well has an alpha of 1, as its errors are uncorrelated with its
    moves, but the alpha that is measured is noisy where bright samples are rare. Moving by a share
    a from the mean lessens the error if ``a < 2 alpha``. So with the standard error s over pixels,

    .. math:: a = \operatorname{clip}(\min(\alpha + s, 2 (\alpha - s)), 0, 1)

    is the largest share that the measurement does not speak against and that is better than the
    mean, one standard error off. It is the smallest one for several weights of the errors, and 0
    where little is left of it.

    Parameters
    ----------
    trials
        Of pixels that did not train it.
    """
    share = min(_warranted(trials, power) for power in _GUARDED)
    return share if share >= _LEAST else 0.0


def _warranted(trials: Sequence[Trial], power: float) -> float:
    sums = [
        _sums(mean, found, trial.target, np.minimum(found, mean), power, FLOOR)
        for trial in trials
        for mean, found in [(trial.mean, trial.estimate.mean(axis=0))]
    ]
    rows = np.concatenate([trial.rows for trial in trials])
    along, across = (np.bincount(rows, np.concatenate(parts)) for parts in zip(*sums, strict=True))
    share, error = ratio(along, across)
    return float(np.clip(min(share + error, 2 * (share - error)), 0, 1))


def _sums(
    mean: Array, found: Array, target: Array, weighing: Array, power: float, floor: float
) -> tuple[Any, Any]:
    """Return numerator and denominator of the share, one of each a pixel."""
    weight = (weighing**2 + floor) ** -power
    move = np.where(np.abs(found - mean) <= _SAME * mean, 0, found - mean)
    along, across = weight * move * (target - mean), weight * move**2
    usable = np.isfinite(along) & np.isfinite(across)
    return np.where(usable, along, 0).sum(axis=-1), np.where(usable, across, 0).sum(axis=-1)


def _share(along: Any, across: Any) -> float:
    share, error = ratio(np.ravel(along), np.ravel(across))
    return float(np.clip(share - error, 0, 1))
