"""Checks of passes: what samples tell about the renderer that drew them.

Samples are compared with what independent samples of linear radiance must be, whatever the scene.
A bounded part of them is read. Values are made bounded before they are correlated, x / (x + m) with
the mean m of the pixel, so that fireflies decide nothing.

Statistics have a level at which chance alone gives a warning. A correlation of neighbours must be 8
of its standard errors from 0, where few and rare coincidences are no normal distribution; a ratio
of variances 6 of its errors from 1. Either must also be large enough to matter. By the normal
distribution, all of these together warn in one of 10^8 right recordings.

What cannot be told: a clamp that hardly any sample reaches, an average of a few samples, and a
filter that moves samples instead of weighting them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image, spans
from chdstat.samples import Samples
from chdstat.samples.dependence import repeats_in
from chdstat.samples.film_steps import unevenness
from chdstat.samples.tiles import TILE

_MOST, _MOST_PASSES = 2**23, 512
"""Most values and passes that are read."""
_FEWEST, _FEW_PIXELS = 8, 32
"""Fewest passes and pixels that tell whether passes or pixels depend on each other."""
_FAR, _SURELY = 8.0, 6.0
"""Standard errors from 0 or 1."""
_CORRELATED, _RATIOS = 0.05, (0.8, 1.25)
"""Correlation of neighbours, and ratios of variances, that matter."""
_ACCUMULATES = (
    "each pass holds those before it: the renderer accumulates. Return single passes: clear its "
    "image before each, or return differences of its sums"
)
_PIXELS, _TIES = 5, 8
"""Fewest pixels and samples that a clamp has left at one level."""


@np.errstate(all="ignore")
def findings(samples: Samples) -> list[str]:
    """Return what makes passes no independent samples of linear radiance, and what to set."""
    tiles = [*_read(samples)]
    bad = np.concatenate([(~np.isfinite(tile)).any(axis=2).ravel() for tile in tiles])
    found = _bad(bad)
    tiles = [np.where(np.isfinite(tile), tile, np.float32(0)) for tile in tiles]
    if not bad.all() and not any(tile.any() for tile in tiles):
        return [*found, "every sample is black: check lights, camera and exposure"]
    colors = [tile[:, :, :3] if samples.shape[2] == 4 else tile for tile in tiles]
    values = np.concatenate([c.reshape(-1, *c.shape[2:]) for c in colors])  # (pixel, channel, s)
    repeated = repeats_in(samples.read, samples.shape)
    found += [repeated] if repeated else []
    if samples.film is not None:
        places = [np.moveaxis(tile, 2, 0).reshape(2, -1) for tile in _read(samples.film)]
        uneven = unevenness(np.concatenate(places, axis=1))
        found += [uneven] if uneven else []
    encoded = _encoded(values)
    found += [*_alpha(tiles), *encoded, *_negative(values)]
    if repeated:
        return found
    return [*found, *([] if encoded else _clamped(colors)), *_dependent(colors)]


def _read(samples: Samples) -> Iterator[Image]:
    """Yield tiles of samples, (y, x, channel, sample), that are spread over image and passes."""
    height, width, channels, spp = samples.shape
    number = min(spp, _MOST_PASSES)
    places = [(y, x) for y in spans(height, TILE) for x in spans(width, TILE)]
    most = max(_MOST // (channels * number * TILE**2), 1)
    chosen = np.linspace(0, len(places) - 1, min(most, len(places))).astype(int)
    for i in sorted({*chosen.tolist()}):
        ys, xs = places[i]
        first = samples.read(ys, xs, slice(number - number // 2))
        last = samples.read(ys, xs, slice(spp - number // 2, spp))
        yield np.concatenate([first, last], axis=-1)


def _bad(bad: npt.NDArray[np.bool_]) -> list[str]:
    if not bad.any():
        return []
    return [
        f"{bad.mean():.2g} of the samples are NaN or infinite; they are kept, counted and left "
        "out of results. Look for the material, light or camera that gives them"
    ]


def _alpha(tiles: list[Image]) -> list[str]:
    channels = tiles[0].shape[2]
    last = np.concatenate([tile[:, :, -1].ravel() for tile in tiles])
    whole = (last == 0) | (last == 1)
    if channels not in (2, 4) or last.min() < 0 or last.max() > 1 or whole.mean() < 0.9:
        return []
    return [
        f"the last of {channels} channels is 0 or 1, as an alpha channel: return radiance alone, "
        f"image[..., :{channels - 1}]"
    ]


def _encoded(values: Image) -> list[str]:
    """Tell values of 8 bits, as they are or decoded from sRGB."""
    lit = values[(values != 0) & (values != 1)]
    if lit.size < 64 or lit.min() < 0:
        return []
    lit = lit[:: max(lit.size // 2**16, 1)].astype(float)
    levels = np.arange(256) / 255
    decoded = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    for table in (levels, levels * 255, decoded):
        above = np.clip(np.searchsorted(table, lit), 1, 255)
        codes = above - (lit - table[above - 1] < table[above] - lit)
        off = np.abs(table[codes] - lit)
        if len(np.unique(codes)) >= 8 and (off < 1e-5 * table[-1]).all():
            return [
                "all values are those of 8 bits: an image for a display, not radiance. Return the "
                "renderer's linear output as floating point, before tone mapping and gamma"
            ]
    return []


def _negative(values: Image) -> list[str]:
    below = values.sum(axis=1) < 0
    if below.sum() < _TIES or below.mean() < 1e-4:
        return []
    return [
        f"{below.mean():.2g} of the samples are negative, as lobes of a reconstruction filter "
        "are: set a box filter of one pixel (samples of control variates are right as they are)"
    ]


# --- clamps -------------------------------------------------------------------------------------


def _clamped(tiles: list[Image]) -> list[str]:
    """Tell a clamp of each channel, or of the sum of channels.

    A lamp or sky that is seen has one colour, and fills pixels or lies next to those it fills.
    """
    channels = tiles[0].shape[2]
    sums = [tile.astype(float).sum(axis=2, keepdims=True) for tile in tiles]
    for what, of_tiles in (("a channel", tiles), ("the sum of channels", sums)):
        for channel in range(of_tiles[0].shape[2]):
            levels = [tile[:, :, channel].astype(float) for tile in of_tiles]
            flat = np.concatenate([level.ravel() for level in levels])
            for level in _ties(flat) if of_tiles is sums and channels > 1 else [flat.max()]:
                if level > 0 and _stands_out(flat, level) and _is_clamp(tiles, levels, level):
                    return [
                        f"{what} is clamped at {level:.4g}: many samples end there. Turn the "
                        "clamps of direct and indirect light off, and tone mapping: return linear "
                        "radiance without an upper limit"
                    ]
    return []


def _ties(values: Floats) -> list[float]:
    """Return the largest value, and those that are most often the same up to rounding."""
    values = values[values > 0]
    if not values.size:
        return []
    keys = np.round(np.log(values) * 2**18).astype(np.int64)
    common, counts = np.unique(keys, return_counts=True)
    most = np.argsort(-counts)[:3]
    kept = common[most][counts[most] >= _TIES]
    return [float(values.max()), *np.exp(kept / 2**18).tolist()]


def _stands_out(values: Floats, level: float) -> bool:
    """Return whether more values are at a level than chance puts there, by those around it.

    Among 10^6 levels, no Poisson number of mean m is as large as 8 + 5 m (chance below 10^-3).
    Half floats and shared exponents have few values, each of which comes often.
    """
    off = np.abs(values / level - 1)
    at = int(np.count_nonzero(off < 1e-5))
    around = (np.count_nonzero(off < 1e-3) - at) / 99
    near = values[(off < 2e-2) & (off >= 1e-5)]
    often = len(near) / max(len(np.unique(near.astype(np.float32))), 1)
    return bool(at >= _TIES + 5 * max(around, often))


def _is_clamp(tiles: list[Image], levels: list[Floats], level: float) -> bool:
    """Return whether samples end at a level in many pixels that no lamp fills."""
    colors, below, others, pixels = list[Floats](), list[Floats](), list[Floats](), 0
    for tile, values in zip(tiles, levels, strict=True):
        at = np.abs(values - level) < 1e-5 * level
        share = np.pad(at.mean(axis=-1), 1)
        height, width = at.shape[:2]
        around = [share[y : y + height, x : x + width] for y in range(3) for x in range(3)]
        alone = at.any(axis=-1) & (np.max(around, axis=0) <= 0.5)
        pixels += int(alone.sum())
        of_pixels, color = values[alone], np.moveaxis(tile, 2, -1)[alone]
        under = (of_pixels >= level / 2) & (of_pixels < level * (1 - 1e-5))
        colors.append(color[at[alone]])
        below.append(of_pixels[under])
        others.append(color[under])
    ends, near = np.concatenate(colors), np.concatenate(below)
    if pixels < _PIXELS or len(ends) < _TIES:
        return False
    ratios, of_near = _hues(ends), _hues(np.concatenate(others))
    distinct, counts = np.unique(ratios, axis=0, return_counts=True)
    if len(distinct) >= max(len(ends) / 4, _TIES) and counts.max() <= len(ends) / 2:
        return True
    most = distinct[counts.argmax()]
    near_it = (np.abs(of_near - most) < 1e-3).all(axis=1)
    if np.ptp(most) >= 1e-3 and 2 * counts.max() > len(ends) and 2 * near_it.sum() < len(near):
        return False  # a lamp in mirrors or glass, which has a colour of its own
    is_top = all(values.max() <= level * (1 + 1e-5) for values in levels)
    # A heavy tail has as many samples in the octave below; they are of all values.
    many = len(near) >= max(len(ends) / 4, _TIES) and len(np.unique(near)) > len(near) / 2
    return is_top and many


def _hues(colors: Floats) -> Floats:
    """Return colours over their largest channel; those that differ by rounding are one."""
    return np.asarray(np.round(colors / np.maximum(colors.max(axis=1, keepdims=True), 1e-30), 4))


# --- dependence ---------------------------------------------------------------------------------


def _dependent(tiles: list[Image]) -> list[str]:
    spp = tiles[0].shape[3]
    bounded = [_bounded(tile) for tile in tiles]
    if spp < _FEWEST or sum((b.std(axis=-1) > 0).sum() for b in bounded) < _FEW_PIXELS:
        return []
    rows = np.concatenate([b.reshape(-1, spp) for b in bounded])
    found = _over_passes(rows[rows.std(axis=-1) > 1e-6])
    if found == [_ACCUMULATES]:  # which ties neighbours, too
        return found
    correlation, far = _neighbours(bounded)
    if far > _FAR and correlation > _CORRELATED:
        return [
            f"neighbouring pixels of a pass vary together (correlation {correlation:.2f}): set a "
            "box filter of one pixel, no denoiser, and random numbers that differ from pixel to "
            "pixel"
        ]
    return found or _averaged(tiles)


def _bounded(tile: Image) -> Floats:
    """Return brightness as bounded values, (y, x, sample)."""
    x = np.abs(tile).mean(axis=2, dtype=float)
    mean = x.mean(axis=-1, keepdims=True)
    return np.asarray(x / (x + np.where(mean > 0, mean, 1)))


def _neighbours(bounded: list[Floats]) -> tuple[float, float]:
    """Return the correlation of pixels side by side, and its standard errors from 0.

    That of differences of consecutive passes, so that no drift over passes counts.
    """
    best = (0.0, 0.0)
    for axis in (0, 1):
        of_pairs = []
        for tile in bounded:
            rest = np.diff(tile, axis=-1)
            size = np.sqrt((rest**2).mean(axis=-1, keepdims=True))
            rest = np.where(size > 1e-6, rest / np.where(size > 1e-6, size, 1), np.nan)
            ahead = np.moveaxis(rest, axis, 0)
            products = (ahead[1:] * ahead[:-1]).mean(axis=-1).ravel()
            of_pairs.append(products[np.isfinite(products)])
        products = np.concatenate(of_pairs)
        if len(products) >= _FEW_PIXELS:
            # Differences that share a pass depend on each other.
            chance = 1.5 / (bounded[0].shape[2] - 1)
            error = np.sqrt(max(products.var(), chance) / len(products))
            best = max(best, (float(products.mean()), float(products.mean() / error)))
    return best


def _over_passes(rows: Floats) -> list[str]:
    """Tell passes that depend on each other, by the variance of means of consecutive ones."""
    spp = rows.shape[1]
    blocks = 8 if spp >= 32 else 4
    size = spp // blocks
    rows = rows[:, : size * blocks]
    of_means = size * rows.reshape(-1, blocks, size).mean(axis=-1).var(axis=-1, ddof=1)
    within = rows.var(axis=-1, ddof=1)
    excess = (of_means - within) / within
    ratio = 1 + float(excess.mean())
    surely = abs(ratio - 1) / float(excess.std() / np.sqrt(len(excess)) + 1e-12)
    if surely < _SURELY or len(excess) < _FEW_PIXELS:
        return []
    if ratio < _RATIOS[0]:
        return [
            f"passes complement each other (variance of their means: {ratio:.2f} of that of "
            "independent ones): one sequence is spread over them. Set a sampler of independent "
            "random numbers, each pass with its own seed"
        ]
    if ratio < _RATIOS[1]:
        return []
    steps = np.diff(rows, axis=-1) ** 2
    half = steps.shape[1] // 2
    if steps[:, half:].mean() < steps[:, :half].mean() / 2:
        return [_ACCUMULATES]
    return [
        f"passes change with their number (variance of their means: {ratio:.3g} times that of "
        "independent ones): keep the frame, the time and the camera, and let only the seed differ"
    ]


def _averaged(tiles: list[Image]) -> list[str]:
    """Tell averages by distributions that are normal in nearly all pixels."""
    x = np.concatenate([tile.astype(float).reshape(-1, tile.shape[3]) for tile in tiles])
    spp, mean, size = x.shape[1], x.mean(axis=1), x.std(axis=1)
    noisy = size > 1e-3 * np.abs(mean)
    if spp < _FEW_PIXELS or noisy.sum() < _FEW_PIXELS or noisy.mean() < 0.5:
        return []
    z = (x[noisy] - mean[noisy, np.newaxis]) / size[noisy, np.newaxis]
    squares = z * z  # a power would take longer than the render
    skew = np.einsum("ps,ps->p", squares, z) / spp
    kurtosis = np.einsum("ps,ps->p", squares, squares) / spp - 3 * (spp - 1) / (spp + 1)
    normal = (np.abs(skew) < 0.2 + 2.5 * np.sqrt(6 / spp)) & (
        np.abs(kurtosis) < 0.3 + 2.5 * np.sqrt(24 / spp)
    )
    typical = abs(np.mean(skew)) < 0.3 and abs(np.mean(kurtosis)) < 0.4
    if not typical or normal.mean() < 0.9:
        return []
    return [
        "samples are normally distributed in nearly all pixels, as averages of many are: set one "
        "sample per pixel and pass, no adaptive sampling, no denoiser"
    ]
