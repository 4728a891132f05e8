"""Atoms: the distributions that a scene is made of, one for each pixel and some between pixels.

An atom is a pixel's radiance and the probabilities that its samples fall into bins. Histograms are
noisy, and a bin that a pixel never showed must not have probability 0: they are drawn towards what
the topics of the scene say. `Atoms.logs` is what likelihoods are made of.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._arrays import LUMINANCE, is_bad, spans
from chdstat._positive import Floats
from chdstat.errors import InputError
from chdstat.estimators._sample_bins import SampleBins
from chdstat.estimators._topics import topic_histograms
from chdstat.estimators.heldout import Totals
from chdstat.fit.mixtures import mixture
from chdstat.samples import Samples

__all__ = ["Atoms", "Density", "Observed", "observe"]

Density = Literal["histogram", "lognormal"]

_TOPICS, _ITERATIONS = 120, 30
_POOLED = 0.5
"""Samples of the whole scene that every pixel is given: no bin has probability 0."""
_STEPS = (0.25, 0.5, 0.75)
"""How far from one pixel to another the atoms between them lie."""
_OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
"""Pixels that have atoms between them; those two apart bridge one that is left out."""
_PAIRS = 8
"""Pixels for each pair that has atoms between."""
_ROWS = 1024


@dataclass(frozen=True)
class Observed:
    """What the pixels of a scene showed.

    Attributes
    ----------
    pixels
        Flat indices into the picture, ascending, shape (pixel,).
    shape
        Height and width of the picture.
    bins
        What was counted in.
    radiance
        Means of the good samples, shape (pixel, channel), in units of `bins`.
    counts
        Samples per bin, shape (pixel, bin).
    probabilities
        What the topics of the scene say of each pixel, shape (pixel, bin), two per sample.
    luminance
        Probabilities of the bins of luminance from fitted mixtures, shape (pixel, narrow); None
        where the histograms stand for themselves.
    """

    pixels: npt.NDArray[np.int64]
    shape: tuple[int, int]
    bins: SampleBins
    radiance: Floats
    counts: npt.NDArray[np.float32]
    probabilities: npt.NDArray[np.float32]
    luminance: npt.NDArray[np.float32] | None

    def smoothed(self, strength: float) -> npt.NDArray[np.float32]:
        """Return probabilities (pixel, bin): those of luminance add up to 1.

        The topics count as much as `strength` samples.
        """
        narrow = self.bins.narrow
        n = self.counts[:, :narrow].sum(axis=-1, keepdims=True)
        pooled = self.counts.sum(axis=0) + 1 / self.bins.size
        pooled *= _POOLED / pooled[:narrow].sum()
        share = self.probabilities[:, :narrow].sum(axis=-1, keepdims=True)
        found = (self.counts + strength / share * self.probabilities + pooled) / (
            n + strength + _POOLED
        )
        if self.luminance is not None:
            found[:, :narrow] = (n * self.luminance + pooled[:narrow]) / (n + _POOLED)
        return np.asarray(found, np.float32)


@dataclass(frozen=True)
class Atoms:
    """The atoms of a prior.

    Attributes
    ----------
    logs
        Logarithms of the probabilities of bins, shape (bin, atom).
    radiance
        Shape (atom, channel), in units of the bins.
    log_mass
        Logarithm of the prior probability of each, shape (atom,).
    parents
        The two pixels that an atom lies between, flat indices, shape (atom, 2); for the first
        atoms, which are the pixels themselves, twice the same.
    """

    logs: npt.NDArray[np.float32]
    radiance: Floats
    log_mass: npt.NDArray[np.float32]
    parents: npt.NDArray[np.int64]

    @classmethod
    def of(cls, observed: Observed, *, strength: float, between: float) -> Atoms:
        """Make atoms of what was observed; those between pixels have the mass `between`."""
        table = observed.smoothed(strength)
        first, second = _most_different(observed) if between > 0 else np.zeros((2, 0), np.int64)
        number = len(table)
        radiance = np.concatenate([observed.radiance, _mix(observed.radiance, first, second)])
        extra = len(radiance) - number
        between = between if extra else 0.0
        mass = np.full(len(radiance), np.log((1 - between) / number), np.float32)
        mass[number:] = np.log(between / extra) if extra else 0.0
        logs = np.empty((observed.bins.size, len(radiance)), np.float32)
        _write_logs(logs[:, :number], table, observed.bins)
        _write_logs(logs[:, number:], _mix(table, first, second), observed.bins)
        same = np.stack([observed.pixels, observed.pixels], axis=-1)
        pairs = np.stack([observed.pixels[first], observed.pixels[second]], axis=-1)
        parents = np.concatenate([same, np.tile(pairs, (len(_STEPS), 1))])
        return cls(logs, radiance, mass, parents)


def observe(
    samples: Samples, pixels: npt.NDArray[np.int64], *, density: Density, rng: np.random.Generator
) -> Observed:
    """Count the samples of some pixels, flat indices; those without a good sample are left out.

    Raises
    ------
    InputError
        If none has a good sample.
    """
    height, width = samples.shape[:2]
    totals = Totals.of(samples)
    pixels = pixels[totals.count.reshape(-1)[pixels] > 0]
    if not len(pixels):
        message = "an empirical prior needs a pixel with a good sample, got none"
        raise InputError(message)
    radiance = totals.mean().reshape(height * width, -1)[pixels]
    bins = SampleBins(_unit(radiance), samples.shape[2])
    slots = _slots(pixels, (height, width))
    counts = np.zeros((len(pixels), bins.size), np.float32)
    for ys, xs, _, block in samples.blocks():
        wanted = slots[ys, xs] >= 0
        counts[slots[ys, xs][wanted]] += bins.counts(block[wanted])
    topics = topic_histograms(counts, topics=_TOPICS, iterations=_ITERATIONS, rng=rng)
    fitted = _fitted(samples, slots, counts, bins) if density == "lognormal" else None
    return Observed(pixels, (height, width), bins, radiance / bins.unit, counts, topics, fitted)


def _slots(pixels: npt.NDArray[np.int64], shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return an image of which row each pixel is, -1 where it is none."""
    slots = np.full(shape, -1, np.int64)
    slots.reshape(-1)[pixels] = np.arange(len(pixels))
    return slots


def _unit(radiance: Floats) -> float:
    """Return the mean luminance; a scene without light has the unit 1."""
    weights = LUMINANCE if radiance.shape[-1] == 3 else np.ones(1)
    return float(np.mean(radiance @ weights)) or 1.0


def _fitted(
    samples: Samples,
    slots: npt.NDArray[np.int64],
    counts: npt.NDArray[np.float32],
    bins: SampleBins,
) -> npt.NDArray[np.float32]:
    """Return what mixtures fitted to luminance say; the histogram where none could be fitted."""
    found = counts[:, : bins.narrow] / counts[:, : bins.narrow].sum(axis=-1, keepdims=True)
    for ys in spans(len(slots), 8):
        rows = slots[ys][slots[ys] >= 0]
        x = samples.read(ys)[slots[ys] >= 0].astype(np.float64)
        if not len(rows):
            continue
        x = np.where(is_bad(x).any(axis=-2, keepdims=True), np.nan, x)
        weights = LUMINANCE.astype(np.float64) if bins.channels == 3 else np.ones(1)
        below = mixture(weights @ x).cdf(bins.luminance_edges[:-1])
        inside = np.diff(below, axis=-1, prepend=0.0, append=1.0)
        known = np.isfinite(inside).all(axis=-1)
        found[rows[known]] = np.maximum(inside[known], 0)
    return np.asarray(found, np.float32)


def _most_different(observed: Observed) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the pairs of near pixels, as rows, whose radiance differs most: edges of light."""
    slots = _slots(observed.pixels, observed.shape)
    pairs = np.concatenate([_shifted(slots, *offset) for offset in _OFFSETS], axis=-1)
    first, second = pairs[:, (pairs >= 0).all(axis=0)]
    apart = np.abs(observed.radiance[first] - observed.radiance[second]).sum(axis=-1)
    most = np.argsort(-apart, kind="stable")[: len(observed.pixels) // _PAIRS]
    most = most[apart[most] > 0]
    return first[most], second[most]


def _shifted(slots: npt.NDArray[np.int64], down: int, right: int) -> npt.NDArray[np.int64]:
    """Return all pairs of entries at a distance, shape (2, pair)."""
    height, width = slots.shape
    left = max(-right, 0)
    here = slots[: height - down, left : width - max(right, 0)]
    there = slots[down:, left + right : width + min(right, 0)]
    return np.stack([here.reshape(-1), there.reshape(-1)])


def _mix(
    rows: npt.NDArray[Any], first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]
) -> npt.NDArray[Any]:
    """Return what lies between rows, step by step; the half of an edge has half of each CHD."""
    parts = [(1 - step) * rows[first] + step * rows[second] for step in _STEPS]
    return np.concatenate(parts).astype(rows.dtype)


def _write_logs(
    out: npt.NDArray[np.float32], table: npt.NDArray[np.float32], bins: SampleBins
) -> None:
    """Write log f(luminance) and log f(chromaticity | luminance) of rows into columns of `out`."""
    for part in spans(len(table), _ROWS):
        rows = table[part].copy()
        if bins.hues:
            cells = bins.by_cell(rows)
            rows[:, bins.narrow :] = (cells / cells.sum(axis=-1, keepdims=True)).reshape(
                len(rows), -1
            )
        out[:, part] = np.log(rows).T
