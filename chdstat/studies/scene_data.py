"""Data of one scene, as the claims read them.

`SceneData` holds samples, regions, and the renders that claims compare them with. `PixelSet` holds
the pixels of regions, and returns statistics of values at these pixels, with intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.arrays import Array, Counts, Floats, Mask, generator, is_bad, luminance
from chdstat._core.image_scales import relative_scale
from chdstat._core.resampling import LEVEL, Blocks, Interval, interval_of, mean_of, quantile_of
from chdstat.analysis import analyze
from chdstat.inference.findings import level_of, require, required
from chdstat.patterns.film_splits import film_split, film_statistic
from chdstat.samples import Samples
from chdstat.samples.tiles import Region
from chdstat.studies.log_chds import LogChds, of_histograms
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

    from chdstat.comparison import Comparison

BSDF_SAMPLING = "BSDF sampling alone"
"""Integrator that finds lights by chance, where surfaces scatter light."""
DIRECT = "direct light, both"
"""Integrator that other ones of direct light are compared with."""
QUANTILES_NEED = 100
"""Positive samples that a quantile at 1 % or 99 % needs."""
_MOST_OF_IT = 0.5
"""Share of a pixel's variance that is most of it."""
_GUIDED_NEEDS = 64
"""Fewest samples of a pixel for tails and skewness."""


def largest_interval(
    intervals: Sequence[Interval[float]], needed: str, *, level: float
) -> Interval[float]:
    """Return the largest of the known intervals; its ends are the largest of simultaneous ends.

    Raises
    ------
    MissingDataError
        If none is known.
    """
    known = [interval for interval in intervals if math.isfinite(interval.value)]
    require(known, needed)
    value, low, high = (max(getattr(i, end) for i in known) for end in ("value", "low", "high"))
    return Interval(value, low, high, level)


def known_mean(values: Array) -> float:
    """Return the mean of the finite values; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def logs(values: Floats) -> Floats:
    """Return logarithms to base 10; NaN where they are not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log10(values)
    return np.asarray(np.where(np.isfinite(log), log, np.nan))


def positive_quantiles(x: Floats, levels: Sequence[float]) -> Floats:
    """Return quantiles of positive samples (pixel, sample), shape (level, pixel).

    NaN if there are fewer than `QUANTILES_NEED`. They are nearly median-unbiased for any
    distribution: definition 8 of Hyndman and Fan, "Sample quantiles in statistical packages", 1996,
    doi:10.1080/00031305.1996.10473566. `np.nanquantile` takes six times as long.
    """
    ordered = np.sort(np.where(x > 0, x, np.nan), axis=1)
    n = (x > 0).sum(axis=1)
    places = np.multiply.outer(levels, n + 1 / 3) - 2 / 3
    below = np.clip(np.floor(places), 0, n - 2).astype(int)
    low, high = (np.take_along_axis(ordered, (below + i).T, axis=1).T for i in (0, 1))
    return np.where(n >= QUANTILES_NEED, low + (places - below) * (high - low), np.nan)


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


def means_by_region(values: Floats, blocks: Blocks) -> Callable[[Floats], Floats]:
    """Return a function from weights of blocks to the mean of values (pixel,) over each region."""
    sums, count = blocks.sums(values), blocks.sums(np.ones(len(values)))
    member = (blocks.region[:, np.newaxis] == np.unique(blocks.region)).astype(np.float64)
    return lambda weights: ((weights * sums) @ member) / ((weights * count) @ member)


@dataclass(frozen=True)
class PixelSet:
    """Pixels of one region or several, one after the other.

    Statistics of values at the pixels have intervals over blocks; NaN is left out.

    Attributes
    ----------
    names
        Names of the regions.
    y, x
        Positions of the pixels, shape (pixel,).
    region
        Region of each pixel, shape (pixel,).
    blocks
        Blocks of the pixels, for resampling.
    level
        Coverage of the intervals.
    """

    names: tuple[str, ...]
    y: Counts
    x: Counts
    region: Counts
    blocks: Blocks
    level: float = LEVEL

    @classmethod
    def of(
        cls, regions: Sequence[Region], height: int, width: int, *, level: float = LEVEL
    ) -> PixelSet:
        """Return the pixels of regions of an image."""
        grids = [np.mgrid[region.pixels(height, width)] for region in regions]
        y, x = np.concatenate([grid.reshape(2, -1) for grid in grids], axis=1)
        region = np.repeat(np.arange(len(grids)), [grid[0].size for grid in grids])
        blocks = Blocks.join([Blocks.grid(*grid.shape[1:]) for grid in grids])
        return cls(tuple(region.name for region in regions), y, x, region, blocks, level)

    def __len__(self) -> int:
        """Return the number of pixels."""
        return len(self.y)

    def __getitem__(self, pixels: Any) -> PixelSet:
        """Return some of the pixels."""
        chosen = self.y[pixels], self.x[pixels], self.region[pixels], self.blocks[pixels]
        return PixelSet(self.names, *chosen, self.level)

    def take(self, image: Array) -> Array:
        """Return the values of the pixels of an image (y, x, ...), shape (pixel, ...)."""
        return image[self.y, self.x]

    def by_region(self, values: Array) -> dict[str, float]:
        """Return the mean of values (pixel, ...) over each region, NaN left out."""
        return {name: known_mean(values[self.region == i]) for i, name in enumerate(self.names)}

    def mean(self, values: Array) -> Interval[float]:
        """Return the mean of values (pixel, ...)."""
        return mean_of(values, self.blocks, level=self.level)

    def median(self, values: Array) -> Interval[float]:
        """Return the median of values (pixel, ...)."""
        return quantile_of(values, self.blocks, level=self.level)

    def interval(
        self,
        statistic: Callable[[Floats], Floats],
        bounds: tuple[float, float] = (-math.inf, math.inf),
    ) -> Interval[float]:
        """Return a statistic of weighted blocks; see `interval_of`."""
        return interval_of(statistic, self.blocks, level=self.level, bounds=bounds)

    def ratio(
        self, x: Floats, y: Floats, bounds: tuple[float, float] = (-math.inf, math.inf)
    ) -> Interval[float]:
        """Return the sum of x over the sum of y, shapes (pixel,), over the pixels with both."""
        known = np.isfinite(x + y)
        used = self if known.all() else self[known]
        above, below = used.blocks.sums(x[known]), used.blocks.sums(y[known])
        return used.interval(lambda w: (w @ above) / (w @ below), bounds)

    def slope(self, x: Floats, y: Floats, *, instrument: Floats | None = None) -> Interval[float]:
        """Return the slope of y on x, ``cov(y, z) / cov(x, z)``.

        With least squares, the instrument z is x itself; noise in x then flattens the slope. An
        instrument that follows x, but shares no noise with x and y, avoids this.

        Parameters
        ----------
        x, y
            Shape (pixel,) or (pixel, channel).
        instrument
            Shape of `x`; None for `x`.

        References
        ----------
        Durbin, "Errors in variables", 1954, doi:10.2307/1401917.
        """
        sums = self._sums(x, y, x if instrument is None else instrument)

        def slope(weights: Floats) -> Floats:
            n, a, b, c, ac, bc, *_ = (weights @ sums).T
            return np.asarray((bc - b * c / n) / (ac - a * c / n))

        return self.interval(slope)

    def correlation(self, x: Floats, y: Floats) -> Interval[float]:
        """Return Pearson's correlation of x and y, shapes as for `slope`."""
        sums = self._sums(x, y, x)

        def correlate(weights: Floats) -> Floats:
            n, a, b, _, aa, ab, bb = (weights @ sums).T
            spread = np.sqrt((aa / n - a**2 / n**2) * (bb / n - b**2 / n**2))
            return np.asarray((ab / n - a * b / n**2) / spread)

        return self.interval(correlate, (-1.0, 1.0))

    def _sums(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return number and sums of x, y, z, xz, yz, yy of each block, where all are known."""
        known = np.isfinite(x + y + z)
        x, y, z = (np.where(known, v, 0) for v in (x, y, z))
        columns = np.stack([known, x, y, z, x * z, y * z, y * y], axis=-1)
        return self.blocks.sums(columns.reshape(len(x), -1, columns.shape[-1]).sum(axis=1))


@dataclass(frozen=True)
class WithinPixels:
    """How much of the noise of an image is the picture changing within its pixels.

    Attributes
    ----------
    share
        Share of the relative variance: what as many strata of a pixel as samples take at most.
    pixels, held
        Share of the pixels in which it is more than half of the variance that samples show, by
        whole intervals, and of the noise in them.
    """

    share: Interval[float]
    pixels: float
    held: float


@dataclass(frozen=True)
class SceneData:
    """One scene: its samples, its regions, and the renders that they are compared with.

    Attributes
    ----------
    name
        Name of the scene; the expected share of nulls depends on it.
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
    guided
        The same scene and view by path guiding.
    adaptive
        The same scene and view with counts that differ between pixels, by another seed.
    given_shorter
        What `chdstat.summarize` returned for `shorter`; None to compute it when it is needed.
    comparison
        Comparison of estimators on this scene, including a learned one.
    complexity
        Any measure of the complexity of scenes; None takes the share of neighbouring pixels that
        see different surfaces.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat.samples import Region
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
    guided: Samples | None = None
    adaptive: Samples | None = None
    given_shorter: xr.Dataset | None = None
    comparison: Comparison | None = None
    complexity: float | None = None

    @property
    def renders(self) -> dict[str, Samples]:
        """The image and the other renders of this view by name, as far as there are any."""
        found = {
            "image": self.samples,
            "shorter_paths": self.shorter,
            "another_integrator": self.integrator,
            "spread_samples": self.spread,
            **self.integrators,
            "guided": self.guided,
            "adaptive": self.adaptive,
        }
        return {name: samples for name, samples in found.items() if samples is not None}

    @cached_property
    def analysis(self) -> xr.Dataset:
        """Everything per pixel."""
        return analyze(self.samples) if self.given is None else self.given

    @cached_property
    def summary(self) -> xr.Dataset:
        """Statistics and histograms per pixel, from the analysis where that is at hand."""
        if self.given is not None or "analysis" in self.__dict__:
            return self.analysis
        return summarize(self.samples)

    @cached_property
    def film_split(self) -> xr.Dataset | None:
        """Result of `chdstat.patterns.film_split`; None if it is unknown where samples fell."""
        prefix = "film_"
        known = self.given if self.given is not None else self.__dict__.get("analysis")
        if known is not None and f"{prefix}share" in known:
            own = {str(n): str(n).removeprefix(prefix) for n in known if str(n).startswith(prefix)}
            return known[list(own)].rename(own)
        return None if film_statistic(self.samples) is None else film_split(self.samples)

    @cached_property
    def within_pixels(self) -> WithinPixels | None:
        """How much of the noise is the picture changing within pixels; None if unknown."""
        if self.film_split is None:
            return None
        paths, places = self.split_of_noise
        sure = np.asarray(self.film_split["share_interval"].sel(bound="low") > _MOST_OF_IT).ravel()
        whole, total = np.nansum(paths + places), paths + places
        return WithinPixels(
            self.whole().ratio(places, total, (-math.inf, 1.0)),
            pixels=float(sure.mean()),
            held=float(np.nansum(total[sure]) / whole) if whole > 0 else math.nan,
        )

    @property
    def split_of_noise(self) -> tuple[Floats, Floats]:
        """Variance of paths and between places in the pixel, weighted as in relMSE, (pixel,).

        That between places is extrapolated to ever smaller cells.

        Raises
        ------
        MissingDataError
            If it is unknown where samples fell.
        """
        split = required(self.film_split, "where samples fell in their pixels (film=True)")
        mean = luminance(self.summary["mean"].to_numpy().astype(np.float64), channel_axis=-1)
        scale = relative_scale(mean)
        places = (split["places_limit"].to_numpy() / scale).ravel()
        return ((split["paths"] + split["places"]).to_numpy() / scale).ravel() - places, places

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
        return summarize(self.shorter)

    @cached_property
    def with_guided(self) -> tuple[SceneData, SceneData]:
        """The image and the guided one, with equally many samples, so that they can be compared.

        Raises
        ------
        MissingDataError
            If it was not rendered by path guiding, or in another size.
        """
        guided = required(
            self.guided, "the same scene by path guiding, by the LLVM or CUDA backend"
        )
        require(guided.shape[:3] == self.samples.shape[:3], "guided samples in the same size")
        least = min(self.samples.spp, guided.spp)
        require(least >= _GUIDED_NEEDS, f"{_GUIDED_NEEDS} guided spp, has {least}")
        one, two = (s.isel(sample=slice(0, least)) for s in (self.samples, guided))
        return SceneData(self.name, one), SceneData(self.name, two)

    @cached_property
    def chds(self) -> LogChds:
        """Distribution functions of all pixels, nulls counted, of the channel in the middle."""
        return of_histograms(self.summary)

    def patch(self, phenomenon: str, which: str, *, tests: int = 1) -> PixelSet:
        """Return the pixels of all regions that show a phenomenon.

        Parameters
        ----------
        phenomenon, which
            The phenomenon, and the words for the missing region.
        tests
            Number of tests of the claim, whose intervals are simultaneous.

        Raises
        ------
        MissingDataError
            If there is none; the message says `which` region is needed.
        """
        chosen = [region for region in self.regions if region.phenomenon == phenomenon]
        require(chosen, f"a region {which}")
        return PixelSet.of(chosen, *self.samples.shape[:2], level=level_of(tests))

    def whole(self, *, across: int = 8, tests: int = 1) -> PixelSet:
        """Return all pixels of the image, in reading order, in `across` x `across` blocks."""
        height, width = self.samples.shape[:2]
        y, x = np.mgrid[:height, :width].reshape(2, -1)
        blocks = Blocks.grid(height, width, across=across)
        return PixelSet(("image",), y, x, np.zeros_like(y), blocks, level_of(tests))

    def scattered(
        self, pixels: int, *, across: int = 8, tests: int = 1, allowed: Mask | None = None
    ) -> PixelSet:
        """Return pixels drawn from each of `across` x `across` blocks, which are read one by one.

        They are about `pixels` in all, among those `allowed`, shape (y, x); None draws from all.
        """
        rng, whole = generator(0), self.whole(across=across, tests=tests)
        block, count = whole.blocks.of_pixel, len(whole.blocks)
        possible = True if allowed is None else allowed.ravel()
        every = (rng.permutation(np.flatnonzero((block == i) & possible)) for i in range(count))
        some = np.concatenate([np.sort(here[: max(1, pixels // count)]) for here in every])
        blocks = Blocks(block[some], whole.blocks.region)
        return replace(whole, y=whole.y[some], x=whole.x[some], region=block[some], blocks=blocks)

    def radiance(self, patch: PixelSet) -> Floats:
        """Return the samples of a patch, shape (pixel, channel, sample).

        A sample with a bad channel is NaN in all channels.
        """
        x = np.empty((len(patch), *self.samples.shape[2:]))
        for i in np.unique(patch.region):
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

    @property
    def log_depth(self) -> Floats:
        """Natural logarithm of the first-hit depth, shape (y, x); 0 where there is no surface."""
        depth = np.asarray(self.samples.features["depth"], dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(np.log(depth), posinf=0, neginf=0)
