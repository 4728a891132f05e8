"""Online training: a network that goes on learning from an image while its samples arrive.

What is kept of the samples are `BatchProfiles`, of as many pixels as tell enough. Each time that it
learns, the step size falls from its start to 0 again and the weights go on from where they were
(warm restarts: Loshchilov and Hutter 2017, "SGDR: stochastic gradient descent with warm restarts",
arXiv:1608.03983).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import OCTAVES, Array, Indices, Profile, TrainingSet
from chdstat.estimators.progressive.inputs import Features, InputConfig, some_rows
from chdstat.estimators.progressive.training import FEWEST, VALIDATION, Learned, finished
from chdstat.estimators.training import scene_record

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = ["BATCHES", "BatchProfiles", "BatchSplits", "OnlineTrainer"]

BATCHES = 8
"""Of a pixel: 3 kB of RGB."""
_BRIGHTEST = 1e15
"""Radiance, in units of the image's, that can still be squared in single precision."""
_ROUNDING = 2e-6
"""Relative difference of two means below which it is that of their sums in single precision."""
_PIXELS = 2**16
"""Of an image that train: those of a larger one would take much memory and tell little more."""
_ERROR_SIZES = 3
"""Numbers of samples at which errors are measured: each takes a while."""

Floats = npt.NDArray[np.float64]


class BatchProfiles:
    """Samples of some pixels, the k-th of each in the batch k modulo their number.

    Parameters
    ----------
    pixels, channels
        How many there are.
    unit
        Radiance that all is measured in.
    batches
        How many a pixel has.
    parts
        2 where direct and indirect light are counted separately, else 1.

    Examples
    --------
    >>> kept = BatchProfiles(1, 1, unit=1.0, batches=2)
    >>> kept.add(np.array([[[1.0, 5.0, 3.0]]]))
    >>> kept.sums[..., 0].tolist()
    [[4.0], [5.0]]
    """

    def __init__(
        self, pixels: int, channels: int, *, unit: float, batches: int = BATCHES, parts: int = 1
    ) -> None:
        self.unit = unit
        self.spp = 0
        self.bins = np.zeros((batches, pixels, parts * OCTAVES, 1 + channels), np.float32)
        self.sums = np.zeros((batches, pixels, channels))
        self.count = np.zeros((batches, pixels), np.int64)

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        return self.bins.nbytes + self.sums.nbytes + self.count.nbytes

    @property
    def sizes(self) -> Indices:
        """Samples in each batch, bad ones among them, shape (batch,)."""
        return (self.spp + np.arange(len(self.bins))[::-1]) // len(self.bins)

    def add(self, x: npt.NDArray[Any], direct: npt.NDArray[Any] | None = None) -> None:
        """Add samples (pixel, channel, sample), going on with the batch after the last one.

        Of two parts, `direct` is the direct part of the samples.
        """
        step = len(self.bins)
        for first in range(min(x.shape[-1], step)):
            batch = (self.spp + first) % step
            own = None if direct is None else direct[..., first::step]
            profile = Profile.of(x[..., first::step], unit=self.unit, direct=own)
            self.bins[batch] += profile.bins
            self.sums[batch] += profile.bins[..., 1:].sum(axis=-2, dtype=np.float64)
            self.count[batch] += profile.count
        self.spp += x.shape[-1]

    def usable(self) -> Indices:
        """Return the pixels that have no bad sample, and none too bright to be squared."""
        whole = (self.count == self.sizes[:, np.newaxis]).all(axis=0)
        return np.flatnonzero(whole & (self.sums < _BRIGHTEST).all(axis=(0, 2)))


@dataclass(eq=False, kw_only=True)
class BatchSplits(TrainingSet):
    """Pixels whose samples are kept as profiles of batches; of these some are drawn, not samples.

    Attributes
    ----------
    batches
        The samples so far.
    chosen
        Which of its pixels to take.
    """

    batches: BatchProfiles
    chosen: Indices

    def __post_init__(self) -> None:
        self.counts = self.batches.sizes[self.batches.sizes > 0]
        self._sums = self.batches.sums[: len(self.counts), self.chosen]
        self.spp = int(self.counts.sum())
        if not self.sizes:
            # About as many as 1, 2, 3 and so on batches hold, all but the last two of them.
            filled = len(self.counts)
            self.sizes = [round(k * self.spp / filled) for k in range(1, filled - 1)]
        self.mean = self._sums.sum(axis=0) / self.spp
        # That between batches is unbiased: the expectation of sum_b n_b (m_b - m)^2 / (B - 1), with
        # means m over n samples, is the variance of one sample (the mean square between groups;
        # Fisher 1925, Statistical Methods for Research Workers, chapter 7).
        sizes = self.counts[:, np.newaxis, np.newaxis]
        differences = self._sums / sizes - self.mean
        differences[np.abs(differences) <= _ROUNDING * self.mean] = 0
        self.variance = (sizes * differences**2).sum(axis=0) / max(len(sizes) - 1, 1)

    def draw(
        self, pixels: Indices, n: int, rows: int, rng: np.random.Generator
    ) -> tuple[Indices, Indices]:
        """Draw pixels, and as many batches as come nearest to n samples, and one at least."""
        chosen, filled = rng.choice(pixels, size=max(1, rows)), len(self.counts)
        seen = min(max(round(n * filled / self.spp), 1), filled - 1)
        return chosen, rng.permutation(filled)[:seen]

    def minibatch(self, rows: Indices, drawn: Indices) -> tuple[Profile, dict[str, Array], Array]:
        """Return what to learn from, and the target; see `TrainingSet.minibatch`."""
        here = self.chosen[rows]
        bins = self.batches.bins[drawn[0]].take(here, axis=0)
        for batch in drawn[1:]:
            bins += self.batches.bins[batch].take(here, axis=0)
        profile = Profile(bins, np.full(len(rows), self.counts[drawn].sum()), 1.0)
        others = np.setdiff1d(np.arange(len(self.counts)), drawn)
        target = self.mean_of(rows, others).astype(np.float32)
        return profile, some_rows(self.auxiliary, rows), target

    def mean_of(self, rows: Indices, drawn: Indices) -> Floats:
        """Return the mean of some batches of some pixels, shape (row, channel)."""
        total = sum(self._sums[batch].take(rows, axis=0) for batch in drawn)
        return np.asarray(total / max(self.counts[drawn].sum(), 1))


class OnlineTrainer:
    """A network, and the samples that it learns from, kept in memory that does not grow.

    Parameters
    ----------
    shape, channels
        Height and width of the image, and channels of a sample.
    inputs
        Of the estimator.
    unit
        Mean radiance of the image.
    features
        First-hit features of the image, where they are an input.
    seed
        Draws the pixels that train, the first weights and the minibatches.
    start
        What was learned before, to go on from; None starts anew.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        inputs: InputConfig,
        *,
        unit: float,
        features: Features | None,
        seed: int,
        start: Learned | None,
    ) -> None:
        self._shape, self._inputs, self._seed, self._start = shape, inputs, seed, start
        self._rng = generator(seed)
        self._rows = self._rng.permutation(shape[0] * shape[1])[:_PIXELS]
        self._held_out = max(1, round(VALIDATION * len(self._rows)))
        self._auxiliary = some_rows(inputs.auxiliary(features, shape), self._rows)
        self.batches = BatchProfiles(len(self._rows), channels, unit=unit, parts=inputs.parts)
        self._learned = start
        self._network: Network | None = None
        self._history = np.empty((0, 5))
        if start is not None:
            self._history, self._network = start.history, copy.deepcopy(start.network)
            self._network.shrinkage = None

    @property
    def iterations(self) -> int:
        """Minibatches that it has learned from, here and before."""
        return int(self._history[-1, 0]) if len(self._history) else 0

    def add(self, samples: npt.NDArray[Any], direct: npt.NDArray[Any] | None = None) -> None:
        """Take more samples of the image, shape (y, x, channel, sample), and the direct part."""
        given = (samples,) if direct is None else (samples, direct)
        self.batches.add(*(x.reshape(-1, *x.shape[2:])[self._rows] for x in given))

    def learn(self, iterations: int, advance: Callable[[float], None]) -> None:
        """Learn from the samples so far; `advance` is called after every iteration.

        Where the samples of no pixel differ, the mean is the truth, and there is nothing to learn.

        Raises
        ------
        InputError
            If there are fewer than 4 samples per pixel, or too few pixels without a bad sample.
        """
        from chdstat.estimators.progressive.network import learn, new_network

        training_set, validation = self._training_set(iterations, {})
        if not training_set.variance.any():
            advance(iterations)
            return
        if self._network is None:
            self._network = new_network(training_set, self._inputs, seed=self._seed)
        train = np.setdiff1d(np.arange(len(training_set)), validation)
        history = learn(
            self._network, training_set, train, validation, rng=self._rng, advance=advance
        )
        history[:, 0] += self.iterations
        self._history = np.concatenate([self._history, history])
        self._learned = None

    def learned(self, attrs: Mapping[str, Any]) -> Learned | None:
        """Return what was learned so far from samples of some provenance; None before it was."""
        if self._learned is None and self._network is not None:
            training_set, validation = self._training_set(self.iterations, attrs)
            sizes = training_set.sizes
            self._learned = finished(
                copy.deepcopy(self._network),
                replace(training_set, sizes=sizes[:: -(-len(sizes) // _ERROR_SIZES)]),
                self._inputs,
                validation,
                self._history,
                rng=generator(self._seed).spawn(1)[0],
                seed=self._seed,
                sizes=sorted(set(sizes)),
                on_the_fly=True,
                buckets=BATCHES,
                began_from=None if self._start is None else self._start.provenance,
            )
        return self._learned

    def _training_set(
        self, iterations: int, attrs: Mapping[str, Any]
    ) -> tuple[BatchSplits, Indices]:
        """Return the pixels to learn from, and which of them validate."""
        if self.batches.spp < FEWEST:
            message = (
                f"learning needs at least {FEWEST} samples of each pixel, got "
                f"{self.batches.spp}; call update(samples) first"
            )
            raise InputError(message)
        pixels = self.batches.usable()
        validation = np.flatnonzero(pixels < self._held_out)
        if not 0 < len(validation) < len(pixels):
            message = (
                "learning needs pixels without a bad sample, to train and to validate; got "
                f"{len(pixels)} of {len(self._rows)}: give a larger image"
            )
            raise InputError(message)
        places = np.unravel_index(self._rows[pixels], self._shape)
        shape = (*self._shape, self.batches.sums.shape[-1], self.batches.spp)
        scene = str(attrs.get("scene", "samples"))
        record = scene_record(scene, attrs, shape, unit=self.batches.unit, pixels_used=len(pixels))
        training_set = BatchSplits(
            batches=self.batches,
            chosen=pixels,
            iterations=iterations,
            auxiliary=some_rows(self._auxiliary, pixels),
            pixels=np.stack(places, axis=-1),
            excluded=len(self._rows) - len(pixels),
            scenes=[record],
        )
        return training_set, validation
