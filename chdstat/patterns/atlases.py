"""Atlas: the shapes that recur over a scene, found without labels.

`chdstat.classify` asks each pixel for patterns that are known beforehand; `atlas` asks the image
which distributions it has. Pixels that differ only in brightness have the same shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, generator
from chdstat._core.positive import Counts, Floats
from chdstat._core.reasons import Reason, flag_attributes
from chdstat._core.resampling import wilson
from chdstat.errors import InputError
from chdstat.patterns import atlas_shapes
from chdstat.patterns.clusters import Groups, find_groups
from chdstat.samples import Image, samples_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Atlas", "atlas"]

_RADIANCE = "W sr-1 m-2"
_NULL_DECADES = 1.0
"""A share of nulls that differs by d is as far as distributions that differ by d over a decade."""
_LABELS = {
    "labels": (("y", "x"), "cluster of the shape, the most frequent first", "1"),
    "reason": (("y", "x"), "why there is no shape", "1"),
    "distance": (("y", "x"), "Cramer distance to the typical shape", "1"),
    "scale": (("y", "x"), "geometric mean of positive radiance", _RADIANCE),
    "density": (("cluster", "atlas_bin"), "typical density per decade", "1"),
    "density_band": (("cluster", "atlas_bin", "bound"), "quartiles of the density", "1"),
    "share": (("cluster",), "share of the pixels that have a shape", "1"),
    "share_interval": (("cluster", "bound"), "Wilson interval of the share", "1"),
    "null_share": (("cluster",), "mean share of nulls", "1"),
    "medoids": (("cluster", "place"), "row and column of the most typical pixel", "1"),
    "explained": (("candidate",), "share of the repeatable variation explained", "1"),
    "silhouettes": (("candidate",), "mean silhouette", "1"),
}


@dataclass(frozen=True)
class Atlas:
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
        clusters = range(len(self.share))
        dataset["atlas_labels"].attrs.update(
            flag_values=[-1, *clusters],
            flag_meanings=" ".join(["none", *(f"shape_{k + 1}" for k in clusters)]),
        )
        dataset["atlas_reason"].attrs.update(flag_attributes())
        return dataset


def atlas(
    samples: Image | npt.ArrayLike | xr.Dataset,
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
    ``sqrt(integral (F - G)^2)`` apart, the Cramér distance, and are grouped by k-means.

    How many groups there are is decided by prediction. The samples of each pixel are halved at
    random; the typical shapes found in one half predict the other half. A number of clusters
    explains ``(E1 - Ek) / (E1 - E)`` of the repeatable variation, with the mean squared error E1 of
    one cluster, Ek of k clusters, and E of the true shape of each pixel: half the squared distance
    of its halves. One more cluster is worth it if it explains a tenth or more of what is still
    unexplained, and gains three standard errors or more. Clusters that follow noise predict worse
    than none. Where shapes pass into each other, as on real surfaces, the number is a resolution,
    not a count of kinds, and grows with the number of samples; `silhouettes` tell.

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
        Pixels with fewer than 32 positive samples, or equal ones, have no shape and say why.

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
    _check(clusters, max_clusters, min_share)
    rng = generator(seed)
    if hasattr(samples, "data_vars"):
        shapes = atlas_shapes.of_histograms(cast("xr.Dataset", samples), rng)
    else:
        image = samples_of(cast("npt.ArrayLike", samples))
        shapes = atlas_shapes.of_samples(image, rng, progress=progress)
    ok = shapes.reason == Reason.OK
    whole, *halves = (_features(part, ok, nulls) for part in (shapes.whole, *shapes.halves))
    numbers = range(1, max_clusters + 1) if clusters is None else [clusters]
    groups = find_groups(whole, halves, numbers, min_share=min_share, rng=rng)
    return _describe(shapes, groups)


def _check(clusters: int | None, max_clusters: int, min_share: float) -> None:
    for name, value in (("clusters", clusters), ("max_clusters", max_clusters)):
        if value is not None and value < 1:
            message = f"{name} must be at least 1, got {value}"
            raise InputError(message)
    if not 0 <= min_share < 1:
        message = f"min_share must be a share in [0, 1), got {min_share}"
        raise InputError(message)


def _features(
    part: atlas_shapes.Aligned, ok: npt.NDArray[Any], nulls: bool
) -> npt.NDArray[np.float32]:
    """Return vectors, shape (pixel, feature), that are as far apart as their shapes."""
    rows = np.sqrt(atlas_shapes.WIDTH) * part.cumulative[ok]
    if nulls:
        share = np.sqrt(_NULL_DECADES) * part.null_share[ok]
        rows = np.concatenate([rows, share[:, np.newaxis]], axis=-1)
    return np.asarray(rows, dtype=np.float32)


def _describe(shapes: atlas_shapes.Shapes, groups: Groups) -> Atlas:
    ok = shapes.reason == Reason.OK
    count = np.bincount(groups.labels, minlength=groups.number)
    members = [groups.labels == k for k in range(groups.number)]
    density = atlas_shapes.densities(shapes.whole.cumulative[ok])
    null_share = shapes.whole.null_share[ok]
    bands = [np.percentile(density[rows], (25, 75), axis=0).T for rows in members]
    bins = density.shape[-1]
    return Atlas(
        positions=atlas_shapes.WIDTH * (np.arange(bins) - (bins - 1) / 2),
        density=np.array([density[rows].mean(axis=0) for rows in members]).reshape(-1, bins),
        density_band=np.array(bands).reshape(-1, bins, 2),
        labels=_scatter(groups.labels.astype(np.int16), ok, np.int16(-1)),
        reason=shapes.reason,
        distance=_scatter(groups.distance, ok, np.nan),
        scale=10.0**shapes.log_scale,
        share=count / max(1, count.sum()),
        share_interval=wilson(count, count.sum()),
        null_share=np.array([null_share[rows].mean(dtype=np.float64) for rows in members]),
        medoids=np.argwhere(ok)[groups.medoids],
        candidates=groups.candidates,
        explained=groups.explained,
        silhouettes=groups.silhouettes,
        repeatable=groups.repeatable,
        stability=groups.stability,
    )


def _scatter(values: npt.NDArray[Any], ok: npt.NDArray[np.bool_], missing: Any) -> npt.NDArray[Any]:
    whole = np.full(ok.shape, missing, dtype=values.dtype)
    whole[ok] = values
    return whole
