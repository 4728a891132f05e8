"""Atlas: the shapes that recur over a scene, found without labels.

`chdstat.classify` looks for patterns that are known beforehand; `atlas` finds the distributions
that an image has. The shape of a pixel is the distribution of its log radiance, moved so that its
mean is 0: pixels that differ only in brightness have the same shape. Shapes are found in samples,
read twice in constant memory, for means and for counts around them; or in log histograms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Array,
    Counts,
    Floats,
    Mask,
    Seed,
    generator,
    is_bad,
    luminance,
    spans,
    whole,
)
from chdstat._core.display import Card, Shown, each, number, percent, with_interval
from chdstat._core.moments import Moments
from chdstat._core.positive import CONSTANT_SPREAD
from chdstat._core.reasons import first_of, flag_attributes, place_attributes
from chdstat._core.resampling import wilson
from chdstat.errors import InputError, Reason
from chdstat.patterns.clusters import Groups, find_groups, ratio
from chdstat.samples import ImageLike, Mapped, SampleBlocks, Samples, reduce_tiles, samples_of
from chdstat.samples.tiles import Work
from chdstat.summary.histograms import Histogram, StreamingHistogram, Support

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["WIDTH", "Atlas", "atlas", "of_histograms"]

_BINS = 81
"""Bins of a shape; the middle one has the mean in its centre."""
WIDTH = 0.1
"""Width of a bin in decades."""
_EDGES = WIDTH * (np.arange(1, _BINS) - _BINS / 2)
"""Edges between bins in decades from the mean; the two outer bins are open."""
_MINIMUM = 32
"""Positive samples that a shape needs."""
_FINE = 4
"""Bins counted per bin of a shape, so that halves of the samples can be moved separately."""
_BATCH = 64
_OF_GROUPS = ("candidates", "explained", "silhouettes", "repeatable", "stability")
_LABELS = {
    "labels": (("y", "x"), "cluster of the shape, the most frequent first", "1"),
    "reason": (("y", "x"), "why there is no shape", "1"),
    "distance": (("y", "x"), "Cramer distance to the typical shape", "1"),
    "scale": (("y", "x"), "geometric mean of positive radiance", "W sr-1 m-2"),
    "density": (("cluster", "atlas_bin"), "typical density per decade", "1"),
    "density_band": (("cluster", "atlas_bin", "bound"), "quartiles of the density", "1"),
    "share": (("cluster",), "share of the pixels that have a shape", "1"),
    "share_interval": (("cluster", "bound"), "Wilson interval of the share", "1"),
    "null_share": (("cluster",), "mean share of nulls", "1"),
    "medoids": (("cluster", "place"), "row and column of the most typical pixel", "1"),
    "explained": (("candidate",), "share of the repeatable variation explained", "1"),
    "silhouettes": (("candidate",), "mean silhouette", "1"),
}


@dataclass(frozen=True, repr=False)
class Atlas(Shown):
    """Shapes that recur over an image, the most frequent first.

    Attributes
    ----------
    positions
        Centres of the bins in decades from the scale of a pixel, log10(x / scale), shape (bin,).
        The outer two bins hold what lies beyond them.
    density, density_band
        Mean density per decade over the pixels of each cluster, shape (cluster, bin), and the
        lower and upper quartile over them, shape (cluster, bin, 2).
    labels
        Cluster of each pixel, shape (y, x); -1 where there is no shape.
    reason
        `Reason` codes: why there is none.
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
        Share of the repeatable variation that each number explains, shape (candidate,); NaN where
        nothing repeats.
    silhouettes
        Mean silhouette of each number, shape (candidate,), in [-1, 1]; NaN for one cluster.
    repeatable
        Share of the variation between the shapes of half the samples that the other half repeats;
        the rest is noise.
    stability
        Adjusted Rand index between the labels that the two halves of the samples give: 1 if every
        pixel keeps its company, 0 as by chance.
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
        return Card(f"Atlas of {len(self.share)} shapes", {
            "share of the pixels": each(with_interval, self.share, *self.share_interval.T),
            "share of nulls": self.null_share,
            "typical pixels": self.medoids,
            "repeatable, stability": f"{percent(self.repeatable)}, {number(self.stability)}",
        })  # fmt: skip

    def to_dataset(self) -> xr.Dataset:
        """Return the fields with names, units and dims, each variable prefixed ``atlas_``."""
        import xarray as xr

        variables = {
            f"atlas_{name}": (dims, getattr(self, name), {"long_name": long_name, "units": units})
            for name, (dims, long_name, units) in _LABELS.items()
        }
        decades = {"long_name": "decades from the scale of the pixel", "units": "1"}
        dataset = xr.Dataset(
            variables,
            coords={
                "atlas_bin": ("atlas_bin", self.positions, decades),
                "candidate": self.candidates,
                "y": np.arange(self.labels.shape[0]),
                "x": np.arange(self.labels.shape[1]),
            },
            attrs={"atlas_stability": self.stability, "atlas_repeatable": self.repeatable},
        )
        shapes = [f"shape_{k + 1}" for k in range(len(self.share))]
        dataset["atlas_labels"].attrs.update(place_attributes(shapes))
        dataset["atlas_reason"].attrs.update(flag_attributes())
        return dataset


def atlas(
    samples: ImageLike | npt.ArrayLike | xr.Dataset,
    *,
    clusters: int | None = None,
    max_clusters: int = 12,
    min_share: float = 0.005,
    nulls: bool = False,
    seed: Seed = 0,
    progress: bool | None = None,
) -> Atlas:
    """Find the shapes of distributions that recur over an image.

    The shape of a pixel is the distribution of ``log10(x / scale)`` of its positive samples x, with
    their geometric mean as the scale. Shapes with distribution functions F and G are
    at the distance ``sqrt(integral (F - G)^2)``, Cramér's, and are grouped by k-means.

    How many groups there are is decided by prediction. The samples of each pixel are halved at
    random; the typical shapes found in one half predict the other half. A number of clusters
    explains ``(E1 - Ek) / (E1 - E)`` of the repeatable variation, with the mean squared error E1 of
    one cluster, Ek of k clusters, and E of the true shape of each pixel: half the squared distance
    of its halves. One more cluster is worth it if it explains a tenth or more of what is still
    unexplained, and gains three standard errors or more. Clusters that follow noise predict worse
    than none. Where shapes pass into each other, as on real surfaces, the number is a resolution,
    not a count of kinds, and grows with the number of samples; `silhouettes` show it.

    Parameters
    ----------
    samples
        An image, of which the luminance is taken: `Samples`, an array (y, x, channel, sample), or
        the path of a store; or its log histograms, as
        `chdstat.histogram` returns them, of which the channel in the middle is taken: green.
        Histograms lose where a sample lies within its bin, and what is outside their support.
    clusters
        How many; None decides as above.
    max_clusters
        Largest number that is tried.
    min_share
        Smallest share of a cluster in a number that is chosen.
    nulls
        Whether the share of nulls is part of the shape. A share that differs by d counts as a
        distribution function that differs by d over one decade.
    seed
        Of the halves, of the start of k-means, and of the 4096 pixels at most that it learns from.
    progress
        For `Samples`: show a progress bar; None shows it on a terminal.

    Returns
    -------
    Atlas
        Pixels with fewer than 32 positive samples, or equal ones, have no shape but a reason.

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
    # Vectors, shape (pixel, part, feature), that are as far apart as their shapes.
    rows = np.sqrt(WIDTH) * shapes.cumulative[ok]
    if nulls:
        rows = np.concatenate([rows, shapes.null_share[ok][..., np.newaxis]], axis=-1)
    points, *halves = np.moveaxis(rows.astype(np.float32), 1, 0)
    numbers = range(1, most + 1) if clusters is None else [clusters]
    groups = find_groups(points, halves, numbers, min_share=min_share, rng=rng)
    return _describe(shapes, groups)


def _describe(shapes: Shapes, groups: Groups) -> Atlas:
    ok = shapes.reason == Reason.OK
    count = np.bincount(groups.labels, minlength=groups.number)
    members = [groups.labels == k for k in range(groups.number)]
    cumulative = shapes.cumulative[ok][:, 0].astype(np.float64)
    density = np.diff(cumulative, axis=-1, prepend=0, append=1) / WIDTH
    null_share = shapes.null_share[ok][:, 0]
    labels, distance = np.full(ok.shape, -1, np.int16), np.full(ok.shape, np.nan)
    labels[ok], distance[ok] = groups.labels, groups.distance
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
        medoids=np.argwhere(ok)[groups.medoids],
        **{name: getattr(groups, name) for name in _OF_GROUPS},
    )


@dataclass(frozen=True)
class Shapes:
    """Distributions of log10 radiance around their means, of an image.

    Attributes
    ----------
    cumulative
        Share of the positive samples below each edge, shape (y, x, part, edge): of all samples, and
        of two random halves of them, each moved by its own mean; NaN where there is no shape.
    null_share
        Share of nulls among all of them, shape (y, x, part).
    log_scale
        Mean of log10 radiance, shape (y, x).
    reason
        `Reason` codes: where there is no shape, and why.
    """

    cumulative: npt.NDArray[np.float32]
    null_share: npt.NDArray[np.float32]
    log_scale: Floats
    reason: npt.NDArray[np.int8]


def _of_samples(
    samples: Samples, rng: np.random.Generator, *, progress: bool | None = None
) -> Shapes:
    """Return the shapes of the luminance of an image."""

    def of_tile(tile: Samples, blocks: SampleBlocks) -> Mapped:
        log, n_good, n_null = _log_moments(blocks)
        center = np.where(log.count > 0, log.mean, np.nan)
        counts = _count((tile.read(ss=ss) for ss in spans(tile.spp, _BATCH)), center)
        log_variance = log.m2 / np.maximum(log.count, 1) * np.log(10) ** 2
        reason = _reason(log.count, n_good, n_null, log_variance)
        # Counts are around the centre already.
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
    """Return the shapes of the log histograms of an image, of the channel in the middle.

    That is green, the most of luminance, or the only channel. Bins move by fractions of a bin.

    Raises
    ------
    InputError
        If the dataset lacks a variable of a log histogram.
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
    """Where bins of log10 radiance are: the first edge and the width, each of shape (...)."""

    low: Floats
    width: Floats

    def mean(self, counts: npt.NDArray[Any]) -> Floats:
        """Return the mean of what was counted, shape (...); NaN of nothing."""
        places = np.vecdot(counts, np.arange(counts.shape[-1]) + 0.5)
        return np.asarray(self.low + self.width * ratio(places, counts.sum(axis=-1)))

    def below(self, counts: npt.NDArray[Any], center: Floats) -> npt.NDArray[np.float32]:
        """Return the share below each edge of a shape around `center`, shape (..., edge)."""
        total = np.cumsum(counts, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros((*total.shape[:-1], 1)), total], axis=-1)
        total /= np.maximum(total[..., -1:], 1)
        offset = (center - self.low)[..., np.newaxis]
        # Rounded, so that an edge that is an edge of the bins stays one.
        place = np.round((_EDGES + offset) / self.width[..., np.newaxis], 9)
        place = np.clip(np.nan_to_num(place), 0, counts.shape[-1])
        left = np.minimum(place.astype(np.intp), counts.shape[-1] - 1)
        start, stop = (np.take_along_axis(total, i, axis=-1) for i in (left, left + 1))
        return np.asarray(start + (place - left) * (stop - start), dtype=np.float32)


def _log_moments(blocks: SampleBlocks) -> tuple[Moments, Counts, Counts]:
    """Return the moments of log10 of positive luminance, and how many are good, and how many 0."""

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
    """Return the luminance of samples, 0 for bad ones, and which are good."""
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
    """Return shapes around `center`, and of random halves of the samples around their means."""
    # Samples are exchangeable: halving the counts at random is halving the samples at random.
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
