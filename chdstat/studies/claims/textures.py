"""Coloured textures: they move the log CHD and leave its shape alone (finding 7)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import Blocks, Interval, largest_of
from chdstat.studies.claims.glossy import SHIFT, channel_shift, pooled_distance
from chdstat.studies.log_chds import LogChds, aligned, same_shape, squared_distance
from chdstat.studies.outcomes import (
    ClaimTest,
    Outcome,
    PlotData,
    level_of,
    require,
    required,
)
from chdstat.studies.scene_data import PixelSet, SceneData, logs, slope_of

__all__ = ["measure"]

_CONTRAST = 0.1
"""Deviation of log10 albedo within a region, over pixels and channels, that a slope needs."""
_NO_SLOPE = 0.5
"""Slope of log relative variance on log albedo that counts as none: -2 is that of additive noise,
0 that of radiance times albedo; a quarter of the way does not matter."""


def measure(data: SceneData) -> Outcome:
    """Compare shapes of channels, of dark and pale surfaces, and relative variance with albedo."""
    needed = "first-hit albedo of each channel"
    albedo = required(data.feature("albedo"), needed)
    require(data.samples.shape[2] == albedo.shape[-1], needed)
    require(albedo.shape[-1] > 1, "several channels")
    patch, pair = _textured(data, albedo), _dark_and_pale(data, albedo)
    x, level = data.radiance(patch), level_of(4 if pair else 3)
    log_albedo = _less_region(patch, logs(patch.take(albedo)))
    good = np.isfinite(x)
    n = good.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(good, x, 0).sum(axis=-1) / n
        ratio = np.where(good, x / mean[..., np.newaxis] - 1, 0)
        variance = (ratio**2).sum(axis=-1) / (n - 1)
    log_variance = _less_region(patch, logs(variance))
    shift = channel_shift(x, patch.blocks, level=level)
    # Albedo has next to no noise that could flatten the slope.
    slope = slope_of(log_albedo, log_variance, patch.blocks, level=level)
    channels = _between_channels(aligned(x), patch.blocks, level)
    tests = [
        ClaimTest("shift between channels", shift, least=SHIFT, unit="decade"),
        same_shape("distance between the shapes of channels", channels),
        ClaimTest(
            "slope of log relative variance on log albedo", slope, least=-_NO_SLOPE, most=_NO_SLOPE
        ),
    ]
    if pair:
        shapes, blocks = [aligned(data.light(side)) for side in pair], [p.blocks for p in pair]
        distance = pooled_distance(shapes, blocks, level=level)
        tests.append(same_shape("distance between the shapes of dark and pale", distance))
    return Outcome(
        tuple(tests),
        details={"regions": list(patch.names), "pixels": len(patch)},
        plot_data=PlotData(
            "points",
            {
                channel: (log_albedo[:, i], log_variance[:, i])
                for i, channel in enumerate(data.samples.channels)
            },
            "log10 albedo around its region's mean",
            "log10 relative variance around its region's mean",
        ),
    )


def _textured(data: SceneData, albedo: Floats) -> PixelSet:
    """Return the textures, or else other surfaces, that have contrast enough."""
    shape, contrasty = albedo.shape[:2], []
    for region in data.regions:
        known = albedo[region.pixels(*shape)]
        known = known[known > 0]
        if known.size > 1 and np.log10(known).std() >= _CONTRAST:
            contrasty.append(region)
    textures = tuple(r for r in contrasty if r.phenomenon == "texture")
    surfaces = textures or tuple(r for r in contrasty if r.phenomenon in ("glossy", "diffuse"))
    require(surfaces, f"a region whose log10 albedo varies by {_CONTRAST} or more")
    return PixelSet.of(surfaces, *shape)


def _dark_and_pale(data: SceneData, albedo: Floats) -> tuple[PixelSet, ...]:
    """Return dark surfaces and the pale ones beside them; nothing without a pair of regions.

    They lie so close together that about the same light falls on both.
    """
    chosen = [region for region in data.regions if region.phenomenon == "albedo-contrast"]
    shape = albedo.shape[:2]
    pairs = [
        sorted(pair, key=lambda region: float(albedo[region.pixels(*shape)].mean()))
        for pair in zip(chosen[::2], chosen[1::2], strict=False)
    ]
    return tuple(PixelSet.of(side, *shape) for side in zip(*pairs, strict=True))


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
