"""Atlas: the shapes that recur over a scene, found without labels.

`chdstat.classify` looks for known patterns; `atlas` finds the distributions that an image has. The
shape of a pixel is the distribution of its log radiance, shifted so that its mean is 0: pixels that
differ only in brightness have the same shape. Shapes come from samples, which are read twice in
constant memory, for means and for counts around them; or from log histograms.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from chdstat._core.arrays import (
    Array,
    Counts,
    Floats,
    Mask,
    Seed,
    first_of,
    generator,
    is_bad,
    luminance,
    spans,
    whole,
)
from chdstat._core.display import Card, Shown, each, number, percent, reasons, with_interval
from chdstat._core.moments import Moments
from chdstat._core.positive import CONSTANT_SPREAD
from chdstat._core.resampling import wilson
from chdstat.errors import InputError, Reason
from chdstat.samples import ImageLike, Mapped, SampleBlocks, Samples, reduce_tiles, samples_of
from chdstat.samples.tiles import Work
from chdstat.summary.histograms import Histogram, StreamingHistogram, Support

if TYPE_CHECKING:
    import xarray as xr

_BINS = 81
"""Bins of a shape; the mean lies at the centre of the middle one."""
WIDTH = 0.1
"""Width of a bin in decades."""
_EDGES = WIDTH * (np.arange(1, _BINS) - _BINS / 2)
"""Edges between bins in decades from the mean; the two outermost bins are open."""
_MINIMUM = 32
"""Positive samples that a shape needs."""
_FINE = 4
"""Bins counted per bin of a shape, so that halves of the samples can be shifted separately."""
_BATCH = 64


@dataclass(frozen=True, repr=False)
class Atlas(Shown):
    """Shapes that recur over an image, the most frequent first.

    Attributes
    ----------
    positions
        Centres of the bins in decades from the scale of a pixel, log10(x / scale), shape (bin,).
        The two outermost bins also hold everything beyond them.
    density, density_band
        Mean density per decade over the pixels of each cluster, shape (cluster, bin), and the lower
        and upper quartile over these pixels, shape (cluster, bin, 2).
    labels
        Cluster of each pixel, shape (y, x); -1 where there is no shape.
    reason
        `Reason` codes of why a pixel has no shape.
    distance
        Cramér distance of each pixel to its typical shape, shape (y, x), in square roots of
        decades.
    scale
        Geometric mean of the positive samples, shape (y, x), in W sr-1 m-2.
    share, share_interval
        Share of the pixels with a shape, shape (cluster,), and its Wilson interval, shape
        (cluster, 2), as if the pixels were drawn at random from all views of the scene.
    null_share
        Mean share of nulls, shape (cluster,).
    medoids
        Row and column of the pixel that is nearest to the typical shape, shape (cluster, 2).
    candidates
        Numbers of clusters tried, shape (candidate,).
    explained
        Share of the repeatable variation that each number of clusters explains, shape (candidate,);
        NaN if nothing is repeatable.
    silhouettes
        Mean silhouette for each number of clusters, shape (candidate,), in [-1, 1]; NaN for one
        cluster.
    repeatable
        Share of the variation between shapes from half the samples that the other half repeats; the
        rest is noise.
    stability
        Adjusted Rand index between the labels from the two halves of the samples: 1 if all pixels
        stay together, 0 as by chance.
    """

    positions: Floats
    density: Floats
    density_band: Floats
    labels: npt.NDArray[np.int16]
    reason: npt.NDArray[np.int8]
    distance: Floats
    scale: Floats
    share: Floats
    share_interval: Floats
    null_share: Floats
    medoids: Counts
    candidates: Counts
    explained: Floats
    silhouettes: Floats
    repeatable: float
    stability: float

    def _card(self) -> Card:
        return Card(f"Atlas of {len(self.share)} shape{'s' * (len(self.share) != 1)}", {
            "share of the pixels": each(with_interval, self.share, *self.share_interval.T),
            "share of nulls": self.null_share,
            "typical pixels": self.medoids,
            "variation that repeats": percent(self.repeatable),
            "Rand index of halves": number(self.stability),
            "without a shape": reasons(self.reason),
        })  # fmt: skip


def atlas(
    samples: ImageLike | npt.ArrayLike | xr.Dataset,
    *,
    clusters: int | None = None,
    max_clusters: int = 12,
    min_share: float = 0.005,
    nulls: bool = False,
    seed: Seed = 0,
    progress: bool = True,
) -> Atlas:
    """Find the shapes of distributions that recur over an image.

    The shape of a pixel is the distribution of ``log10(x / scale)`` of its positive samples x,
    where the scale is their geometric mean. The distance of two shapes with distribution functions
    F and G is Cramér's, ``sqrt(integral (F - G)^2)``. K-means groups the shapes.

    Prediction decides the number of groups. The samples of each pixel are halved at random, and the
    typical shapes found in one half predict the other half. A number k of clusters explains
    ``(E1 - Ek) / (E1 - E)`` of the repeatable variation. Ek is the mean squared error of k
    clusters. E is the error of the true shape of each pixel: half the squared distance between its
    halves. One more cluster is worth it if it explains at least a tenth of what is still
    unexplained, and gains at least three standard errors. Clusters that follow noise predict worse
    than none.

    Shapes may pass into each other, as on real surfaces. The number of clusters is then a
    resolution rather than a count of kinds, and grows with the number of samples; `silhouettes`
    show it.

    Parameters
    ----------
    samples
        An image, whose luminance is used: `Samples`, an array (y, x, channel, sample), or the path
        of a store. Or its log histograms, as `chdstat.histogram` returns them, whose middle
        channel, green, is used. Histograms lose the place of a sample within its bin, and
        everything outside their support.
    clusters
        Number of clusters; None decides as above.
    max_clusters
        Largest number of clusters to try.
    min_share
        Smallest share of the pixels that a cluster may have in a number that is chosen.
    nulls
        Whether the share of nulls is part of the shape. A difference d of the shares counts as much
        as a difference d of the distribution functions over one decade.
    seed
        Seed of the halves, of the start of k-means, and of the up to 4096 pixels that it learns
        from.
    progress
        For `Samples`: show progress, as a bar in a terminal or notebook, elsewhere as a line every
        ten seconds.

    Returns
    -------
    Atlas
        The shapes. Pixels with fewer than 32 positive samples, or equal ones, have a reason
        instead.

    Raises
    ------
    InputError
        If an option is out of range, `clusters` is larger than the number of different shapes, or
        the dataset lacks a log histogram.

    References
    ----------
    Székely and Rizzo, "Energy statistics: a class of statistics based on distances", 2013,
    doi:10.1016/j.jspi.2013.03.018 (Cramér's distance). Smyth, "Model selection for probabilistic
    clustering using cross-validated likelihood", 2000, doi:10.1023/A:1008940618127 (numbers chosen
    by prediction; the rule above is this library's own). Rousseeuw, "Silhouettes", 1987,
    doi:10.1016/0377-0427(87)90125-7. Hubert and Arabie, "Comparing partitions", 1985,
    doi:10.1007/BF01908075.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> x = rng.gamma(2.0, size=(12, 12, 1, 256))
    >>> x[:4] = rng.lognormal(sigma=1.5, size=(4, 12, 1, 256))
    >>> found = atlas(x * rng.uniform(1, 100, size=(12, 12, 1, 1)))
    >>> found.share.round(2), found.labels[:, 0]
    (array([0.67, 0.33]), array([1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0], dtype=int16))
    """
    if clusters is not None:
        clusters = whole("clusters", clusters, least=1)
    most = whole("max_clusters", max_clusters, least=1)
    if not 0 <= min_share < 1:
        message = f"min_share must be a share in [0, 1), got {min_share}"
        raise InputError(message)
    rng = generator(seed)
    if hasattr(samples, "data_vars"):
        shapes = of_histograms(cast("xr.Dataset", samples), rng)
    else:
        shapes = _of_samples(samples_of(cast("npt.ArrayLike", samples)), rng, progress=progress)
    ok = shapes.reason == Reason.OK
    # Vectors, shape (pixel, part, feature), with the distances of their shapes.
    rows = np.sqrt(WIDTH) * shapes.cumulative[ok]
    if nulls:
        rows = np.concatenate([rows, shapes.null_share[ok][..., np.newaxis]], axis=-1)
    points, *halves = np.moveaxis(rows.astype(np.float32), 1, 0)
    numbers = range(1, most + 1) if clusters is None else [clusters]
    group, apart, medoids, about = _find_groups(
        points, halves, numbers, min_share=min_share, rng=rng
    )
    count = np.bincount(group, minlength=len(medoids))
    members = [group == k for k in range(len(count))]
    cumulative = shapes.cumulative[ok][:, 0].astype(np.float64)
    density = np.diff(cumulative, axis=-1, prepend=0, append=1) / WIDTH
    null_share = shapes.null_share[ok][:, 0]
    labels, distance = np.full(ok.shape, -1, np.int16), np.full(ok.shape, np.nan)
    labels[ok], distance[ok] = group, apart
    bands = [np.percentile(density[rows], (25, 75), axis=0).T for rows in members]
    return Atlas(
        positions=np.asarray(WIDTH * (np.arange(_BINS) - (_BINS - 1) / 2)),
        density=np.array([density[rows].mean(axis=0) for rows in members]).reshape(-1, _BINS),
        density_band=np.array(bands).reshape(-1, _BINS, 2),
        labels=labels,
        reason=shapes.reason,
        distance=distance,
        scale=10.0**shapes.log_scale,
        share=count / max(1, count.sum()),
        share_interval=wilson(count, count.sum()),
        null_share=np.array([null_share[rows].mean(dtype=np.float64) for rows in members]),
        medoids=np.argwhere(ok)[medoids],
        **about,
    )


@dataclass(frozen=True)
class Shapes:
    """Distributions of log10 radiance around their means, for an image.

    Attributes
    ----------
    cumulative
        Share of the positive samples below each edge, shape (y, x, part, edge). The parts are all
        samples, and two random halves of them; each is shifted by its own mean. NaN where there is
        no shape.
    null_share
        Share of nulls in each part, shape (y, x, part).
    log_scale
        Mean of log10 radiance, shape (y, x).
    reason
        `Reason` codes of why there is no shape.
    """

    cumulative: npt.NDArray[np.float32]
    null_share: npt.NDArray[np.float32]
    log_scale: Floats
    reason: npt.NDArray[np.int8]


def _of_samples(samples: Samples, rng: np.random.Generator, *, progress: bool = True) -> Shapes:
    """Return the shapes of the luminance of an image."""

    def of_tile(tile: Samples, blocks: SampleBlocks) -> Mapped:
        log, n_good, n_null = _log_moments(blocks)
        center = np.where(log.count > 0, log.mean, np.nan)
        counts = _count((tile.read(ss=ss) for ss in spans(tile.spp, _BATCH)), center)
        log_variance = log.m2 / np.maximum(log.count, 1) * np.log(10) ** 2
        reason = _reason(log.count, n_good, n_null, log_variance)
        # The counts are already around the centre.
        grid = _Grid(
            np.full(center.shape, -WIDTH * _BINS / 2), np.full(center.shape, WIDTH / _FINE)
        )
        shapes = _moved(counts, n_null, grid, np.zeros(center.shape), reason, rng)
        return {
            "cumulative": (("part", "edge"), shapes.cumulative),
            "null_share": (("part",), shapes.null_share),
            "log_scale": ((), center),
            "reason": ((), reason),
        }

    work: Work = {"progress": progress, "workers": 1}  # in order: they share a generator
    found = reduce_tiles(samples, of_tile, description="aligning shapes", **work)
    return Shapes(**{str(name): array.to_numpy() for name, array in found.items()})


def of_histograms(dataset: xr.Dataset, rng: np.random.Generator) -> Shapes:
    """Return the shapes in the log histograms of an image, for the channel in the middle.

    That is green, the largest part of luminance, or the only channel. Bins are shifted by fractions
    of a bin.

    Raises
    ------
    InputError
        If the dataset lacks a variable of its log histogram.
    """
    middle = slice(dataset.sizes.get("channel", 0) // 2, None)
    part = Histogram.of_dataset(dataset.isel(channel=middle, missing_dims="ignore")).positive
    counts, n, n_null = part.counts[:, :, 0], part.n[:, :, 0], part.n_null[:, :, 0]
    width, first = part.width[:, :, 0] / np.log(10), part.log_centers[:, :, 0, 0] / np.log(10)
    grid = _Grid(*(np.broadcast_to(v, n.shape) for v in (first - width / 2, width)))
    n_dark = part.n_null[:, :, 0] + part.n_zero[:, :, 0]
    reason = _reason(n, part.n_good[:, :, 0], n_dark, part.log_statistics.log_variance[:, :, 0])
    return _moved(counts, n_null, grid, grid.mean(counts), reason, rng)


@dataclass(frozen=True)
class _Grid:
    """Bins of log10 radiance: the first edge and the width, each with shape (...)."""

    low: Floats
    width: Floats

    def mean(self, counts: npt.NDArray[Any]) -> Floats:
        """Return the mean of the counted values, shape (...); NaN without any."""
        places = np.vecdot(counts, np.arange(counts.shape[-1]) + 0.5)
        return np.asarray(self.low + self.width * ratio(places, counts.sum(axis=-1)))

    def below(self, counts: npt.NDArray[Any], center: Floats) -> npt.NDArray[np.float32]:
        """Return the share below each edge of a shape around `center`, shape (..., edge)."""
        total = np.cumsum(counts, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros((*total.shape[:-1], 1)), total], axis=-1)
        total /= np.maximum(total[..., -1:], 1)
        offset = (center - self.low)[..., np.newaxis]
        # Rounded, so that an edge of the bins stays exactly an edge.
        place = np.round((_EDGES + offset) / self.width[..., np.newaxis], 9)
        place = np.clip(np.nan_to_num(place), 0, counts.shape[-1])
        left = np.minimum(place.astype(np.intp), counts.shape[-1] - 1)
        start, stop = (np.take_along_axis(total, i, axis=-1) for i in (left, left + 1))
        return np.asarray(start + (place - left) * (stop - start), dtype=np.float32)


def _log_moments(blocks: SampleBlocks) -> tuple[Moments, Counts, Counts]:
    """Return moments of log10 of positive luminance, and the numbers of good and of 0 samples."""

    def of_block(block: npt.NDArray[np.float32]) -> tuple[Moments, Counts]:
        light, good = _luminance(block)
        positive, null = good & (light > 0), good & (light == 0)
        log = np.log10(np.where(positive, light, 1))
        return Moments.of(log, positive), np.count_nonzero([good, null], axis=-1)

    log, counts = of_block(next(blocks))
    for block in blocks:
        more, others = of_block(block)
        log, counts = log.merge(more), counts + others
    return log, counts[0], counts[1]


def _luminance(block: npt.NDArray[np.float32]) -> tuple[Floats, Mask]:
    """Return the luminance of samples, 0 for bad ones, and which samples are good."""
    good = np.asarray(~is_bad(block).any(axis=-2))
    return np.where(good, luminance(block), 0).astype(np.float64), good


def _count(blocks: SampleBlocks, center: Floats) -> Counts:
    """Count luminance in fine bins around `center`, shape (y, x, bin); the end bins are open."""
    missing = np.isnan(center)
    reason = np.where(missing, Reason.ALL_NULL, Reason.OK).astype(np.int8)
    low, high = (10.0 ** (center + sign * WIDTH * _BINS / 2) for sign in (-1, 1))
    stream = StreamingHistogram(bins=_BINS * _FINE, support=Support(low, high, reason))
    for block in blocks:
        stream.update(_luminance(block)[0])
    read = stream.read()
    read.counts[..., 0] += read.underflow - read.negative
    read.counts[..., -1] += read.overflow
    return read.counts


def _moved(
    counts: Array,
    n_null: Counts,
    grid: _Grid,
    center: Floats,
    reason: npt.NDArray[np.int8],
    rng: np.random.Generator,
) -> Shapes:
    """Return shapes around `center`, and shapes of random halves around their own means."""
    # Samples are exchangeable: halving the counts at random halves the samples at random.
    half, null = rng.binomial(counts.astype(np.int64), 0.5), rng.binomial(n_null, 0.5)
    rest = counts - half
    parts = (
        (counts, n_null, center),
        (half, null, grid.mean(half)),
        (rest, n_null - null, grid.mean(rest)),
    )
    below = np.stack([grid.below(some, place) for some, _, place in parts], axis=-2)
    null_share = [ratio(nulls, nulls + some.sum(axis=-1)) for some, nulls, _ in parts]
    ok = (reason == Reason.OK)[..., np.newaxis, np.newaxis]
    cumulative = np.where(ok, below, np.float32(np.nan))
    return Shapes(cumulative, np.stack(null_share, axis=-1).astype(np.float32), center, reason)


def _reason(
    n: Counts | Floats, n_good: Counts, n_null: Counts, log_variance: Floats
) -> npt.NDArray[np.int8]:
    return first_of(
        {
            Reason.ALL_BAD: n_good == 0,
            Reason.NONE_POSITIVE: (n == 0) & (n_null < n_good),
            Reason.ALL_NULL: n == 0,
            Reason.TOO_FEW: n < _MINIMUM,
            Reason.CONSTANT: log_variance <= CONSTANT_SPREAD**2,
        }
    )


_LEARNT = 4096
"""Points that k-means learns from: the error of their mean is far below that of a point."""
_NEGLIGIBLE = 1e-3
_SILHOUETTE = 1500
"""Points whose silhouettes are averaged; the cost grows with the square of this number."""
_STARTS = 8
"""Runs of k-means. With half the samples, the closest groups may be those that split noise."""
_WORTH = 0.1
"""Share of the unexplained variation that one more group must explain."""
_SURE = 3.0
"""Standard errors that one more group must gain."""

Points = npt.NDArray[np.float32]
Labels = npt.NDArray[np.intp]


class _Candidate(NamedTuple):
    """One number of groups: labels from all samples, and predictions between the halves.

    `errors` are the squared errors of predicting one half from the centres of the other, by point.
    """

    number: int
    labels: Labels
    errors: Floats
    silhouette: float
    stability: float
    smallest: float


def _find_groups(
    whole: Points,
    halves: Sequence[Points],
    numbers: Sequence[int],
    *,
    min_share: float,
    rng: np.random.Generator,
) -> tuple[Labels, Floats, Labels, dict[str, Any]]:
    """Group points by k-means; the halves of the samples decide the number of groups.

    Parameters
    ----------
    whole, halves
        Points from all samples and from two halves of them, each with shape (point, feature).
    numbers
        Numbers of groups to choose from, ascending.
    min_share
        Smallest share of the points in a group, for a number of groups to be chosen.
    rng
        Chooses the points that k-means learns from, and its start.

    Returns
    -------
    ndarray
        Group of each point, the largest first, shape (point,).
    ndarray
        Distance of each point to the centre of its group, shape (point,).
    ndarray
        Index of the point that is nearest to each centre, shape (group,).
    dict
        The fields of `Atlas` that say how good the groups are.

    Raises
    ------
    InputError
        If only one number is given and it is larger than the number of different points.
    """
    import sklearn.cluster  # noqa: F401 - its threads can be limited once it is there

    learnt = rng.permutation(len(whole))[:_LEARNT]
    seed = int(rng.integers(2**31 - _STARTS))
    parts = [whole[learnt], *(half[learnt] for half in halves)]
    most = min(len(np.unique(part, axis=0)) for part in parts)
    if 0 < most < numbers[0]:
        message = f"{numbers[0]} clusters need as many different shapes, got {most}"
        raise InputError(message)
    points, one, two = _rotated(*parts)
    # Threads wait longer for each other than so few points take, above all on a busy machine.
    with threadpool_limits(limits=1):
        tried = [_try(points, one, two, k, seed) for k in numbers if k <= most]
    noise = ((one - two) ** 2).sum(axis=-1, dtype=np.float64) / 2
    together = np.zeros(len(one), dtype=np.intp)
    alone = (_prediction_errors(one, two, together) + _prediction_errors(two, one, together)) / 2
    chosen = _choose(tried, noise, min_share)
    repeated = alone - noise
    sure = len(alone) > 0 and repeated.mean() > _SURE * _standard_error(repeated)
    variation = float(repeated.sum()) if sure else 0.0
    labels, distance = np.empty(0, dtype=np.intp), np.empty(0)
    if chosen is not None:
        from sklearn.metrics import pairwise_distances_argmin_min

        centers = _means(whole[learnt], chosen.labels)
        labels, distance = pairwise_distances_argmin_min(whole, centers)
    found, labels, count = np.unique(labels, return_inverse=True, return_counts=True)
    order = np.argsort(-count, kind="stable")
    labels = np.argsort(order)[labels]
    nearest = [np.where(labels == k, distance, np.inf).argmin() for k in range(len(found))]
    about = {
        "candidates": np.array([c.number for c in tried], dtype=np.int64),
        "explained": np.array([ratio((alone - c.errors).sum(), variation) for c in tried]),
        "silhouettes": np.array([c.silhouette for c in tried]),
        "repeatable": float(ratio(variation, alone.sum())),
        "stability": chosen.stability if chosen else np.nan,
    }
    return labels, distance.astype(np.float64), np.array(nearest, dtype=np.intp), about


def _rotated(*parts: Points) -> list[Points]:
    """Rotate points to their principal axes, and drop axes with hardly any variation.

    Distances stay the same within a thousandth of the variance. K-means takes a third of the time,
    since distribution functions are nearly the same at neighbouring edges.
    """
    if not len(parts[0]):
        return list(parts)
    center = parts[0].mean(axis=0)
    variances, axes = np.linalg.eigh(sum((part - center).T @ (part - center) for part in parts))
    kept = np.cumsum(variances) > _NEGLIGIBLE * variances.sum()
    kept[-1] = True
    return [(part - center) @ axes[:, kept] for part in parts]


def _try(points: Points, one: Points, two: Points, number: int, seed: int) -> _Candidate:
    from sklearn.metrics import adjusted_rand_score, silhouette_score

    labels = _k_means(points, number, seed, starts=_STARTS)
    # Choosing the best of a few starts by its prediction favours no number of groups by as much as
    # groups of noise lose.
    predicted = []
    for here, there in ((one, two), (two, one)):
        starts = range(seed, seed + (_STARTS if number > 1 else 1))
        runs = [_k_means(here, number, start, starts=1) for start in starts]
        errors = [_prediction_errors(here, there, run) for run in runs]
        best = int(np.argmin([error.sum() for error in errors]))
        predicted.append((runs[best], errors[best]))
    (of_one, errors_two), (of_two, errors_one) = predicted
    some = labels[:_SILHOUETTE]
    several = 1 < len(np.unique(some)) < len(some)
    return _Candidate(
        number=number,
        labels=labels,
        errors=(errors_one + errors_two) / 2,
        silhouette=float(silhouette_score(points[:_SILHOUETTE], some)) if several else np.nan,
        stability=float(adjusted_rand_score(of_one, of_two)),
        smallest=float(np.bincount(labels, minlength=number).min() / len(points)),
    )


def _k_means(points: Points, number: int, seed: int, *, starts: int) -> Labels:
    from sklearn.cluster import KMeans  # takes a third of a second
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # Points that differ by rounding only: empty groups are dropped below.
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = KMeans(number, n_init=starts, random_state=seed)
        return np.asarray(model.fit_predict(points), dtype=np.intp)


def _prediction_errors(here: Points, there: Points, labels: Labels) -> Floats:
    """Return the squared error of predicting the other half of each point by one half's centres."""
    _, places = np.unique(labels, return_inverse=True)
    error = there - _means(here, labels)[places]
    return np.asarray(np.vecdot(error, error), dtype=np.float64)


def _means(points: Points, labels: Labels) -> Points:
    """Return the centres of the groups that have points."""
    means = [points[labels == k].mean(axis=0, dtype=np.float64) for k in np.unique(labels)]
    return np.array(means, dtype=np.float32).reshape(-1, points.shape[-1])


def _choose(tried: list[_Candidate], noise: Floats, min_share: float) -> _Candidate | None:
    """Return the largest number of groups that is worth it, or else the first number."""
    if not tried:
        return None
    chosen = tried[0]
    for candidate in tried[1:]:
        more = candidate.number - chosen.number
        gain = chosen.errors - candidate.errors
        unexplained = float((chosen.errors - noise).mean())
        worth = max((1 - (1 - _WORTH) ** more) * unexplained, _SURE * _standard_error(gain))
        if candidate.smallest >= min_share and gain.mean() > worth:
            chosen = candidate
    return chosen


def _standard_error(values: Floats) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.inf


def ratio(part: npt.ArrayLike, whole: npt.ArrayLike) -> Floats:
    """Return a part over the whole; NaN where the whole is 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(whole) > 0, np.divide(part, whole), np.nan)
