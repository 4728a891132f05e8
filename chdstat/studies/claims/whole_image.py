"""Claims on the whole image: fireflies, continuous CHDs, symmetry, families, and their pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from chdstat._core.arrays import Counts, Floats, flag_names, generator
from chdstat._core.resampling import largest_of
from chdstat.inference.findings import ClaimTest, Finding, PlotData, require, required
from chdstat.samples.tiles import Region
from chdstat.studies.claim import claim
from chdstat.studies.log_chds import SAME_SHAPE, LogChds, same_shape, squared_distance
from chdstat.studies.scene_data import PixelSet, SceneData, means_by_region

# --- fireflies ------------------------------------------------------------------------------------

_BRIGHTER = 4.0
"""An estimate this many times as bright as the pixel next to it is a firefly: two stops, as for the
fireflies of `chdstat.compare`. That of the paper is 8 times as bright in green."""
_LEAST = 12
"""Fireflies that a median over them needs."""
_FOLDS = 4


@claim(
    8,
    "fireflies",
    "A firefly and the pixel next to it have nearly the same CHD, though their estimates differ.",
)
def fireflies(data: SceneData) -> Finding:
    """Compare CHDs of pixels with a firefly with those next to them: distances, and true means.

    Rare bright samples make a firefly, and hardly change a distance of distribution functions; they
    do change the means. One batch of samples chooses a firefly, with some of those of its
    neighbour; the means are of all other batches, and so do not depend on the choice.
    """
    partner = _partners(data).ravel()
    batches = data.batch_light.reshape(-1, data.batch_light.shape[-1])
    pairs = _pairs(batches, partner)
    fireflies = pairs["count"] > 0
    count = int(np.count_nonzero(fireflies))
    require(count >= _LEAST, f"{_LEAST} fireflies, there are {count}")
    found = data.whole(tests=2)[fireflies]
    chds = data.chds.flat
    square = squared_distance(chds, chds[partner])
    above, below = (found.blocks.sums(pairs[name][fireflies]) for name in ("own", "beside"))
    ratio = found.interval(lambda w: (w @ above) / (w @ below))
    # Samples that did not occur again in the others may be too rare for as many. The upper end
    # leaves room for them: up to -log((1 - level) / 2) are expected where none is seen (Hanley and
    # Lippman-Hand 1983, "If nothing goes wrong, is everything all right?",
    # doi:10.1001/jama.1983.03330370053031).
    unseen = -math.log((1 - found.level) / 2)
    unseen *= float(pairs["excess"].sum() / pairs["count"].sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = replace(ratio, high=max(ratio.high, float(1 + unseen / below.sum())))
    known = np.where(fireflies, square, np.nan)
    place = int(np.argsort(known, kind="stable")[np.isfinite(known).sum() // 2])
    edges = -5 + chds.width * np.arange(chds.halves.shape[-1])
    shown = {"firefly": place, "neighbour": int(partner[place])}
    curves = {name: (edges, chds[pixel].whole) for name, pixel in shown.items()}
    name = "mean radiance of a firefly over its neighbour's, in other samples"
    return Finding(
        (
            same_shape(
                "distance between the CHDs of a firefly and its neighbour",
                found.median(square[fireflies]).root(),
            ),
            # A stop, half of what makes a firefly: both are about the same.
            ClaimTest(name, ratio, most=2.0),
        ),
        plot_data=PlotData("curves", curves, "log10 radiance in W sr-1 m-2", "share below"),
    )


def brightest_firefly(batches: Floats) -> tuple[int, int, int] | None:
    """Return row, column and batch of the brightest firefly; None without any.

    It is an estimate at least `_BRIGHTER` times the median of its pixel and of the pixel above it,
    where these medians are about the same: elsewhere there is an edge.

    Parameters
    ----------
    batches
        Luminance of the mean of each batch, shape (y, x, batch).
    """
    if batches.shape[0] < 2 or batches.shape[2] < 3 or not np.isfinite(batches).all():
        return None
    usual = np.median(batches, axis=-1)
    high, low = np.maximum(usual[1:], usual[:-1]), np.minimum(usual[1:], usual[:-1])
    similar = (low > 0) & (high <= 1.5 * low)
    most = batches[1:].max(axis=-1)
    fireflies = np.where(similar & (most >= _BRIGHTER * high), most, 0.0)
    if not fireflies.any():
        return None
    y, x = (int(i) for i in np.unravel_index(int(fireflies.argmax()), most.shape))
    return y + 1, x, int(batches[y + 1, x].argmax())


def _pairs(batches: Floats, partner: Counts) -> dict[str, Floats]:
    """Find fireflies among estimates (pixel, batch), and measure them in the other batches.

    Returns
    -------
    dict
        By pixel: ``count`` of the batches whose estimate is a firefly; ``own`` and ``beside``, the
        mean of the other batches of the pixel and of its neighbour, added up over its fireflies;
        ``excess``, what one more such firefly would add to ``own``, added up over the fireflies of
        the pixel.
    """
    count, own, beside, excess = np.zeros((4, len(batches)))
    total, size = batches.sum(axis=1, keepdims=True), batches.shape[1]
    for fold in range(_FOLDS):
        here = batches[:, fold::_FOLDS]
        part = here.sum(axis=1, keepdims=True)
        same, others = part / here.shape[1], (total - part) / (size - here.shape[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            firefly = (same[partner] > 0) & (here / same[partner] >= _BRIGHTER)
        count += firefly.sum(axis=1)
        own += np.where(firefly, (total - here) / (size - 1), 0.0).sum(axis=1)
        beside += np.where(firefly, others[partner], 0.0).sum(axis=1)
        excess += np.where(firefly, here - same[partner], 0.0).sum(axis=1) / (size - 1)
    return {"count": count, "own": own, "beside": beside, "excess": excess}


def _partners(data: SceneData) -> Counts:
    """Return the neighbour that sees the most similar surface, as an index of the flat image."""
    height, width = data.samples.shape[:2]
    features = [f for f in map(data.feature, ("albedo", "normal")) if f is not None]
    if data.feature("depth") is not None:
        features.append(data.log_depth[..., np.newaxis])
    seen = np.concatenate([*features, np.zeros((height, width, 1))], axis=-1)
    y, x = np.mgrid[:height, :width]
    best, partner = np.full((height, width), np.inf), y * width + x
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        ny, nx = np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)
        apart = np.abs(seen - seen[ny, nx]).sum(axis=-1)
        better = ((ny != y) | (nx != x)) & (apart < best)
        best = np.where(better, apart, best)
        partner = np.where(better, ny * width + nx, partner)
    return np.asarray(partner)


# --- continuity, and blends across edges ----------------------------------------------------------

_MIXED = (0.2, 0.8)
"""Weights between which a pixel is a blend; beyond, it lies on one side."""
_ON_EDGES = 30
"""Pixels on edges that are needed."""


@claim(
    10,
    "neighbours",
    "CHDs are continuous over the image, and across an edge a blend of those of its two sides.",
)
def neighbours(data: SceneData) -> Finding:
    """Compare neighbours with other pixels, and pixels on edges with blends of both sides."""
    chds, whole = data.chds, data.whole(tests=2)
    near = _near(chds)
    # Distances to a pixel drawn at random.
    other = generator(0).permutation(near.size)
    far = squared_distance(chds.flat, chds.flat[other])
    name = "squared distance of neighbours over that of any two pixels"
    # From a quarter on, neighbours are not half as far apart. It is Geary's c of the CHDs, 1
    # without any order in space.
    tests = [ClaimTest(name, whole.ratio(near.ravel(), far), most=0.25)]
    missing = list[str]()
    left, nearest, pixels = _edges(chds)
    if len(left) < _ON_EDGES:
        missing = [f"needs {_ON_EDGES} pixels on edges between different CHDs, found {len(left)}"]
    else:
        on_edges = whole[pixels]
        rest, side = on_edges.blocks.sums(left), on_edges.blocks.sums(nearest)
        blend = on_edges.interval(lambda w: 1 - (w @ rest) / (w @ side))
        # 1 of a blend, 0.5 of a CHD that moves from one side to the other as a whole; half way.
        tests.append(ClaimTest("share explained by a blend of both sides", blend, least=0.75))
    shown = {"distance to neighbours": (np.empty(0), np.sqrt(np.maximum(near, 0)))}
    return Finding(tuple(tests), tuple(missing), plot_data=PlotData("map", shown))


def _near(chds: LogChds) -> Floats:
    """Return mean squared distances to the pixels below and to the right, shape (y, x)."""
    squares = np.full((2, *chds.halves.shape[:2]), np.nan)
    squares[0, :-1] = squared_distance(chds[:-1], chds[1:])
    squares[1, :, :-1] = squared_distance(chds[:, :-1], chds[:, 1:])
    known = np.isfinite(squares)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, squares, 0).sum(axis=0) / known.sum(axis=0))


def _edges(chds: LogChds) -> tuple[Floats, Floats, Counts]:
    """Return, of pixels on edges, what a blend leaves, the distance to the nearer side, and which.

    A pixel is F = G + w (H - G) with G and H on both sides. Each half of the samples has a weight w
    of its own, so that their residuals are independent and the product of these is the squared
    residual without noise.
    """
    height, width = chds.halves.shape[:2]
    number = np.arange(height * width).reshape(height, width)
    edges = []
    for before, here, after in (
        (np.s_[:, :-2], np.s_[:, 1:-1], np.s_[:, 2:]),
        (np.s_[:-2], np.s_[1:-1], np.s_[2:]),
    ):
        edge = squared_distance(chds[before], chds[after]) >= (3 * SAME_SHAPE) ** 2
        g, f, h = (chds[place].halves[edge] for place in (before, here, after))
        at, step, rise = replace(chds, halves=f), h - g, f - g
        weights = (rise * step).sum(axis=-1) / (step * step).sum(axis=-1)
        mixed = (weights.mean(axis=-1) > _MIXED[0]) & (weights.mean(axis=-1) < _MIXED[1])
        rest = rise - weights[..., np.newaxis] * step
        left = (rest[:, 0] * rest[:, 1]).sum(axis=-1) * chds.width
        sides = (squared_distance(at, replace(at, halves=side)) for side in (g, h))
        edges.append((left[mixed], np.minimum(*sides)[mixed], number[here][edge][mixed]))
    left, nearest, pixels = (np.concatenate(v) for v in zip(*edges, strict=True))
    return left, nearest, pixels


# --- symmetry -------------------------------------------------------------------------------------

_HALVES = 0.5
"""Share of pixels that must show the same in both, else a view is not symmetric."""
_CELLS = (4, 2)
"""Parts of half of an image, down and across."""


@claim(
    27,
    "symmetry",
    "In a scene of symmetric geometry, CHDs are not symmetric everywhere.",
    spp=32,
)
def symmetry(data: SceneData) -> Finding:
    """Compare CHDs of pixels with those of their mirror images, where geometry is symmetric."""
    depth, albedo = (
        required(data.feature(n), "first-hit depth, albedo") for n in ("depth", "albedo")
    )
    height, width = data.samples.shape[:2]
    half = width // 2
    require(half, "two columns of pixels")
    left, right = np.s_[:, :half], np.s_[:, : width - half - 1 : -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        farther = np.abs(np.log(depth[left]) - np.log(depth[right]))
    same = (farther <= 0.05) & (np.abs(albedo[left] - albedo[right]).max(axis=-1) <= 0.05)
    share = float(same.mean())
    require(
        share >= _HALVES,
        "a view whose halves mirror each other in depth and albedo in at least "
        f"{100 * _HALVES:.0f} % of the pixels, here {100 * share:.0f} %",
    )
    square = squared_distance(data.chds[left], data.chds[right])
    square = np.where(same, square, np.nan)
    down, across = _CELLS
    cells = [
        Region(f"cell {i} {j}", "", (j / across, i / down, (j + 1) / across, (i + 1) / down))
        for i in range(min(down, height))
        for j in range(min(across, half))
    ]
    patch = PixelSet.of(cells, height, half)
    values = patch.take(square)
    shares = np.array([np.isfinite(values[patch.region == i]).mean() for i in range(len(cells))])
    used = np.isfinite(values) & (shares >= _HALVES)[patch.region]
    require(used.any(), "a part of the image whose halves mirror each other")
    blocks = patch.blocks[used]
    largest = largest_of(means_by_region(values[used], blocks), blocks).root()
    name = "largest distance between CHDs of mirrored parts of the image"
    image = np.sqrt(np.maximum(square, 0))
    return Finding(
        (ClaimTest(name, largest, least=SAME_SHAPE, unit="decade^1/2"),),
        plot_data=PlotData("map", {"distance to the mirror image": (image, image)}),
    )


# --- families -------------------------------------------------------------------------------------


@claim(
    14,
    "families",
    "The most frequent elementary distribution is the gamma distribution.",
    once=True,
)
def families(data: SceneData) -> Finding:
    """Compare the share of gamma among the best families with that of the next frequent one."""
    analysis, whole = data.analysis, data.whole()
    flags = {name: code for code, name in flag_names(analysis["best_family"].attrs).items()}
    names = [name for name, code in flags.items() if code >= 0]
    require("gamma" in names, "fits of gamma distributions")

    best = analysis["best_family"].to_numpy()[..., np.newaxis] == [flags[name] for name in names]
    # In how many channels of each pixel each family is best, (pixel, family).
    counts = best.sum(axis=2).reshape(-1, len(names)).astype(np.float64)
    require(counts.sum(), "pixels with enough positive samples to fit")
    sums, gamma = whole.blocks.sums(counts), names.index("gamma")

    def lead(weights: Floats) -> Floats:
        """Return the lead of gamma over each other family."""
        total = weights @ sums
        shares = total / total.sum(axis=1, keepdims=True)
        return np.asarray(shares[:, [gamma]] - np.delete(shares, gamma, axis=1))

    least = whole.interval(lead, (-1.0, 1.0))
    shares = dict(zip(names, (counts.sum(axis=0) / counts.sum()).tolist(), strict=True))
    return Finding(
        (ClaimTest("share of gamma less that of the next family", least, least=0.0),),
        plot_data=PlotData.bars(shares, "share of pixel channels"),
    )


# --- within pixels --------------------------------------------------------------------------------

_SLIGHTLY = 0.1
"""Variance that comes on top is slight up to this share of that of paths: a tenth more samples undo
it, and a gain of less is worth no word in comparisons of estimators, either."""
_SHARES = 0.5, 0.9, 0.99


@claim(
    34,
    "variation within pixels",
    "As radiance varies within the pixel, the variance is slightly higher than that of paths.",
    spp=192,
)
def within_pixels(data: SceneData) -> Finding:
    """Compare the variance between places in the pixel with that of paths at a fixed place.

    The image counts as in relMSE. Sums of both parts are unbiased, however rare bright paths are,
    save for changes within a cell: 4 x 4 cells, extrapolated, find all of an edge's variance, 9/8
    of a ramp's, and half to two thirds of that of dots and lines as fine as a cell. The median
    pixel says how typical the image is.
    """
    (paths, places), whole = data.split_of_noise, data.whole(tests=2)
    require((paths > 0).any(), "samples that vary")
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(paths > 0, places / paths, np.nan)
    name = "variance between places in the pixel over that of paths"
    levels = np.nanquantile(excess, _SHARES)
    shown = {f"{100 * share:g} % of pixels": x for share, x in zip(_SHARES, levels, strict=True)}
    return Finding(
        (
            ClaimTest(f"{name}, image", whole.ratio(places, paths), 0.0, _SLIGHTLY),
            ClaimTest(f"{name}, median pixel", whole.median(excess), most=_SLIGHTLY),
        ),
        plot_data=PlotData.bars(shown, "between places over paths, at most"),
        few="pixels",
    )
