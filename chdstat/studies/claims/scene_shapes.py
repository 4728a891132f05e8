"""Scene-specific shapes: whether CHDs alone tell the scene and the integrator (finding 12).

Scenes are classified by shapes of as many positive samples of every pixel of every scene: a
distribution function is the smoother, and shows the more modes, the more samples there are, so that
scenes with other shares of nulls, or other spp, would differ by that alone.

`permuted` tests whether two integrators differ at all in the shapes that they give the pixels of a
scene; `squares` measures by how much, with an interval of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, generator, spans
from chdstat._core.resampling import Blocks, Interval, interval_of, mean_of
from chdstat.patterns.atlases import WIDTH, of_histograms
from chdstat.samples import Samples
from chdstat.studies.log_chds import LogChds, aligned, shape_plot, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, level_of
from chdstat.studies.scene_data import SceneData, fold_of
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["DIFFERENT", "common_count", "drawn", "measure", "squares"]


def common_count(scenes: Sequence[SceneData], *, least: int) -> int:
    """Return a number of positive samples that half of the pixels of every scene have.

    Of pixels that have any, and of the channel in the middle; not less than `least`.
    """
    counts = [_positive(data) for data in scenes]
    middles = [np.median(n[n > 0]) if n.any() else 0 for n in counts]
    return max(least, int(min(middles, default=0)))


def drawn(data: SceneData, n: int, *, pixels: int, across: int = 8) -> tuple[Floats, Blocks]:
    """Draw `n` positive samples of pixels spread over the image, of the channel in the middle.

    Parameters
    ----------
    data
        The scene.
    n
        Samples of each pixel; pixels with fewer are left out.
    pixels
        How many, at most, as many in each of `across` x `across` blocks of the image.
    across
        Blocks along each side.

    Returns
    -------
    tuple
        Radiance, shape (pixel, n), and the blocks that the pixels lie in.
    """
    rng, blocks = generator(0), data.whole(across).blocks
    radiance, places = [np.empty((0, n))], [np.empty(0, dtype=np.int64)]
    for patch in data.scattered(pixels, across=across, allowed=_positive(data) >= n):
        x = data.radiance(patch)
        light = x[:, x.shape[1] // 2]
        # Positive ones first, in an order drawn at random.
        rank = np.where(light > 0, rng.random(light.shape), 2)
        first = np.argpartition(rank, n - 1, axis=-1)[:, :n]
        radiance.append(np.take_along_axis(light, first, axis=-1))
        places.append(patch.blocks.of_pixel)
    return np.concatenate(radiance), Blocks(np.concatenate(places), blocks.region)


def _positive(data: SceneData) -> Counts:
    """Return how many positive samples each pixel has within its log histogram, shape (y, x)."""
    counts = data.summary["log_counts"]
    middle = counts.isel(channel=counts.sizes["channel"] // 2)
    return np.asarray(middle.sum("log_bin").to_numpy(), dtype=np.int64)


_PERMUTATIONS = 999
_AT_ONCE = 64
_HISTOGRAM = (
    *("log_counts", "log_underflow", "log_overflow", "null_count", "bad_count"),
    *("log_low", "log_high"),
)


def squares(one: xr.Dataset, two: xr.Dataset) -> Floats:
    """Return squared distances between the shapes of two renders of a view, shape (pixel,).

    In each pixel, of the render with more positive samples only as many count as the other has,
    drawn at random. Where both have the same shape, their four halves are then exchangeable, and
    the distance is as likely to be above 0 as below.

    Parameters
    ----------
    one, two
        Log histograms of the same size, as of `chdstat.summarize`; the channel in the middle
        counts.

    Returns
    -------
    ndarray
        In decades; NaN where either has too few samples for a shape. Twice that is the energy
        distance of the two distributions of log10 radiance.

    References
    ----------
    Székely and Rizzo, "Energy statistics: a class of statistics based on distances", 2013,
    doi:10.1016/j.jspi.2013.03.018.
    """
    rng = generator(0)
    middle = slice(one.sizes["channel"] // 2, one.sizes["channel"] // 2 + 1)
    datasets = [d[list(_HISTOGRAM)].isel(channel=middle) for d in (one, two)]
    thin = _equally_many(datasets, rng)
    return _squared([of_histograms(dataset, rng).cumulative[..., 1:, :] for dataset in thin])


def squares_of_pairs(one: Samples, two: Samples) -> Floats:
    """Return squared distances of renders that share random numbers, shape (pixel,).

    As `squares`, but a half is every other sample of both: of halves drawn separately from each
    render, the first of one would be correlated with the second of the other, and distances be too
    small.
    """
    rng, spp, middle = generator(0), min(one.spp, two.spp), one.shape[2] // 2
    halves = []
    for first in (0, 1):
        datasets = []
        for samples in (one, two):
            x = samples.read(ss=slice(0, spp))[:, :, middle : middle + 1, first::2]
            half = Samples.from_array(np.ascontiguousarray(x), axes="yxcs")
            datasets.append(summarize(half, progress=False)[list(_HISTOGRAM)])
        thin = _equally_many(datasets, rng)
        halves.append([of_histograms(dataset, rng).cumulative[..., 0, :] for dataset in thin])
    return _squared([np.stack(pair, axis=-2) for pair in zip(*halves, strict=True)])


def _equally_many(datasets: Sequence[xr.Dataset], rng: np.random.Generator) -> Iterator[xr.Dataset]:
    """Yield log histograms with as many positive samples in each pixel, the fewest of them."""
    counts = [dataset["log_counts"].to_numpy().astype(np.int64) for dataset in datasets]
    fewest = np.minimum(*(c.sum(axis=-1) for c in counts))
    for dataset, c in zip(datasets, counts, strict=True):
        yield dataset.assign(log_counts=(dataset["log_counts"].dims, _thinned(c, fewest, rng)))


def _squared(renders: Sequence[npt.NDArray[np.float32]]) -> Floats:
    """Return squared distances (pixel,) of two renders, each given as halves (y, x, half, edge)."""
    one, two = (LogChds(halves.astype(np.float64)) for halves in renders)
    return squared_distance(one, two, width=WIDTH).ravel()


def _thinned(counts: Counts, n: Counts, rng: np.random.Generator) -> Counts:
    """Draw `n` (...) of what was counted, (..., bin), without replacement."""
    drawn_counts, rest, left = np.empty_like(counts), counts.sum(axis=-1), n.copy()
    # Multivariate hypergeometric: bin after bin, from what is left.
    for i in range(counts.shape[-1]):
        here = counts[..., i]
        rest -= here
        drawn_counts[..., i] = rng.hypergeometric(here, rest, left)
        left -= drawn_counts[..., i]
    return drawn_counts


def permuted(squared: Sequence[Floats]) -> float:
    """Return the p-value of no difference between two integrators in any pixel.

    The statistic is the mean over pixels, of all scenes given. Where there is no difference, one
    half of the samples of each pixel may change sides, which turns the sign of its distance; pixels
    are rendered independently. So random signs give the null distribution, exactly.

    Parameters
    ----------
    squared
        `squares` of each scene.

    Returns
    -------
    float
        One-sided, at least 1/1000; NaN without a distance.

    References
    ----------
    Phipson and Smyth, "Permutation p-values should never be zero", 2010,
    doi:10.2202/1544-6115.1585.

    Examples
    --------
    >>> permuted([np.full(20, 0.1)]), permuted([np.tile([0.1, -0.1], 10)]) > 0.3
    (0.001, True)
    """
    values = np.concatenate([np.zeros(0), *squared])
    values = values[np.isfinite(values)]
    if not len(values):
        return float("nan")
    rng, seen, reached = generator(0), values.sum(), 0
    for part in spans(_PERMUTATIONS, _AT_ONCE):
        signs = rng.integers(0, 2, (part.stop - part.start, len(values)), dtype=np.int8)
        sums = 2 * (signs @ values) - seen
        # Rounding must not separate equal sums.
        reached += int(np.count_nonzero(sums >= seen - 1e-12 * np.abs(values).sum()))
    return (1 + reached) / (1 + _PERMUTATIONS)


DIFFERENT = 0.02
"""Cramér distance, root of its mean square over pixels, from which shapes are different.

As of two log-normal CHDs of which one has a spread a tenth larger, at a third of a decade: that
takes a fifth more samples for the same error in the logarithm. What is smaller may be there, and a
test with samples enough would find it, but it changes nothing in practice. `SAME_SHAPE`, up to
which CHDs look the same, is no border here: a difference need not be seen to be one.
"""
_NULL = "both integrators give each pixel a CHD of the same shape (permutations within pixels)"
_FOLDS = 4
_ACROSS = 4
_PIXELS = 1500
"""Pixels of each scene that take part, at most."""
_LEAST = 64
_LEAST_SAMPLES = 32
"""Positive samples that a shape needs."""
_TREES = 30


def measure(scenes: Sequence[SceneData]) -> Outcome:
    """Classify scenes by shapes, and compare shapes of integrators pixel by pixel."""
    level, tests, missing = level_of(2), list[ClaimTest](), list[str]()
    details: dict[str, Any] = {"scenes": [data.name for data in scenes]}
    n = common_count(scenes, least=_LEAST_SAMPLES)
    shapes = [_shapes(data, n) for data in scenes]
    if len(scenes) < 2:
        missing.append("needs a second scene")
    elif min(len(of_scene) for of_scene, _ in shapes) < _LEAST:
        missing.append(f"needs {_LEAST} pixels of each scene with {n} positive samples")
    else:
        accuracy, details["confusion"] = _scene_accuracy(shapes, level)
        details["positive_samples"] = n
        least = (1 + 1 / len(scenes)) / 2
        tests.append(ClaimTest("accuracy of telling scenes apart", accuracy, least=least))
    p_value = None
    changed = [data for data in scenes if data.integrator or data.shorter]
    if changed:
        squared = [(data, _squares(data)) for data in changed]
        known = [(data, values) for data, values in squared if values is not None]
        distance = Interval.unknown(level=level)
        if known:
            blocks = Blocks.join([data.whole().blocks for data, _ in known])
            every = np.concatenate([values for _, values in known])
            distance = mean_of(every, blocks, level=level).root()
        name = "distance between the shapes of two integrators"
        tests.append(ClaimTest(name, distance, least=DIFFERENT, unit="decade^1/2"))
        p = permuted([values for _, values in known])
        p_value = None if math.isnan(p) else p
        by_scene = {data.name: permuted([values]) for data, values in known}
        details |= {"null_hypothesis": _NULL, "p_value_by_scene": by_scene}
    else:
        missing.append("needs a scene rendered by another integrator, or with shorter paths")
    means = {
        data.name: of_scene.mean(axis=0)
        for data, (of_scene, _) in zip(scenes, shapes, strict=True)
        if len(of_scene)
    }
    return Outcome(
        tuple(tests), tuple(missing), p_value, details=details, plot_data=shape_plot(means)
    )


def _scene_accuracy(
    scenes: Sequence[tuple[Floats, Blocks]], level: float
) -> tuple[Interval[float], list[list[float]]]:
    """Return the accuracy of a classifier of shapes, and its table of shares by scene.

    Each scene comes with shapes, (pixel, edge), and the blocks that its pixels lie in.

    Extremely randomised trees (Geurts, Ernst and Wehenkel 2006, doi:10.1007/s10994-006-6226-1) see
    shapes without place or scale, each of as many positive samples: of more, a shape is smoother,
    which would tell of nulls and spp. Each image is cut into 16 blocks; a quarter of
    them is held out at a time, as neighbours resemble each other (Roberts et al. 2017,
    doi:10.1111/ecog.02881). Every scene has the same weight.

    Half-way between chance and certainty, the claim's border, is a choice of ours.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    shapes, blocks = zip(*scenes, strict=True)
    x = np.concatenate(shapes)
    scene = np.repeat(np.arange(len(shapes)), [len(s) for s in shapes])
    fold = np.concatenate([fold_of(b, across=_ACROSS, folds=_FOLDS) for b in blocks])
    predicted = np.full(len(x), -1)
    for k in range(_FOLDS):
        if (held := fold == k).any():
            model = ExtraTreesClassifier(
                _TREES, min_samples_leaf=3, class_weight="balanced", random_state=0
            )
            predicted[held] = model.fit(x[~held], scene[~held]).predict(x[held])
    joined = Blocks.join([b[:] for b in blocks])  # without blocks that have no pixel
    right, count = joined.sums((predicted == scene).astype(float)), joined.sums(np.ones(len(x)))
    member = (joined.region[:, np.newaxis] == np.unique(joined.region)).astype(np.float64)

    def accuracy(weights: Floats) -> Floats:
        hits, all_ = (weights * right) @ member, (weights * count) @ member
        return np.asarray((hits / all_).mean(axis=1))

    confusion = [
        [float((predicted[scene == i] == j).mean()) for j in range(len(shapes))]
        for i in range(len(shapes))
    ]
    return interval_of(accuracy, joined, level=level, bounds=(0.0, 1.0)), confusion


def _shapes(data: SceneData, n: int) -> tuple[Floats, Blocks]:
    """Return shapes of `n` samples, shape (pixel, edge), and the blocks that the pixels lie in."""
    x, blocks = drawn(data, n, pixels=_PIXELS, across=_ACROSS)
    chds = aligned(x)
    # Blocks keep their numbers, which say where they lie.
    return chds.whole[chds.known], Blocks(blocks.of_pixel[chds.known], blocks.region)


def _squares(data: SceneData) -> Floats | None:
    """Return squared distances to the other render of the view; None where sizes differ."""
    other = data.integrator or data.shorter
    if other is None or other.shape[:2] != data.samples.shape[:2]:
        return None
    if data.samples.shares_numbers_with(other):
        return squares_of_pairs(data.samples, other)
    theirs = data.shorter_summary if other is data.shorter else None
    if theirs is None:
        theirs = summarize(other, progress=False)
    return squares(data.summary, theirs)
