"""Online training: a network that goes on learning from an image while its samples arrive.

What is kept of the samples are `BatchProfiles`, of as many pixels as tell enough. Each time that it
learns, the step size falls from its start to 0 again and the weights go on from where they were
(warm restarts: Loshchilov and Hutter 2017, "SGDR: stochastic gradient descent with warm restarts",
arXiv:1608.03983).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures, TrainingConfig, TrainingSet
from chdstat.estimators.progressive.error_model import ErrorModel
from chdstat.estimators.progressive.inputs import Architecture, InputConfig
from chdstat.estimators.progressive.learned import (
    Fingerprint,
    Learned,
    Origin,
    Trust,
    provenance_of,
)
from chdstat.estimators.progressive.splits import BATCHES, BatchProfiles, BatchSplits

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = ["OnlineTrainer"]

_PIXELS = 2**16
"""Of an image that train: those of a larger one would take much memory and tell little more."""
_VALIDATION = 0.1
"""Share of these held out for validation, to measure how large the errors are."""
_FEWEST = 4
"""Samples to learn from: two halves of at least two."""
_ERROR_SIZES = 3
"""Numbers of samples at which errors are measured: each takes a while."""


class OnlineTrainer:
    """A network, and the samples that it learns from, kept in memory that does not grow.

    Parameters
    ----------
    shape, channels
        Height and width of the image, and channels of a sample.
    unit
        Mean radiance of the image.
    described
        Of the first hit, shape (pixel, number).
    seed
        Draws the pixels that train, the first weights and the minibatches.
    start
        What was learned before, to go on from; None starts anew.
    parts
        2 where direct and indirect light are separate inputs, else 1.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        *,
        unit: float,
        described: npt.NDArray[np.float32],
        seed: int,
        start: Learned | None,
        parts: int = 1,
    ) -> None:
        self._shape, self._seed, self._start = shape, seed, start
        self._rng = generator(seed)
        self._rows = self._rng.permutation(shape[0] * shape[1])[:_PIXELS]
        self._validation_count = max(1, round(_VALIDATION * len(self._rows)))
        self._auxiliary = replace(
            AuxiliaryFeatures.nothing(len(self._rows)), described=described[self._rows]
        )
        self._parts = parts
        self._batches = BatchProfiles(len(self._rows), channels, unit=unit, parts=parts)
        self._learned = start
        self._network = None if start is None else copy.deepcopy(start.network)
        self._history = np.empty((0, 5)) if start is None else start.history

    @property
    def unit(self) -> float:
        """Radiance that all is measured in; it may be set while no sample had light."""
        return self._batches.unit

    @unit.setter
    def unit(self, unit: float) -> None:
        self._batches.unit = unit

    @property
    def nbytes(self) -> int:
        """Bytes that are kept of the samples."""
        return self._batches.nbytes

    @property
    def iterations(self) -> int:
        """Minibatches that it has learned from, here and before."""
        return int(self._history[-1, 0]) if len(self._history) else 0

    def add(self, samples: npt.NDArray[Any], direct: npt.NDArray[Any] | None = None) -> None:
        """Take more samples of the image, shape (y, x, channel, sample), and the direct part."""
        given = (samples,) if direct is None else (samples, direct)
        self._batches.add(*(x.reshape(-1, *x.shape[2:])[self._rows] for x in given))

    def learn(self, iterations: int, advance: Callable[[float], None]) -> None:
        """Learn from the samples so far; `advance` is told of every iteration.

        Where the samples of no pixel differ, the mean is the truth, and there is nothing to learn.

        Raises
        ------
        InputError
            If there are fewer than 4 samples per pixel, or too few pixels without a bad sample.
        """
        from chdstat.estimators.progressive.training import learn

        pixels = self._usable()
        training_set = self._training_set(pixels, iterations)
        if not training_set.splits.variance.any():
            advance(iterations)
            return
        held_out = pixels < self._validation_count
        history = learn(
            self._current_network(),
            training_set,
            train=np.flatnonzero(~held_out),
            validation=np.flatnonzero(held_out),
            rng=self._rng,
            advance=advance,
        )
        history[:, 0] += self.iterations
        self._history = np.concatenate([self._history, history])
        self._learned = None

    def learned(self, attrs: Mapping[str, Any]) -> Learned | None:
        """Return what was learned so far from samples of some provenance; None before it was."""
        if self._learned is None and self._network is not None:
            self._learned = self._summed_up(self._network, attrs)
        return self._learned

    def _usable(self) -> npt.NDArray[np.int64]:
        """Return the places in `_rows` of pixels to learn from and to validate on."""
        if self._batches.dealt < _FEWEST:
            message = (
                f"learning needs at least {_FEWEST} samples of each pixel, got "
                f"{self._batches.dealt}; call update(samples) first"
            )
            raise InputError(message)
        pixels = self._batches.usable()
        held_out = int((pixels < self._validation_count).sum())
        if not 0 < held_out < len(pixels):
            message = (
                "learning needs pixels without a bad sample, to train and to validate; got "
                f"{len(pixels)} of {len(self._rows)}: give a larger image"
            )
            raise InputError(message)
        return pixels

    def _training_set(self, pixels: npt.NDArray[np.int64], iterations: int) -> TrainingSet:
        parts = BatchSplits(self._batches, pixels)
        places = np.unravel_index(self._rows[pixels], self._shape)
        return TrainingSet(
            splits=parts,
            auxiliary=self._auxiliary[pixels],
            config=TrainingConfig(sizes=parts.sizes, reference=False, iterations=iterations),
            pixels=np.stack(places, axis=-1),
            excluded=len(self._rows) - len(pixels),
            parts=[len(pixels)],
        )

    def _current_network(self) -> Network:
        """Return the network to go on with, a new one where there is none."""
        import torch

        from chdstat.estimators.progressive.network import Network

        if self._network is None:
            described = self._auxiliary.described.shape[1]
            with torch.random.fork_rng():
                torch.manual_seed(self._seed)
                shape = Architecture(self._batches.channels, described, parts=self._parts)
                self._network = Network(shape)
        return self._network

    def _summed_up(self, network: Network, attrs: Mapping[str, Any]) -> Learned:
        from chdstat.estimators.progressive.training import measure_trust

        pixels = self._usable()
        training_set = self._training_set(pixels, self.iterations)
        sizes = training_set.config.sizes
        few = replace(training_set.config, sizes=sizes[:: -(-len(sizes) // _ERROR_SIZES)])
        held_out = np.flatnonzero(pixels < self._validation_count)
        rng = generator(self._seed).spawn(1)[0]
        reduced = replace(training_set, config=few)
        shrunk, trust = measure_trust(network, reduced, held_out, rng)
        error_model = ErrorModel.learn(shrunk, reduced, pixels=held_out, rng=rng)
        return Learned(
            network=copy.deepcopy(network),
            error_model=error_model,
            unit=self._batches.unit,
            history=self._history,
            train_pixels=training_set.pixels,
            train_shape=self._shape,
            provenance=self._provenance(training_set, attrs, trust),
            trust=trust,
            fingerprint=Fingerprint.none(self._batches.channels),
        )

    def _provenance(
        self, training_set: TrainingSet, attrs: Mapping[str, Any], trust: Trust
    ) -> dict[str, Any]:
        scene = str(attrs.get("scene", "samples"))
        shape = (*self._shape, self._batches.channels, self._batches.dealt)
        features = bool(training_set.auxiliary.described.shape[1])
        return {
            **provenance_of(
                [Origin(scene, attrs, shape, self._batches.unit)],
                training_set,
                inputs=InputConfig(features=features, direct=self._parts > 1),
                seed=self._seed,
                trust=trust,
            ),
            "on_the_fly": True,
            "buckets": BATCHES,
            "began_from": None if self._start is None else self._start.provenance,
        }
