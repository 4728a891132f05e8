"""Network: from comparisons of the candidates to a proposal of them and the width of its interval.

It was trained once, on built-in scenes with converged references (``tools/train_combination.py``).
Its inputs are ratios that compare the candidates with each other; they say nothing else of the
scene.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage, stats

from chdstat._core.arrays import Image, Reals, spans
from chdstat.estimators.default_estimate.candidates import Measured, candidates
from chdstat.estimators.default_estimate.weights import Proposal
from chdstat.estimators.training import read_model

if TYPE_CHECKING:
    from distributed import Client

LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)
"""Probabilities for which the width of intervals was measured."""
_SHIPPED = Path(__file__).with_name("weighting_network.safetensors")
_ROWS = 2**16
"""Pixels whose weights are computed at once."""
_SCALES = (1.5, 4.0, 12.0)
"""Standard deviations, in pixels, of the windows in which comparisons are averaged."""
_AROUND = 4.0
"""Standard deviation, in pixels, of the window in which the spread of proposals is averaged."""
_TRUNCATE = 3
"""Standard deviations at which these windows end."""
_FAINT = 0.01
"""Share of the image's mean radiance in the unit of a pixel's errors, besides its own."""
_BAND = 2**19
"""Pixels that are compared at once: an image of this size needs 150 MB of inputs."""


@dataclass(frozen=True)
class WeightingNetwork:
    """Network that maps comparisons of candidates to weights and the width of an interval.

    Attributes
    ----------
    layers
        Matrices (out, in) and offsets (out,). The last layer outputs a score for each candidate,
        and the logarithm of the width.
    centre, spread
        Mean and scale by which inputs are standardised.
    quantiles
        Half-widths of intervals at the probabilities `LEVELS`, in units of the predicted width, for
        the dark, middle and bright third of an image, shape (third, level).
    """

    layers: Sequence[tuple[Reals, Reals]]
    centre: Reals
    spread: Reals
    quantiles: Reals

    @classmethod
    @functools.cache
    def shipped(cls, *, with_features: bool) -> WeightingNetwork:
        """Return the network that comes with the library."""
        arrays, _ = read_model(_SHIPPED)
        kind = "features" if with_features else "plain"
        found = {k.removeprefix(f"{kind}."): v for k, v in arrays.items() if k.startswith(kind)}
        depth = sum(name.startswith("matrix") for name in found)
        layers = [(found[f"matrix{i}"], found[f"offset{i}"]) for i in range(depth)]
        return cls(layers, found["centre"], found["spread"], found["quantiles"])

    def __call__(
        self, made: Sequence[Mapping[str, Image]], measured: Measured, unit: Image
    ) -> tuple[Image, Image]:
        """Return weights (y, x, candidate) and widths (y, x) of intervals, in `unit`.

        The image is processed in bands of rows, so that the inputs of only one band are in memory.
        """
        height, width = unit.shape
        weights = np.empty((height, width, len(made[0])), np.float32)
        widths = np.empty((height, width), np.float32)
        for rows in spans(height, max(1, _BAND // width)):
            inputs = comparisons(made, measured, unit, rows)
            flat = inputs.reshape(-1, inputs.shape[-1])
            outputs = np.concatenate(
                [self._outputs(flat[part]) for part in spans(len(flat), _ROWS)]
            )
            scores = outputs[:, :-1]
            shares = np.exp(scores - scores.max(axis=-1, keepdims=True))
            shares /= shares.sum(axis=-1, keepdims=True)
            weights[rows] = shares.reshape(-1, width, shares.shape[-1])
            widths[rows] = np.exp(outputs[:, -1]).reshape(-1, width)
        return weights, widths

    def _outputs(self, rows: Image) -> Image:
        x = (rows - self.centre) / self.spread
        for i, (matrix, offset) in enumerate(self.layers):
            x = x @ matrix.T + offset
            if i < len(self.layers) - 1:
                x = np.where(x > 0, x, 0.01 * x)
        return np.asarray(x, np.float32)

    def quantile(self, level: float, brightness: Image) -> Image:
        """Return how many widths an interval reaches to each side, shape (y, x).

        Only the ranks of `brightness` (y, x) matter.
        """
        # Interpolate and extrapolate the measured levels as if errors fell off exponentially.
        places = -np.log1p(-np.array((0, *LEVELS)))
        place = -np.log1p(-level)
        beyond = max(0, place - places[-1]) / (places[-1] - places[-2])
        widths = [
            np.interp(place, places, [0, *third]) + beyond * (third[-1] - third[-2])
            for third in self.quantiles
        ]
        share = (stats.rankdata(brightness) - 0.5).reshape(brightness.shape) / brightness.size
        return np.asarray(np.interp(share, np.array((1, 3, 5)) / 6, widths), np.float32)


def proposed(
    measured: Measured,
    features: Mapping[str, npt.NDArray[Any]],
    *,
    level: float,
    client: Client | None = None,
) -> tuple[dict[str, Image], Reals, list[Proposal]]:
    """Return what is proposed instead of the mean: the weighted candidates.

    Parameters
    ----------
    measured
        Statistics of the samples and of their halves.
    features
        First-hit features by name; ``albedo`` and ``normal`` guide the denoiser.
    level
        Probability of the interval.
    client
        A Dask client whose workers denoise.

    Returns
    -------
    weights
        Of each candidate by its name, shape (y, x).
    half
        Half of the width of the interval of the proposal, shape (y, x, channel) or (y, x, 1).
    proposals
        Of all samples, and of each half of them.
    """
    made = [candidates(start, features, client) for start in measured.starts]
    names, unit = list(made[0]), unit_of(made[0])
    half: Reals
    if len(names) > 2:
        network = WeightingNetwork.shipped(with_features="albedo" in features)
        weights, width = network(made, measured, unit)
        half = (network.quantile(level, unit) * width * unit)[..., np.newaxis]
    else:
        # Nothing is denoised: propose the limited mean, with the interval of the mean.
        weights = np.broadcast_to(np.array(names) == "shared_shape", (*unit.shape, 2))
        half = measured.interval(level)[1] - measured.mean
    proposals = [
        Proposal(_weighted(weights, images), start["mean"], error)
        for images, start, error in zip(made, measured.starts, measured.errors, strict=True)
    ]
    _, one, other = proposals
    spread = _spread_of_halves(one, other, unit)
    half = np.maximum(half, stats.norm.ppf(0.5 + level / 2) * spread)
    return {name: weights[..., j] for j, name in enumerate(names)}, half, proposals


def _weighted(weights: Image, images: Mapping[str, Image]) -> Image:
    """Return the sum of images (y, x, channel) with weights (y, x, candidate)."""
    found = np.zeros(next(iter(images.values())).shape, np.float32)
    for j, image in enumerate(images.values()):
        found += weights[..., j, np.newaxis] * image
    return found


def _spread_of_halves(one: Proposal, other: Proposal, unit: Image) -> Reals:
    """Return the standard error of a proposal, shape (y, x, 1), from the proposals of the halves.

    It is averaged over the pixels around. Images much smaller or thinner than the training images
    have larger errors than the network expects.
    """
    apart = np.square((one.image - other.image) / (2 * unit[..., np.newaxis])).mean(axis=-1)
    around = ndimage.gaussian_filter(apart, _AROUND, mode="nearest")
    return np.asarray((np.sqrt(around) * unit)[..., np.newaxis])


def unit_of(images: Mapping[str, Image]) -> Image:
    """Return the unit of errors, shape (y, x): the smoothed radiance of all candidates."""
    bright = np.mean([np.abs(image).mean(axis=-1) for image in images.values()], axis=0)
    return np.asarray(_smooth(bright, _SCALES[0]) + _FAINT * _overall(images), np.float32)


def comparisons(
    made: Sequence[Mapping[str, Image]],
    measured: Measured,
    unit: Image,
    rows: slice = slice(None),
) -> Image:
    """Return the inputs of the network for some rows: logarithms, ratios, standard scores.

    Each candidate but the first is compared with the first. In three windows: which mixture of the
    two is nearest to the other half of the samples (the slope of a regression without constant),
    and its standard error. In one window: how far the two are apart, and with which sign. For every
    candidate: how far its versions from the two halves are apart, and how many standard errors of
    the mean it is from the mean.

    Parameters
    ----------
    made
        Candidates by name, from all samples and from each half.
    measured
        Statistics of the samples and of their halves.
    unit
        Unit of errors, of the whole image, shape (y, x).
    rows
        Rows of the image.

    Returns
    -------
    ndarray
        Shape (y, x, number).
    """
    shape = unit.shape
    start, stop, _ = rows.indices(len(unit))
    reach = int(_TRUNCATE * max(_SCALES) + 0.5)
    around = slice(max(0, start - reach), stop + reach)
    full, *parts = ([image[around] for image in images.values()] for images in made)
    targets = [part["mean"][around] for part in measured.starts[:0:-1]]
    mean = measured.starts[0]["mean"][around]
    variance = np.square(measured.errors[0][around])
    of_light, unit = variance.mean(axis=-1), unit[around]
    error = np.sqrt(of_light)
    noise = [_smooth(of_light, s) for s in _SCALES[:2]]
    count = 5 + (2 * len(_SCALES) + 3) * (len(full) - 1) + 3 * len(full)
    found = np.empty((*unit.shape, count), np.float32)
    place = iter(range(count))

    def write(*images: Reals) -> None:
        for image in images:
            found[..., next(place)] = image

    write(
        _log(error / unit, 1e-4),
        _log(np.sqrt(noise[0]) / unit, 1e-4),
        _log(np.sqrt(noise[1]) / _smooth(unit, _SCALES[1]), 1e-4),
        _smooth(measured.null[around], _SCALES[0]),
        np.log(unit / _overall(made[0])),
    )
    # A window cannot hold more pixels than a small image has.
    pooled = [np.prod(np.minimum(2 * np.sqrt(np.pi) * s, shape)) for s in _SCALES]
    scale = unit[..., np.newaxis]
    variance *= 2 / scale**2
    of_halves = [np.stack(images) for images in zip(*parts, strict=True)]
    missed = (np.stack(targets) - of_halves[0]) / scale
    for j in range(1, len(full)):
        apart = (of_halves[j] - of_halves[0]) / scale
        towards = (apart * missed).mean(axis=(0, 3))
        squared = np.square(apart)
        of_noise = (squared * variance).mean(axis=(0, 3)) / 2
        squared = squared.mean(axis=(0, 3))
        for s, pixels in zip(_SCALES, pooled, strict=True):
            whole = _smooth(squared, s) + 1e-8
            slope = _smooth(towards, s) / whole
            spread = np.sqrt(_smooth(of_noise, s) / pixels) / whole
            write(np.clip(slope, -1, 2), np.clip(_log(spread, 1e-3), -7, 3))
        write(_log(np.sqrt(_smooth(squared, _SCALES[0])), 1e-4))
        moved = (full[j] - full[0]) / scale
        size = _smooth(np.square(moved).mean(axis=-1), _SCALES[0])
        write(np.arcsinh(3 * moved.mean(axis=-1)), _log(np.sqrt(size), 1e-4))
    for whole_image, halves in zip(full, of_halves, strict=True):
        between = _smooth(np.var(halves / scale, axis=0).mean(axis=-1), _SCALES[0])
        score = (whole_image - mean).mean(axis=-1) / (error + 1e-3 * unit)
        size = _smooth(np.minimum(np.square(score), 1e6), _SCALES[0])
        write(_log(np.sqrt(between), 1e-4), np.arcsinh(score), _log(np.sqrt(size), 1e-2))
    return found[start - around.start :][: stop - start]


def _overall(images: Mapping[str, Image]) -> float:
    """Return the mean radiance of the first candidate, or 1 if it is black."""
    first = next(iter(images.values()))
    return float(np.abs(first).mean(dtype=np.float64)) or 1.0


def _smooth(image: Reals, scale: float) -> Reals:
    found = ndimage.gaussian_filter(
        image.astype(np.float32), scale, mode="nearest", truncate=_TRUNCATE
    )
    return np.asarray(found)


def _log(x: Reals, least: float) -> Reals:
    return np.asarray(np.log(x + least))
