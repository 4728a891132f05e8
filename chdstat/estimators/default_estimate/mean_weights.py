"""Weight of the mean: how much of it a pixel keeps when another image is proposed.

A proposal is an image that is less noisy than the mean and may be biased, such as a weighted sum of
denoised images. `weight_of_mean` estimates which mixture of the two is nearest to the truth. It
compares the proposal from one half of the samples with the mean of the other half, which is noisy
but unbiased and independent (a super learner: van der Laan, Polley and Hubbard 2007,
doi:10.2202/1544-6115.1309).

Let p be the proposal from one half, d the mean of that half minus p, and t the mean of the other
half. The squared error of ``p + r d`` is least at ``r = -E d (p - t) / E d^2`` (Stein's loss: James
and Stein 1961). All samples have half the noise variance of one half, so half of the noise,
estimated from the difference of the halves, is subtracted from both expectations. The expectations
are averaged over similar pixels: first over the image in classes, then over wide and over close
surroundings in the same class. The classes are those of the pixel's standard score, of how far
`shared_shape` limits it, and of its brightness. Each step either confirms the weight of the
previous step or refutes it (a spike and a slab: George and McCulloch 1993,
doi:10.1080/01621459.1993.10476353). Evidence from few pixels needs to be stronger.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Indices, Reals

__all__ = ["Proposal", "weight_of_mean"]


_SCORES = np.array((-8, -4, -2.5, -1.5, -0.7, 0, 0.7, 1.5, 2.5, 4, 8))
"""Standard scores of the proposal against the mean; weights are interpolated between them."""
_LIMITED = np.array((-0.1, 0.5))
"""Logarithms of the ratio of the mean to the mean limited by `shared_shape`."""
_BRIGHT = np.array((0.5, 1.5))
"""Logarithms of a pixel's brightness over that of the image, reduced by its standard errors."""
_TAKEN_OFF = 3.0
"""Standard errors that are subtracted from the mean before a pixel counts as bright."""
_BELIEVED = (-3.0, -1.5), (-4.5, -2.5)
"""Scores between which the prior weight of the mean falls from 1 to 0: for pixels that
`shared_shape` does not limit, because many samples found their light, and for pixels that it
limits."""
_TILE = 8
"""Distance, in pixels, of the nodes at which evidence is collected."""
_AROUND = 6.0, 1.5
"""Standard deviations, in nodes, of the windows in which evidence is averaged."""
_REFUTED = 0.1
"""Prior probability that a step is refuted."""
_CONFIRMED, _FREE = 0.05, 0.5
"""Standard deviation of a weight around the previous step, if that is confirmed or refuted."""
_SINGLE = 0.5
"""Variance of a weight that rests on a single pixel."""
_FAINT = 0.03
"""Share of the image's mean radiance in the unit of a pixel's errors, besides its own."""
_ERROR = 1e-3
"""Share of that unit that is added to standard errors, so that scores are finite."""


@dataclass(frozen=True)
class Proposal:
    """An image that is proposed instead of the mean of the same samples.

    Attributes
    ----------
    image
        The proposal, shape (y, x, channel).
    mean, error
        Mean of the same samples and its standard error, shape (y, x, channel).
    limited
        The mean limited by `shared_shape`, shape (y, x, channel).
    """

    image: Reals
    mean: Reals
    error: Reals
    limited: Reals

    def unit(self) -> Reals:
        """Return the radiance that errors are measured in, shape (y, x)."""
        bright = np.abs(self.image).mean(axis=-1)
        around = ndimage.gaussian_filter(bright, 1.5, mode="nearest")
        # A denoised image of negative radiance may be 0.
        usual = max(np.mean(x, dtype=np.float64) for x in (bright, 1e-3 * np.abs(self.mean)))
        return np.asarray(around + (_FAINT * float(usual) or 1.0))

    def classes(self) -> list[tuple[Reals, Reals]]:
        """Return the quantities that classify pixels, each with its knots of interpolation."""
        unit = self.unit()
        apart = (self.image - self.mean) / (self.error + _ERROR * unit[..., np.newaxis])
        mean, limited = (
            np.maximum(image.mean(axis=-1), 0) + 0.01 * unit for image in (self.mean, self.limited)
        )
        # With few bright samples among dark ones, the standard error is as large as the mean.
        light, error = (np.abs(image).mean(axis=-1) for image in (self.mean, self.error))
        known = 1 - _TAKEN_OFF * error / np.maximum(light, 1e-30)
        return [
            (_signed_log(apart.mean(axis=-1)), _signed_log(_SCORES)),
            (np.log(mean / limited), _LIMITED),
            (np.log(unit * np.clip(known, 1e-3, 1) / unit.mean()), _BRIGHT),
        ]


def weight_of_mean(whole: Proposal, one: Proposal, other: Proposal) -> Reals:
    """Return the weight of the mean in each pixel.

    Parameters
    ----------
    whole
        The proposal from all samples.
    one, other
        The proposals from one half of the samples and from the other. Both use the same weights of
        candidates, which may depend on all samples, but hardly on those of a single pixel.

    Returns
    -------
    ndarray
        Weights from 0 (the proposal) to 1 (the mean), shape (y, x).

    References
    ----------
    M. J. van der Laan, E. C. Polley and A. E. Hubbard, "Super learner", Statistical Applications in
    Genetics and Molecular Biology 6(1), 2007, doi:10.2202/1544-6115.1309. E. I. George and R. E.
    McCulloch, "Variable selection via Gibbs sampling", Journal of the American Statistical
    Association 88, 1993, doi:10.1080/01621459.1993.10476353.

    Examples
    --------
    A noisy mean is worse than a proposal that is right everywhere, and better than a wrong one:

    >>> rng = np.random.default_rng(0)
    >>> halves = 1 + rng.normal(size=(2, 32, 32, 1)) / 8
    >>> def proposed(mean, image):
    ...     return Proposal(np.full_like(mean, image), mean, np.full_like(mean, 1 / 8), mean)
    >>> for image in (1, 2):
    ...     parts = [proposed(mean, image) for mean in (halves.mean(axis=0), *halves)]
    ...     print(weight_of_mean(*parts).mean().round(1))
    0.0
    1.0
    """
    sides = _sides(whole.mean.shape[:2])
    knots = [len(places) for _, places in whole.classes()]
    shape = (*(size for _, _, size in sides), *knots)
    evidence = np.zeros((5, int(np.prod(shape))))
    for half, held_out in ((one, other), (other, one)):
        terms = _evidence(half, held_out)
        for place, share in _corners(half, sides):
            for total, values in zip(evidence, terms, strict=True):
                total += np.bincount(place.ravel(), (share * values).ravel(), len(total))
    evidence = evidence.reshape(5, *shape)
    weight = np.broadcast_to(_updated(_believed(knots), evidence.sum(axis=(1, 2))), shape)
    for scale in _AROUND:
        spread = (0, scale, scale, *[0] * len(knots))
        around = ndimage.gaussian_filter(evidence, spread, mode="nearest", truncate=3)
        # The total weight of a window is the number of nodes in it.
        weight = _at_nodes(weight, around * (4 * np.pi * scale * scale))
    nodes = _at_nodes(weight, evidence).ravel()
    return np.asarray(sum(share * nodes[place] for place, share in _corners(whole, sides)))


def _evidence(half: Proposal, held_out: Proposal) -> list[Reals]:
    """Compare the proposal of one half with the mean of the other, pixel by pixel.

    Returns the terms n of E d^2 and c of -E d (p - t), without half of their noise, and the
    products for the variance of c - r n.
    """
    unit = half.unit()[..., np.newaxis]
    apart = (half.mean - half.image) / unit
    noise = apart - (held_out.mean - held_out.image) / unit
    missed = (half.image - held_out.mean) / unit
    moved = (half.image - held_out.image) / unit
    n = (apart**2 - noise**2 / 4).sum(axis=-1)
    c = (noise * moved / 4 - apart * missed).sum(axis=-1)
    return [n, c, c * c, c * n, n * n]


def _at_nodes(before: Reals, evidence: Reals) -> Reals:
    """Return the weights of nodes (y, x, score, limited, bright) after their evidence.

    First, the pixels that are not limited are pooled over all scores. Otherwise the few pixels of a
    lamp would be spread over so many classes that none has enough evidence.
    """
    together = evidence.sum(axis=-3, keepdims=True)[..., :1, :]
    not_limited = _updated(before[..., :1, :], together)
    weight = np.concatenate([not_limited, before[..., 1:, :]], axis=-2)
    return _updated(weight, evidence)


def _updated(before: Reals, evidence: Reals) -> Reals:
    """Return weights updated by evidence, which confirms or refutes the weights before."""
    n, c, cc, cn, nn = evidence
    known = n > 1e-12
    n = np.where(known, n, 1)
    found = np.clip(c / n, -0.2, 1.2)
    kept = np.clip(found, 0, 1)
    variance = (np.maximum(cc - 2 * kept * cn + kept**2 * nn, 0) + _SINGLE * nn) / n**2 + 1e-9
    apart = found - before
    free, confirmed = _FREE**2, _CONFIRMED**2
    odds = apart**2 / 2 * (1 / (variance + confirmed) - 1 / (variance + free))
    odds -= np.log((variance + free) / (variance + confirmed)) / 2
    refuted = 1 / (1 + (1 / _REFUTED - 1) * np.exp(-np.clip(odds, -50, 50)))
    step = refuted * free / (free + variance) + (1 - refuted) * confirmed / (confirmed + variance)
    return np.asarray(np.where(known, np.clip(before + step * apart, 0, 1), before))


def _believed(knots: list[int]) -> Reals:
    """Return the weight of the mean in each class before any evidence.

    k samples of equal radiance among nulls give the score -sqrt(k). Bright pixels that are not
    limited are few but make up most of an image's error: they keep their mean until held-out
    samples show that the proposal is nearer.
    """
    weight = np.empty(knots)
    for i, (most, least) in enumerate(_BELIEVED):
        t = np.clip((_SCORES - most) / (least - most), 0, 1)
        weight[:, i] = (1 - t * t * (3 - 2 * t))[:, np.newaxis]
    weight[:, 0, 1] = 1
    return weight


def _sides(shape: tuple[int, ...]) -> list[tuple[Indices, Reals, int]]:
    """Return the node before each row and column, the fraction beyond it, and the node count."""
    found = []
    for axis, pixels in enumerate(shape):
        nodes = -(-pixels // _TILE) + 1
        place = (np.arange(pixels) + 0.5) / pixels * (nodes - 1)
        side = np.expand_dims(place, 1 - axis)
        found.append((*_between(side, np.arange(nodes)), nodes))
    return found


def _between(x: Reals, knots: npt.NDArray[Any]) -> tuple[Indices, Reals]:
    """Return the knot before each number, and the fraction of the way to the next knot."""
    x = np.clip(x, knots[0], knots[-1])
    before = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    return before, (x - knots[before]) / (knots[before + 1] - knots[before])


def _corners(
    pixels: Proposal, sides: list[tuple[Indices, Reals, int]]
) -> Iterator[tuple[Indices, Reals]]:
    """Yield one corner of each pixel's cell at a time: the node, and its interpolation weight."""
    axes = [*sides, *((*_between(x, knots), len(knots)) for x, knots in pixels.classes())]
    shape = pixels.mean.shape[:2]
    for steps in itertools.product((0, 1), repeat=len(axes)):
        place, share = np.zeros(shape, np.intp), np.ones(shape)
        for step, (before, passed, size) in zip(steps, axes, strict=True):
            place = place * size + before + step
            share = share * (passed if step else 1 - passed)
        yield place, share


def _signed_log(x: Reals) -> Reals:
    return np.asarray(np.sign(x) * np.log1p(np.abs(x)))
