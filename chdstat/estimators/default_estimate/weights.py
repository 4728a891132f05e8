r"""Weights: how much of its mean each pixel and channel keeps when another image is proposed.

A proposal is an image that is less noisy than the mean and may be biased, such as a weighted sum of
denoised images. If its error has the variance v, and the mean's has s^2, then the best mixture
gives the mean the weight

.. math:: r = v / (v + s^2)

(Stein's estimate for unequal variances: Efron and Morris 1973, doi:10.1080/01621459.1973.10481350;
Xie, Kou and Brown 2012, doi:10.1080/01621459.2012.728154). So a pixel that is known well keeps what
it knows, whatever is proposed, and a noisy one follows the proposal. Neither variance is known, but
held-out samples tell the ratio. Let p be the proposal from one half of the samples, d the mean of
that half minus p, and t the mean of the other half. Then

.. math:: v + s^2 = E d^2, \qquad v = E d (t - p)

(a super learner: van der Laan, Polley and Hubbard 2007, doi:10.2202/1544-6115.1309). The noise of t
is in the second expectation only, and there only once: squares of it, which a few rare samples
decide, would hide what the halves say. All samples have half the noise of one half (`_of_all`).

The expectations are averaged over pixels that are alike: of the same channel, noise, brightness,
and score of the proposal (`_BilateralGrid`). First over the image, then over wide and over close
surroundings. Each step either confirms the weight of the previous step or refutes it (a spike and a
slab: George and McCulloch 1993, doi:10.1080/01621459.1993.10476353). Evidence from few pixels needs
to be stronger.

A pixel that has not met the rare light of its place looks quiet, too, and must not keep its dark
mean. So the noise has two parts: the pixel's own, and that around it. Pixels whose own is small and
whose neighbours' is large are a class, of which the other half of the samples tells how many are
dark by chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from chdstat._core.arrays import Floats, Indices, Mask, Reals, spans

_SCORES = np.array((-6.0, -1.5, 1.5, 6.0))
"""Standard scores of the proposal against the mean."""
_NOISE = np.array((0.0025, 0.01, 0.04, 0.16, 0.64, 2.5))
"""Noise of the mean of a pixel's samples, in units of the radiance around it."""
_LOUDER = np.array((1.0, 7.4))
"""Noise around a pixel over its own."""
_BRIGHT = np.array((1.6, 4.5))
"""Brightness over that of the image, reduced by standard errors."""
_TAKEN_OFF = 3.0
"""Standard errors that are subtracted from the mean before a pixel counts as bright."""
_NEIGHBOURS, _AT_LEAST = 3, 4
"""Edge of the window whose noise is around a pixel, and how many of its pixels have that noise at
least: a straight border beside loud pixels has three."""
_UNSTEADY = 4
"""Power of the relative error of a pixel that counts as its noise, too: one sample among nulls has
the relative error 1, and a small sample says as little of the pixel as a large one."""
_EXPECTED, _EXPECTED_BRIGHT = 0.05, 1.0
"""Error of a proposal before any evidence, in units of the radiance: of most pixels, and of bright
ones, which are few but make up most of an image's error."""
_BELIEVED = -4.5, -2.5
"""Scores between which the weight of the mean before any evidence falls from 1."""
_TILE = 8
"""Distance, in pixels, of the nodes at which evidence is collected."""
_WIDE, _CLASSES_OF_NOISE = 32, 2
"""Distance, in pixels, of the nodes of groups, and their classes: the noise, and that around."""
_AROUND = 6.0, 1.5
"""Standard deviations, in nodes, of the windows in which evidence is averaged."""
_REFUTED = 0.1
"""Prior probability that a step is refuted."""
_CONFIRMED, _FREE = 0.05, 0.5
"""Standard deviation of a weight around the previous step, if that is confirmed or refuted."""
_SINGLE = 0.5
"""Variance of a weight that rests on a single pixel."""
_FALLS = 0.75
"""Squared bias of a proposal from all samples over that from half of them."""
_CLASS = 3
"""Axis of a grid at which the classes begin, after the channel and the place."""
_NEARER = 0.5
"""Fraction of the way from one node to the next from which the next is nearer."""
_BAND = 2**15
"""Values that are pooled at once: as many stay in the cache of a processor."""
_FAINT = 0.03
"""Share of the image's mean radiance in the unit of a pixel's errors, besides its own."""
_LEAST = 1e-3
"""Least noise of a pixel, in that unit, so that scores are finite."""


@dataclass(frozen=True)
class Proposal:
    """An image that is proposed instead of the mean of the same samples.

    Attributes
    ----------
    image
        The proposal, shape (y, x, channel).
    mean, error
        Mean of the same samples and its standard error, shape (y, x, channel).
    """

    image: Reals
    mean: Reals
    error: Reals

    @cached_property
    def unit(self) -> Reals:
        """Radiance that errors are measured in, shape (y, x, channel)."""
        bright = np.abs(self.image)
        around = ndimage.gaussian_filter(bright, (1.5, 1.5, 0), mode="nearest")
        # A denoised image of negative radiance may be 0.
        usual = max(np.mean(x, dtype=np.float64) for x in (bright, 1e-3 * np.abs(self.mean)))
        return np.asarray(around + (_FAINT * float(usual) or 1.0))

    @cached_property
    def noise(self) -> Reals:
        """Standard error of the mean, as far as the pixel itself can tell it."""
        mean = np.abs(self.mean)
        relative = np.where(mean > 0, np.minimum(self.error / np.maximum(mean, 1e-30), 1), 1)
        least = np.maximum(relative**_UNSTEADY, _LEAST) * self.unit
        return np.asarray(np.maximum(self.error, least))

    @cached_property
    def around(self) -> Reals:
        """Standard error of the mean that several pixels around have at least."""
        size = (_NEIGHBOURS, _NEIGHBOURS, 1)
        return np.asarray(ndimage.rank_filter(self.error, -_AT_LEAST, size, mode="nearest"))

    @cached_property
    def known(self) -> Mask:
        """Whether the samples of a pixel and channel are all the same, and not null."""
        return np.asarray((self.error == 0) & (self.mean != 0))

    @cached_property
    def groups(self) -> _BilateralGrid:
        """Groups of pixels of the same channel, place and noise, over which sums are certain."""
        return _BilateralGrid(self, _WIDE, _CLASSES_OF_NOISE)

    def classes(self) -> list[tuple[Reals, Floats]]:
        """Return the quantities that classify pixels, each with its nodes: noise comes first."""
        # With few bright samples among dark ones, the standard error is as large as the mean.
        certain = 1 - _TAKEN_OFF * self.error / np.maximum(np.abs(self.mean), 1e-30)
        bright = self.unit * np.clip(certain, 1e-3, 1) / self.unit.mean(axis=(0, 1))
        score = (self.image - self.mean) / self.noise
        return [
            (np.log(self.noise / self.unit), np.log(_NOISE)),
            (np.log(np.maximum(self.around / self.noise, 1)), np.log(_LOUDER)),
            (_signed_log(score), _signed_log(_SCORES)),
            (np.log(bright), np.log(_BRIGHT)),
        ]


class _BilateralGrid:
    """Nodes at which pixels that are alike are pooled: by channel, place, and classes.

    `sums` splats images into such a grid, and `at` slices it (Chen, Paris and Durand 2007,
    "Real-time edge-aware image processing with the bilateral grid", doi:10.1145/1276377.1276506).

    Parameters
    ----------
    pixels
        What classifies the pixels.
    tile
        Distance of the nodes in pixels.
    number
        How many of the classes count.

    Attributes
    ----------
    shape, classes
        Number of nodes: (channel, y, x, class, ...), and of those of the classes.
    """

    def __init__(self, pixels: Proposal, tile: int, number: int | None = None) -> None:
        height, width, channels = pixels.image.shape
        self._axes: list[tuple[Indices, Reals, int]] = [
            (np.arange(channels).reshape(1, 1, -1), np.zeros((1, 1, 1), np.float32), channels)
        ]
        for i, length in enumerate((height, width)):
            nodes = -(-length // tile) + 1
            place = (np.arange(length) + 0.5) / length * (nodes - 1)
            along = np.expand_dims(place, [axis for axis in range(3) if axis != i])
            self._axes.append((*_between(along, np.arange(nodes)), nodes))
        for x, knots in pixels.classes()[:number]:
            self._axes.append((*_between(x, knots), len(knots)))
        self.shape = tuple(size for *_, size in self._axes)
        self.classes = self.shape[_CLASS:]
        self._pixels = pixels.image.shape

    @cached_property
    def nearest(self) -> Indices:
        """Number of the classes that each pixel is nearest to, shape (y, x, channel)."""
        node = np.zeros(self._pixels, np.int16)
        for before, passed, size in self._axes[_CLASS:]:
            node = node * size + before + (passed > _NEARER)
        return node

    def sums(self, *images: Reals, dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Return sums of images (y, x, channel) over the pixels around each node, by their shares.

        Of two classes, a pixel belongs to the nearer one.
        """
        size = int(np.prod(self.shape))
        found = np.zeros((len(images), size), dtype)
        # A band of fewer values than there are nodes would mostly add zeros.
        for rows, node, share in self._corners(max(size, _BAND), nodes=3):
            for total, image in zip(found, images, strict=True):
                total += np.bincount(node.ravel(), (share * image[rows]).ravel(), size)
        return found.reshape(len(images), *self.shape)

    def at(self, nodes: Reals) -> Reals:
        """Return the values of nodes, interpolated at each pixel, shape (y, x, channel)."""
        values = np.broadcast_to(nodes, self.shape).astype(np.float32).ravel()
        found = np.zeros(self._pixels, np.float32)
        for rows, node, share in self._corners(_BAND, nodes=2):
            found[rows] += share * values[node]
        return found

    def _corners(self, band: int, nodes: int) -> Iterator[tuple[slice, Indices, Reals]]:
        """Yield one corner of each pixel's cell at a time: the node, and its share.

        Rows come in bands of so many values, which keep the arrays small. Along an axis of fewer
        nodes, a pixel is at the nearest.
        """
        height, width, channels = self._pixels
        for rows in spans(height, max(1, band // (width * channels))):
            axes = [
                (_rows(before, rows), _rows(passed, rows), size)
                for before, passed, size in self._axes
            ]
            shape = (len(range(height)[rows]), width, channels)
            start = np.zeros(shape, np.int32), np.ones((1, 1, 1), np.float32)
            for node, share in _beside(*start, axes, nodes):
                yield rows, node, share


def _rows(x: npt.NDArray[Any], rows: slice) -> npt.NDArray[Any]:
    """Return some rows of an array that may be the same for all rows."""
    return x[rows] if len(x) > 1 else x


def _beside(
    node: Indices, share: Reals, axes: Sequence[tuple[Indices, Reals, int]], nodes: int
) -> Iterator[tuple[Indices, Reals]]:
    """Yield the nodes beside each pixel along the axes, and their shares."""
    if not axes:
        yield node, share
        return
    (before, passed, size), *others = axes
    node = node * size + before
    if size >= nodes and passed.any():
        yield from _beside(node, share * (1 - passed), others, nodes)
        yield from _beside(node + 1, share * passed, others, nodes)
    else:
        yield from _beside(node + (passed > _NEARER), share, others, nodes)


def weight_of_mean(whole: Proposal, one: Proposal, other: Proposal) -> Iterator[Reals]:
    """Yield the weights of the mean of all samples, of one half of them, and of the other half.

    Parameters
    ----------
    whole
        The proposal from all samples.
    one, other
        The proposals from one half of the samples and from the other. Both use the same weights of
        candidates, which may depend on all samples, but hardly on those of a single pixel.

    Yields
    ------
    ndarray
        Weights from 0 (the proposal) to 1 (the mean), shape (y, x, channel).

    References
    ----------
    X. Xie, S. C. Kou and L. D. Brown, "SURE estimates for a heteroscedastic hierarchical model",
    Journal of the American Statistical Association 107, 2012, doi:10.1080/01621459.2012.728154.
    M. J. van der Laan, E. C. Polley and A. E. Hubbard, "Super learner", Statistical Applications in
    Genetics and Molecular Biology 6(1), 2007, doi:10.2202/1544-6115.1309.

    Examples
    --------
    A denoiser has removed a texture, which both halves of the samples show, from the left half of
    an image, where there is little noise. On the right there is no texture, and much noise:

    >>> rng = np.random.default_rng(0)
    >>> noise = np.where(np.arange(64) < 32, 0.05, 1.0)[:, np.newaxis] * np.ones((64, 64, 1))
    >>> texture = rng.choice((-0.3, 0.3), (64, 64, 1)) * (noise < 0.1)
    >>> halves = [1 + texture + noise * rng.normal(size=(64, 64, 1)) for _ in range(2)]
    >>> means = [sum(halves) / 2, *halves]
    >>> errors = [noise / np.sqrt(2), noise, noise]
    >>> parts = [Proposal(np.ones((64, 64, 1)), m, e) for m, e in zip(means, errors)]
    >>> weights, *_ = weight_of_mean(*parts)
    >>> print(weights[:, :28].mean().round(1), weights[:, 36:].mean().round(1))
    1.0 0.0
    """
    halves = _BilateralGrid(one, _TILE), _BilateralGrid(other, _TILE)
    evidence = halves[0].sums(*_evidence(one, other), dtype=np.float32)
    evidence += halves[1].sums(*_evidence(other, one), dtype=np.float32)
    weight = _updated(_believed(), evidence.sum(axis=(2, 3), keepdims=True))
    scales = [0.0] * len(halves[0].classes)
    for scale in _AROUND:
        around = ndimage.gaussian_filter(
            evidence, (0, 0, scale, scale, *scales), mode="nearest", truncate=3
        )
        # The total weight of a window is the number of nodes in it.
        weight = _updated(weight, around * (4 * np.pi * scale * scale))
    weight = _updated(weight, evidence)
    wide = ndimage.gaussian_filter(
        evidence[[0, 5]], (0, 0, _AROUND[0], _AROUND[0], *scales), mode="nearest", truncate=3
    )
    share = np.minimum(wide[1] / np.maximum(wide[0], 1e-30), weight)
    of_all = _of_all(weight, share)
    del evidence, around, wide, share
    yield np.where(whole.known, 1, _BilateralGrid(whole, _TILE).at(of_all))
    for half, grid in zip((one, other), halves, strict=True):
        yield np.where(half.known, 1, grid.at(weight))


def _of_all(weight: Reals, noise: Reals) -> Reals:
    """Return weights for all samples from those for a half of them.

    `noise` is the share that the proposal's own noise has in ``E d^2``. It halves, as s^2 does.
    """
    error = _FALLS * (weight - noise / 2)
    return error / np.maximum(error + (1 - weight) / 2, 1e-30)


def _evidence(half: Proposal, held_out: Proposal) -> list[Reals]:
    """Compare the proposal of one half with the mean of the other, pixel by pixel.

    Returns the terms n of E d^2 and c of E d (t - p), the products for the variance of c - r n,
    and the noise of the proposal.
    """
    unit = half.unit
    apart = (half.mean - half.image) / unit
    n = apart**2
    c = apart * (held_out.mean - half.image) / unit
    return [n, c, c * c, c * n, n * n, np.square((half.image - held_out.image) / unit) / 2]


def _updated(before: Reals, evidence: Reals) -> Reals:
    """Return weights updated by evidence, which confirms or refutes the weights before."""
    n, c, cc, cn, nn, _ = evidence
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


def _believed() -> Reals:
    """Return the weight of the mean in each class before any evidence, shape (noise, 1, score, 2).

    A pixel keeps what it knows better than a proposal usually is, and what the proposal is many
    standard errors below: k samples of equal radiance among nulls give the score -sqrt(k).
    """
    noise, score = _NOISE[:, np.newaxis, np.newaxis], _SCORES[:, np.newaxis]
    error = np.array((_EXPECTED, _EXPECTED_BRIGHT))
    most, least = _BELIEVED
    t = np.clip((score - most) / (least - most), 0, 1)
    weight = np.maximum(1 - t * t * (3 - 2 * t), error**2 / (error**2 + noise**2))
    return np.asarray(weight[:, np.newaxis])


def _between(x: Reals, knots: Reals) -> tuple[Indices, Reals]:
    """Return the knot before each number, and the fraction of the way to the next knot."""
    x = np.clip(x, knots[0], knots[-1])
    before = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    passed = (x - knots[before]) / (knots[before + 1] - knots[before])
    return before.astype(np.int16), passed.astype(np.float32)


def _signed_log(x: Reals) -> Reals:
    return np.asarray(np.sign(x) * np.log1p(np.abs(x)))
