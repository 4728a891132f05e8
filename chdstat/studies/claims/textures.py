"""Coloured textures: they move the log CHD and leave its shape alone (finding 7)."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import Blocks, Interval, largest_of
from chdstat.studies.claims.glossy import SHIFT, channel_shift, pooled_distance
from chdstat.studies.log_chds import SAME_SHAPE, LogChds, aligned, squared_distance
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of
from chdstat.studies.scene_data import PixelSet, SceneData, logs, slope_of

__all__ = ["CONTRAST", "NO_SLOPE", "measure"]

Floats = npt.NDArray[np.float64]

CONTRAST = 0.1
"""Deviation of log10 albedo within a region, over pixels and channels, that a slope needs."""
NO_SLOPE = 0.5
"""Slope of log relative variance on log albedo that counts as none: -2 is that of additive noise,
0 that of radiance times albedo; a quarter of the way does not matter."""
_PAIRED = "albedo-contrast"
_PARTS = 3


def measure(data: SceneData) -> Outcome:
    """Compare shapes of channels, of dark and pale surfaces, and relative variance with albedo."""
    albedo = data.feature("albedo")
    if albedo is None or data.samples.shape[2] != albedo.shape[-1]:
        return Outcome(missing=("needs first-hit albedo of each channel",))
    if albedo.shape[-1] < 2:
        return Outcome(missing=("needs several channels",))
    patch = _textured(data, albedo)
    if patch is None:
        return Outcome(missing=(f"needs a region whose log10 albedo varies by {CONTRAST} or more",))
    pair = _dark_and_pale(data, albedo)
    x, level = data.radiance(patch), level_of(_PARTS + (pair is not None))
    log_albedo, log_variance = _less_region(patch, logs(patch.take(albedo))), _relative(patch, x)
    parts = [
        ClaimTest.of(
            "shift between channels",
            channel_shift(x, patch.blocks, level=level),
            least=SHIFT,
            unit="decade",
        ),
        ClaimTest.of(
            "distance between the shapes of channels",
            _between_channels(aligned(x), patch.blocks, level),
            most=SAME_SHAPE,
            unit="decade^1/2",
        ),
        ClaimTest.of(
            "slope of log relative variance on log albedo",
            # Albedo has next to no noise that could flatten the slope.
            slope_of(log_albedo, log_variance, patch.blocks, level=level),
            least=-NO_SLOPE,
            most=NO_SLOPE,
        ),
    ]
    if pair is not None:
        dark, pale = (aligned(data.light(side)) for side in pair)
        distance = pooled_distance(dark, pale, pair[0].blocks, pair[1].blocks, level=level)
        name = "distance between the shapes of dark and pale"
        parts.append(ClaimTest.of(name, distance, most=SAME_SHAPE, unit="decade^1/2"))
    return Outcome(
        tuple(parts),
        details={"regions": list(patch.names), "pixels": len(patch)},
        plot_data=_plot_data(data.samples.channels, log_albedo, log_variance),
    )


def _textured(data: SceneData, albedo: Floats) -> PixelSet | None:
    """Return the textures, or else other surfaces, that have contrast enough."""
    for phenomena in (("texture",), ("glossy", "diffuse")):
        chosen = tuple(
            region
            for region in data.regions
            if region.phenomenon in phenomena
            and _contrast(albedo[region.pixels(*albedo.shape[:2])])
        )
        if chosen:
            return PixelSet.of(chosen, *albedo.shape[:2])
    return None


def _dark_and_pale(data: SceneData, albedo: Floats) -> tuple[PixelSet, PixelSet] | None:
    """Return dark surfaces and the pale ones beside them; None without a pair of regions.

    They lie so close together that about the same light falls on both.
    """
    chosen = [region for region in data.regions if region.phenomenon == _PAIRED]
    shape = albedo.shape[:2]
    pairs = [
        sorted(pair, key=lambda region: float(albedo[region.pixels(*shape)].mean()))
        for pair in zip(chosen[::2], chosen[1::2], strict=False)
    ]
    if not pairs:
        return None
    dark, pale = (PixelSet.of(side, *shape) for side in zip(*pairs, strict=True))
    return dark, pale


def _contrast(albedo: Floats) -> bool:
    known = albedo[albedo > 0]
    return bool(known.size > 1 and np.log10(known).std() >= CONTRAST)


def _relative(patch: PixelSet, x: Floats) -> Floats:
    """Return log10 of variance over squared mean, less the mean of its region."""
    good = np.isfinite(x)
    n = good.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(good, x, 0).sum(axis=-1) / n
        ratio = np.where(good, x / mean[..., np.newaxis] - 1, 0)
        variance = (ratio**2).sum(axis=-1) / (n - 1)
    return _less_region(patch, logs(variance))


def _less_region(patch: PixelSet, values: Floats) -> Floats:
    """Return values less the mean of their region: light differs from region to region."""
    means = np.array(list(patch.by_region(values).values()))
    return np.asarray(values - means[patch.region, np.newaxis])


def _between_channels(shapes: LogChds, blocks: Blocks, level: float) -> Interval[float]:
    """Return the largest distance between the mean shapes of two channels."""
    known = shapes.known.all(axis=1)
    kept = blocks[known]
    sums, count = kept.sums(shapes.halves[known]), kept.sums(np.ones(np.count_nonzero(known)))

    def squares(weights: Floats) -> Floats:
        n = (weights @ count)[:, np.newaxis, np.newaxis, np.newaxis]
        means = LogChds(np.tensordot(weights, sums, 1) / n)
        pairs = combinations(range(sums.shape[1]), 2)
        return np.stack([squared_distance(means[:, a], means[:, b]) for a, b in pairs], axis=-1)

    return largest_of(squares, kept, level=level).root()


def _plot_data(channels: tuple[str, ...], log_albedo: Floats, log_variance: Floats) -> PlotData:
    return PlotData(
        "points",
        {name: (log_albedo[:, c], log_variance[:, c]) for c, name in enumerate(channels)},
        "log10 albedo around its region's mean",
        "log10 relative variance around its region's mean",
    )
