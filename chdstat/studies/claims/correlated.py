"""Correlated samples: whether their average varies less than that of independent ones (finding 17).

Equation 4 of the paper bounds the variance of an average by that of independent samples: it holds
that samples which a sampler spreads over a pixel have negative covariances. Sequences of such a
sampler are replications of one average, and their samples have the distribution of independent
ones, so that one render shows both variances.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, generator, is_bad, luminance
from chdstat._core.resampling import Blocks, Interval, mean_of, q_values
from chdstat.patterns import Label
from chdstat.samples import Samples
from chdstat.samples.dependence import sequence_of
from chdstat.samples.tiles import tiles
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, require, required
from chdstat.studies.scene_data import PixelSet, SceneData, ratio_of

__all__ = ["measure", "p_of_independence", "variances"]

_LEAST = 8
"""Sequences that a variance of averages needs."""
_MOST = 32
"""Sequences of a pixel that are tested, at most."""
_TESTED = 512
"""Pixels that are tested one by one."""
_SHUFFLES = 999
_ALPHA = 0.05
_RELATIVE = 0.01
"""Share of the mean radiance of the image, squared, that is added to squared means: that of
relMSE."""
_ROUNDING = 1e-9


def measure(data: SceneData) -> Outcome:
    """Compare the variance of averages of spread samples with that of as many independent ones."""
    spread = required(
        data.spread,
        "the same scene rendered by a sampler that spreads samples, as a study does with sampler=",
    )
    length = sequence_of(spread.attrs)
    require(length > 1, "samples in sequences, which are marked by attrs['sequence']")
    count = spread.spp // length
    require(count >= _LEAST, f"{_LEAST} sequences of {length} samples, has {count}")
    require(spread.shape[:3] == data.samples.shape[:3], "spread samples in the same size")
    found = variances(spread)
    pixels = data.whole()
    ratio = _ratio(found, np.arange(len(pixels)), pixels.blocks)
    regions = {
        region.name: PixelSet.of((region,), *data.samples.shape[:2]) for region in data.regions
    }
    width = data.samples.shape[1]
    by_region = {
        name: _ratio(found, patch.y * width + patch.x, patch.blocks)
        for name, patch in regions.items()
    }
    tested = _tested(data, spread, length)
    sampler = spread.attrs.get("sampler", "spreading")
    name = f"variance of an average of {length} over that of independent samples ({sampler})"
    return Outcome(
        (ClaimTest(name, ratio, most=1.0),),
        p_value=tested.pop("p_value"),
        details={
            "null_hypothesis": "samples of a sequence are independent in every pixel (shuffled "
            "within pixels, alike in all)",
            "sequences": count,
            **tested,
            "ratio_by_region": {n: i.to_dict() for n, i in by_region.items()},
            "ratio_by_pattern": {
                n: i.to_dict() for n, i in _by_pattern(data, found, pixels).items()
            },
        },
        plot_data=PlotData.bars(
            {n: i.value for n, i in ({"image": ratio} | by_region).items()}, "ratio of variances"
        ),
        few="sequences",
    )


def variances(spread: Samples) -> Floats:
    """Return variances of the luminance of a pixel, relative to its squared mean.

    Let B be n times the variance of averages of n samples, and W the variance within sequences.
    Whatever the correlation of samples, (B + (n - 1) W) / n is the variance of a single one without
    bias; of independent samples B is, too. A firefly adds as much to both.

    Parameters
    ----------
    spread
        Samples in sequences.

    Returns
    -------
    ndarray
        B and the variance of a single sample, shape (2, pixel); NaN in pixels with a bad sample.

    Examples
    --------
    >>> x = np.random.default_rng(0).random((4, 4, 1, 4096))
    >>> averages, single = variances(Samples.from_array(x, sequence=16)).mean(axis=1)
    >>> bool(abs(averages / single - 1) < 0.1)
    True
    """
    length = sequence_of(spread.attrs)
    count = spread.spp // length
    height, width = spread.shape[:2]
    of_means, single, mean = np.empty((3, height, width))
    for ys, xs in tiles(spread.shape):
        x = _sequences(spread.read(ys, xs, slice(0, count * length)), length)
        with np.errstate(invalid="ignore", over="ignore"):
            means = x.mean(axis=-1)
            mean[ys, xs] = means.mean(axis=-1)
            of_means[ys, xs] = length * means.var(axis=-1, ddof=1)
            within = x.var(axis=-1, ddof=1).mean(axis=-1)
        single[ys, xs] = (of_means[ys, xs] + (length - 1) * within) / length
    known = mean[np.isfinite(mean)]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        unit = mean**2 + _RELATIVE * (known.mean() if known.size else np.nan) ** 2
        found = np.stack([of_means, single]) / unit
    return np.where(np.isfinite(found), found, np.nan).reshape(2, -1)


def p_of_independence(x: Floats) -> tuple[Floats, float]:
    """Return p-values that samples of a sequence are independent, from both sides.

    Independent samples may be put into sequences in any order: the variance of the averages is
    compared with that of shuffled samples, which makes the p-value exact, with any tail and nulls.
    All pixels are shuffled alike, so that the p-value of their sum is exact, too.

    Parameters
    ----------
    x
        Samples, shape (pixel, sequence, sample).

    Returns
    -------
    ndarray, float
        Of each pixel, shape (pixel,), NaN where all samples are equal or one is bad; and of the sum
        over pixels of the variances of averages over those of samples.

    References
    ----------
    Phipson and Smyth, "Permutation p-values should never be zero", 2010,
    doi:10.2202/1544-6115.1585.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> strata = rng.permuted(np.tile(np.arange(16), (2, 8, 1)), axis=-1)
    >>> p_of_independence(np.stack([strata[0] / 16, rng.random((8, 16))]))[0] < 0.01
    array([ True, False])
    """
    rng, flat = generator(0), x.reshape(len(x), -1)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        flat = flat - flat.mean(axis=1, keepdims=True)
        flat = flat / np.abs(flat).max(axis=1, keepdims=True, initial=0)  # no square is too large
        flat = flat / np.sqrt((flat**2).sum(axis=1, keepdims=True))
    known = np.isfinite(flat).all(axis=1)
    flat, shape = flat[known], x[known].shape

    def spread_of(values: Floats) -> Floats:
        """Return what each pixel has, and behind it their sum."""
        found = (values.reshape(shape).sum(axis=-1) ** 2).sum(axis=-1)
        return np.append(found, found.sum())

    own = spread_of(flat)
    room = _ROUNDING * np.maximum(own, 1)
    lower, higher = np.ones((2, len(own)))
    for _ in range(_SHUFFLES):
        other = spread_of(flat[:, rng.permutation(flat.shape[1])])
        lower += other <= own + room
        higher += other >= own - room
    p = np.full(len(x), np.nan)
    both = np.minimum(2 * np.minimum(lower, higher) / (_SHUFFLES + 1), 1)
    p[known] = both[:-1]
    return p, float(both[-1]) if known.any() else np.nan


def _sequences(block: npt.NDArray[np.float32], length: int) -> Floats:
    """Return the luminance of samples (..., channel, sample) by sequence; bad ones are NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        light = np.asarray(luminance(block.astype(np.float64)))
    light[is_bad(block).any(axis=-2)] = np.nan
    return light.reshape(*light.shape[:-1], -1, length)


def _ratio(found: Floats, pixels: npt.NDArray[Any], blocks: Blocks) -> Interval[float]:
    of_means, single = found[:, pixels]
    return ratio_of(of_means, single, blocks, bounds=(0.0, np.inf))


def _tested(data: SceneData, spread: Samples, length: int) -> dict[str, Any]:
    """Return the share of pixels in which samples of a sequence are not independent."""
    most = slice(0, min(spread.spp // length, _MOST) * length)
    patches = list(data.scattered(_TESTED))
    x = np.concatenate(
        [
            _sequences(spread.read(slice(y, y + 1), slice(x, x + 1), most)[0], length)
            for patch in patches
            for y, x in zip(patch.y.tolist(), patch.x.tolist(), strict=True)
        ]
    )
    p, of_all = p_of_independence(x)
    q = q_values(p[:, np.newaxis])[:, 0]
    means = x.mean(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = length * means.var(axis=-1, ddof=1) / x.var(axis=(-2, -1), ddof=1)
    known, number = np.isfinite(q), np.arange(len(patches))
    blocks = Blocks(np.repeat(number, [len(patch) for patch in patches]), 0 * number)
    shares = {}
    for side, differs in (("lower", ratio < 1), ("higher", ratio > 1)):
        rejected = np.where(known, (q <= _ALPHA) & differs, np.nan)
        shares[f"share_{side}"] = mean_of(rejected, blocks).to_dict()
    return {"p_value": of_all if known.any() else None, **shares}


def _by_pattern(data: SceneData, found: Floats, pixels: PixelSet) -> dict[str, Interval[float]]:
    """Return ratios by the label of pixels, where these were classified."""
    if data.given is None or "label" not in data.given:
        return {}
    label = data.given["label"].to_numpy().ravel()
    places = {Label(code): np.flatnonzero(label == code) for code in np.unique(label).tolist()}
    return {
        which.name.lower(): _ratio(found, here, pixels.blocks[here])
        for which, here in places.items()
    }
