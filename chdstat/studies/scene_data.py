"""Data of one scene, as the claims read them.

`SceneData` holds samples, regions, and what else a claim compares them with; `PixelSet` holds the
pixels of regions. `ratio_of`, `slope_of` and `correlation_of` relate two quantities over such
pixels, with intervals; use an instrument where the explaining quantity is noisy.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Counts, Floats, Mask, generator, is_bad, luminance
from chdstat._core.resampling import LEVEL, Blocks, Interval, interval_of
from chdstat.analysis import analyze
from chdstat.rendering.recipes import Region
from chdstat.samples import Samples
from chdstat.studies.log_chds import LogChds, of_histograms
from chdstat.studies.outcomes import require
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.comparison import Comparison

__all__ = [
    "QUANTILES_NEED",
    "PixelSet",
    "SceneData",
    "correlation_of",
    "fold_of",
    "largest_interval",
    "logs",
    "positive_quantiles",
    "ratio_of",
    "slope_of",
]


def ratio_of(
    x: Floats,
    y: Floats,
    blocks: Blocks,
    *,
    level: float = LEVEL,
    bounds: tuple[float, float] = (-math.inf, math.inf),
) -> Interval[float]:
    """Return the sum of x over that of y, shapes (pixel,), of the pixels that have both."""
    known = np.isfinite(x + y)
    if not known.any():
        return Interval.unknown(level=level)
    used = blocks if known.all() else blocks[known]
    above, below = used.sums(x[known]), used.sums(y[known])
    return interval_of(lambda w: (w @ above) / (w @ below), used, level=level, bounds=bounds)


def slope_of(
    x: Floats, y: Floats, blocks: Blocks, *, instrument: Floats | None = None, level: float
) -> Interval[float]:
    """Return the slope of y on x, ``cov(y, z) / cov(x, z)``.

    Least squares take x itself for the instrument z. Noise in x flattens that slope; an instrument
    that follows x and shares no noise with x and y does not let it.

    Parameters
    ----------
    x, y
        Shape (pixel,) or (pixel, channel); NaN takes no part.
    blocks
        Blocks of the pixels.
    instrument
        Shape of `x`; None for `x`.
    level
        Coverage of the interval.

    References
    ----------
    Durbin, "Errors in variables", 1954, doi:10.2307/1401917.

    Examples
    --------
    >>> x = np.arange(64.0)
    >>> slope_of(x, 3 * x + 1, Blocks.grid(8, 8), level=0.95).value
    3.0
    """
    sums = _sums(x, y, x if instrument is None else instrument, blocks)

    def slope(weights: Floats) -> Floats:
        n, a, b, c, ac, bc, *_ = (weights @ sums).T
        return np.asarray((bc - b * c / n) / (ac - a * c / n))

    return interval_of(slope, blocks, level=level)


def correlation_of(x: Floats, y: Floats, blocks: Blocks, *, level: float) -> Interval[float]:
    """Return Pearson's correlation of x and y, shapes as for `slope_of`."""
    sums = _sums(x, y, x, blocks)

    def correlate(weights: Floats) -> Floats:
        n, a, b, _, aa, ab, bb = (weights @ sums).T
        spread = np.sqrt((aa / n - a**2 / n**2) * (bb / n - b**2 / n**2))
        return np.asarray((ab / n - a * b / n**2) / spread)

    return interval_of(correlate, blocks, level=level, bounds=(-1.0, 1.0))


def _sums(x: Floats, y: Floats, z: Floats, blocks: Blocks) -> Floats:
    """Return number and sums of x, y, z, xz, yz, yy of each block, where all are known."""
    known = np.isfinite(x + y + z)
    x, y, z = (np.where(known, v, 0) for v in (x, y, z))
    columns = np.stack([known, x, y, z, x * z, y * z, y * y], axis=-1)
    return blocks.sums(columns.reshape(len(x), -1, columns.shape[-1]).sum(axis=1))


def largest_interval(intervals: Sequence[Interval[float]]) -> Interval[float]:
    """Return the largest of several; its ends are the largest of ends that hold together."""
    value, low, high = (max(getattr(i, end) for i in intervals) for end in ("value", "low", "high"))
    return Interval(value, low, high)


def logs(values: Floats) -> Floats:
    """Return logarithms to base 10; NaN where they are not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log10(values)
    return np.asarray(np.where(np.isfinite(log), log, np.nan))


QUANTILES_NEED = 100
"""Positive samples that a quantile at 1 % or 99 % needs."""


def positive_quantiles(x: Floats, levels: Sequence[float]) -> Floats:
    """Return quantiles of positive samples (pixel, sample), shape (level, pixel).

    NaN of fewer than `QUANTILES_NEED` of them.
    """
    ordered = np.sort(np.where(x > 0, x, np.inf), axis=1)
    n = (x > 0).sum(axis=1)
    places = np.clip(np.ceil(np.multiply.outer(levels, n)) - 1, 0, None).astype(int)
    found = np.take_along_axis(ordered, places.T, axis=1).T
    return np.where(n >= QUANTILES_NEED, found, np.nan)


def fold_of(blocks: Blocks, *, across: int, folds: int) -> Counts:
    """Return the fold of each pixel for cross-validation; blocks of one fold do not touch.

    Parameters
    ----------
    blocks
        Blocks of the pixels, numbered in reading order.
    across
        Blocks along each side of the image.
    folds
        How many folds.
    """
    return np.asarray((blocks.of_pixel % across + 2 * (blocks.of_pixel // across)) % folds)


@dataclass(frozen=True)
class PixelSet:
    """Pixels of one region or several, one after the other.

    Attributes
    ----------
    names
        Of the regions.
    y, x
        Where the pixels are, shape (pixel,).
    region
        Region of each pixel, shape (pixel,).
    blocks
        Blocks of them to resample.
    """

    names: tuple[str, ...]
    y: Counts
    x: Counts
    region: Counts
    blocks: Blocks

    @classmethod
    def of(cls, regions: tuple[Region, ...], height: int, width: int) -> PixelSet:
        """Return the pixels of regions."""
        grids = [np.mgrid[region.pixels(height, width)] for region in regions]
        y, x = np.concatenate([grid.reshape(2, -1) for grid in grids], axis=1)
        region = np.repeat(np.arange(len(grids)), [grid[0].size for grid in grids])
        blocks = Blocks.join([Blocks.grid(*grid.shape[1:]) for grid in grids])
        return cls(tuple(region.name for region in regions), y, x, region, blocks)

    def __len__(self) -> int:
        """Return the number of pixels."""
        return len(self.y)

    def take(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the values of the pixels of an image (y, x, ...), shape (pixel, ...)."""
        return image[self.y, self.x]

    def by_region(self, values: npt.NDArray[Any]) -> dict[str, float]:
        """Return the mean of values (pixel, ...) over each region, NaN left out."""
        of_region = [values[self.region == i] for i in range(len(self.names))]
        known = [here[np.isfinite(here)] for here in of_region]
        means = [float(here.mean()) if here.size else float("nan") for here in known]
        return dict(zip(self.names, means, strict=True))


@dataclass(frozen=True)
class SceneData:
    """One scene, as far as it is known.

    Attributes
    ----------
    name
        Name of the scene: what is expected of nulls depends on it.
    samples
        The image.
    regions
        Named regions with the phenomenon that each shows.
    given
        What `chdstat.analyze` returned for these samples; None to compute it when it is needed.
    shorter
        The same scene and view at a smaller path length.
    integrator
        The same scene and view by another integrator.
    spread
        The same scene and view by a sampler that spreads samples, in sequences.
    integrators
        The same scene and view by integrators that sample paths in other ways, by name: those of
        `chdstat.study` with ``integrators=True``.
    given_shorter
        What `chdstat.summarize` returned for `shorter`; None to compute it when it is needed.
    comparison
        Estimators side by side on this scene, a learned one among them.
    complexity
        Any measure of how complex the scene is, the same for all scenes; None to take the share of
        neighbouring pixels that see different surfaces.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat.rendering.recipes import Region
    >>> samples = chd.simulate("gamma", shape=(8, 8), spp=64)
    >>> wall = Region("wall", "diffuse", (0, 0, 0.5, 0.5))
    >>> len(SceneData("simulated", samples, (wall,)).patch("diffuse", "of diffuse objects"))
    16
    """

    name: str
    samples: Samples
    regions: tuple[Region, ...] = ()
    given: xr.Dataset | None = None
    shorter: Samples | None = None
    integrator: Samples | None = None
    spread: Samples | None = None
    integrators: Mapping[str, Samples] = field(default_factory=dict)
    given_shorter: xr.Dataset | None = None
    comparison: Comparison | None = None
    complexity: float | None = None

    @cached_property
    def analysis(self) -> xr.Dataset:
        """Everything per pixel."""
        return analyze(self.samples, progress=False) if self.given is None else self.given

    @cached_property
    def summary(self) -> xr.Dataset:
        """Statistics and histograms per pixel, from the analysis where that is at hand."""
        if self.given is not None or "analysis" in self.__dict__:
            return self.analysis
        return summarize(self.samples, progress=False)

    @cached_property
    def batch_light(self) -> Floats:
        """Luminance of the means of batches of samples, shape (y, x, batch)."""
        means = self.summary["batch_means"].to_numpy().astype(np.float64)
        return np.asarray(luminance(means), dtype=np.float64)

    @cached_property
    def shorter_summary(self) -> xr.Dataset | None:
        """Statistics and histograms per pixel of the shorter paths."""
        if self.shorter is None or self.given_shorter is not None:
            return self.given_shorter
        return summarize(self.shorter, progress=False)

    @cached_property
    def chds(self) -> LogChds:
        """Distribution functions of all pixels, nulls counted, of the channel in the middle."""
        return of_histograms(self.summary)

    def patch(self, phenomenon: str, which: str) -> PixelSet:
        """Return the pixels of all regions that show a phenomenon.

        Raises
        ------
        MissingDataError
            If there is none; it says `which` region is needed.
        """
        chosen = tuple(region for region in self.regions if region.phenomenon == phenomenon)
        require(chosen, f"a region {which}")
        return PixelSet.of(chosen, *self.samples.shape[:2])

    def whole(self, across: int = 8) -> PixelSet:
        """Return all pixels of the image, in reading order, in `across` x `across` blocks."""
        height, width = self.samples.shape[:2]
        y, x = np.mgrid[:height, :width].reshape(2, -1)
        blocks = Blocks.grid(height, width, across=across)
        return PixelSet(("image",), y, x, np.zeros_like(y), blocks)

    def scattered(
        self, pixels: int, *, across: int = 8, allowed: Mask | None = None
    ) -> Iterator[PixelSet]:
        """Yield pixels drawn from each of `across` x `across` blocks, separately by block.

        About `pixels` in all, of those that are `allowed`, shape (y, x); None draws from all.
        """
        rng, whole = generator(0), self.whole(across)
        each = max(1, pixels // len(whole.blocks))
        possible = np.ones(len(whole), dtype=bool) if allowed is None else allowed.ravel()
        for block in range(len(whole.blocks)):
            here = np.flatnonzero((whole.blocks.of_pixel == block) & possible)
            some = np.sort(rng.permutation(here)[:each])
            if len(some):
                blocks = Blocks(np.full(len(some), block), whole.blocks.region)
                yield PixelSet((f"block {block}",), whole.y[some], whole.x[some], 0 * some, blocks)

    def radiance(self, patch: PixelSet) -> Floats:
        """Return the samples of a patch, shape (pixel, channel, sample).

        A sample with a bad channel is NaN in all channels.
        """
        x = np.empty((len(patch), *self.samples.shape[2:]))
        for i in range(len(patch.names)):
            here = patch.region == i
            ys, xs = patch.y[here], patch.x[here]
            top, left = int(ys.min()), int(xs.min())
            block = self.samples.read(slice(top, int(ys.max()) + 1), slice(left, int(xs.max()) + 1))
            x[here] = block[ys - top, xs - left]
        return np.where(is_bad(x).any(axis=-2, keepdims=True), np.nan, x)

    def light(self, patch: PixelSet) -> Floats:
        """Return the luminance of the samples of a patch, shape (pixel, sample); bad: NaN."""
        return np.asarray(luminance(self.radiance(patch)))

    def feature(self, name: str) -> Floats | None:
        """Return a first-hit feature (y, x) or (y, x, component); None without it."""
        image = self.samples.features.get(name)
        return None if image is None else np.asarray(image, dtype=np.float64)
