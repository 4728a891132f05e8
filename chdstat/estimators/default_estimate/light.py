"""Lost light: the light by which the mean of an image exceeds its estimate.

Denoisers and limits of fireflies take rare bright samples away, and with them light that belongs to
the image. A single pixel cannot tell how much it lost. Many pixels together can, since their sum is
known from their samples. `lost_light` gives it back.

Nobody should get light that others lost. So pixels are grouped by channel, by their noise and the
noise around them, and by place. The group of a pixel follows from one half of the samples, and what
it lacks from the mean of the other half: otherwise pixels that look dark would lack nothing, and
those that look bright too much. Calm pixels lack nothing, as their own sum says.

If all pixels of a group lack light in proportion to radiance, each gets its part. Otherwise some of
them lost more than others, and nothing tells which. Then a pixel gets no more than a fraction of
its standard error, in proportion to it: that changes a pixel that is known well by little. The
squares of what blocks of pixels lack, without the noise of their sums, tell how alike they are.

Rates of places are shrunk towards that of the image, and that towards 0, by their noise (James and
Stein 1961; for rates of regions: Marshall 1991, "Mapping disease and mortality rates using
empirical Bayes estimators", doi:10.2307/2347593).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from chdstat._core.arrays import Floats, Indices, Reals, block_sums
from chdstat.estimators.default_estimate.weights import Proposal

_OF_IMAGE, _OF_PLACE = 2.0, 4.0
"""Variances of a rate that may be noise: of the image's, and of what a place's differs in."""
_MOST = 0.25
"""Most light that a pixel gets, in standard errors of its mean, unless its group lacks alike."""
_FARTHEST = 2.0
"""Most light that a pixel gets if its group lacks alike, in standard errors of its mean."""
_ALIKE = 0.7
"""Part of the squares of what blocks lack that one rate explains, from which a group is alike."""
_EDGES = 1, 2, 4, 8, 16
"""Edges of these blocks in pixels, each twice the one before."""


def lost_light(
    proposals: Sequence[Proposal], estimates: Sequence[Reals], moved: Sequence[Reals]
) -> tuple[Sequence[Reals], Reals]:
    """Return the light that each pixel gets back, and how far that may be from what is lost.

    Parameters
    ----------
    proposals
        Proposals of all samples, of one half of them and of the other.
    estimates
        Estimates of the same, shape (y, x, channel).
    moved
        Weights of the proposals beside the means, from 0 to 1. A pixel of weight 0 stays its mean
        and has lost nothing.

    Returns
    -------
    given
        The light of all samples, of one half, and of the other, shape (y, x, channel) each.
    error
        How far the first of these may be from what is lost: its standard error, and what a place
        lacks and nobody gets.

    Examples
    --------
    An estimate that is too dark by .3 everywhere gets that back. One that lacks as much in a corner
    gets hardly anything:

    >>> image, corner = 0.7 * np.ones((64, 64, 1)), np.zeros((64, 64, 1))
    >>> corner[:8, :8] = 0.3 * 64
    >>> for lost in (0.3, corner):
    ...     parts = [Proposal(image, image + lost, 0.1 * image) for _ in range(3)]
    ...     given, _ = lost_light(parts, [image] * 3, [np.ones_like(image)] * 3)
    ...     print(given[0].mean().round(2))
    0.3
    0.01
    """
    whole, *halves = proposals
    groups = [proposal.groups for proposal in proposals]
    # What a pixel may get if its group lacks alike, what it may get otherwise, and all its light.
    shares = [
        [part * np.minimum(np.abs(image), most * proposal.noise) for most in (_FARTHEST, 1, np.inf)]
        for proposal, image, part in zip(proposals, estimates, moved, strict=True)
    ]
    lacking = [
        _lacking(image, held_out, share[0])
        for image, held_out, share in zip(estimates[1:], halves[::-1], shares[1:], strict=True)
    ]
    found = [
        grid.sums(*lack, *share)
        for grid, lack, share in zip(groups[1:], lacking, shares[1:], strict=True)
    ]
    of_places = _joined(*found)
    of_image = _joined(*(sums.sum(axis=(2, 3), keepdims=True) for sums in found))
    rate = _shrunk(0.0, of_image[:3], _OF_IMAGE)
    most = _shrunk(0.0, of_image[[0, 1, 3]], _OF_IMAGE)
    most = np.clip(_shrunk(most, of_places[[0, 1, 3]], _OF_PLACE), -_MOST, _MOST)
    known = [
        (grid.nearest, *lack, share[0])
        for grid, lack, share in zip(groups[1:], lacking, shares[1:], strict=True)
    ]
    alike = np.clip((_explained(rate, known) - _ALIKE) / (1 - _ALIKE), 0, 1)
    given = [
        grid.at(alike * rate) * light + grid.at((1 - alike) * most) * uncertain
        for grid, (light, uncertain, _) in zip(groups, shares, strict=True)
    ]
    # Halves lose more than all samples do: no channel gets more than it lacks.
    lost = (whole.mean - estimates[0]).sum(axis=(0, 1))
    back = given[0].sum(axis=(0, 1))
    kept = np.clip(np.divide(lost, back, out=np.zeros_like(back), where=back != 0), 0, 1)
    given = [kept * image for image in given]
    # What a place lacks and nobody gets is missing somewhere in it.
    all_light = shares[0][2]
    lacked = groups[0].at(_shrunk(0.0, of_places[[0, 1, 4]], _OF_PLACE)) * all_light
    of_place = groups[0].at(np.sqrt(of_places[1]) / np.maximum(of_places[4], 1e-30))
    return given, np.hypot(of_place * all_light, lacked - given[0])


def _lacking(estimate: Reals, held_out: Proposal, light: Reals) -> tuple[Reals, Reals]:
    """Return what each pixel lacks according to other samples, and its variance."""
    moved = light > 0
    lacking = np.where(moved, held_out.mean - estimate, 0)
    return lacking, np.where(moved, np.square(held_out.error), 0)


def _joined(one: Floats, other: Floats) -> Floats:
    """Return what groups lack according to both halves, its variance, and sums of shares.

    Light that only one half has found may be that of a single pixel, which the variance of its
    samples understates: what the halves differ in is a variance, too.
    """
    joined = one + other
    joined[1] = np.maximum(joined[1], np.square(one[0] - other[0]))
    return joined


def _shrunk(before: Reals | float, sums: Reals, variances: float) -> Reals:
    """Return what groups lack per share, as far as noise does not explain it."""
    lacking, noise, share = sums
    share = np.maximum(share, 1e-30)
    apart = lacking / share - before
    variance = variances * noise / share**2
    sure = 1 - np.divide(variance, apart**2, out=np.ones_like(apart), where=apart**2 > variance)
    return np.asarray(before + sure * apart)


def _explained(rate: Reals, known: Sequence[tuple[Indices, Reals, Reals, Reals]]) -> Reals:
    """Return the part of the squares of what blocks lack that one rate of a group surely explains.

    Shape (channel, 1, 1, class, class), as `rate` has it. Of classes that no pixel is nearest to,
    it is that of all pixels. Of each half, `known` are the nearest group of each pixel, what it
    lacks, the variance of that, and its light.
    """
    largest = np.empty_like(rate)
    largest[:] = _largest_square(known, None).reshape(-1, 1, 1, 1, 1)
    for number, group in enumerate(np.ndindex(rate.shape[3:])):
        if any((nearest == number).any() for nearest, *_ in known):
            largest[:, 0, 0, group[0], group[1]] = _largest_square(known, number)
    return np.asarray(rate**2 / np.maximum(np.maximum(rate**2, largest), 1e-30))


def _largest_square(
    known: Sequence[tuple[Indices, Reals, Reals, Reals]], number: int | None
) -> Floats:
    """Return what blocks lack, squared, over their squared light: the largest of all sizes."""
    halves = [
        np.stack(images if number is None else [(nearest == number) * x for x in images])
        for nearest, *images in known
    ]
    found = []
    for edge in _EDGES:
        if edge > 1:
            halves = [block_sums(images, 2) for images in halves]
        squares = sum(lacking**2 - noise for lacking, noise, _ in halves)
        light = sum(np.square(images[2]) for images in halves)
        whole = np.maximum(light.sum(axis=(0, 1), dtype=np.float64), 1e-30)
        ratio = squares.sum(axis=(0, 1), dtype=np.float64) / whole
        apart = np.square(squares - ratio * light).sum(axis=(0, 1))
        # Few or noisy blocks do not show that they are alike.
        found.append(ratio + np.sqrt(apart) / whole)
    return np.asarray(np.max(found, axis=0))
