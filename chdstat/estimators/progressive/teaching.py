"""Teaching: a new network from material, how far to believe it, and what errors to expect of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat._core.executor import track
from chdstat.errors import InputError
from chdstat.estimators.progressive.architecture import Architecture
from chdstat.estimators.progressive.dataset import TrainingSet
from chdstat.estimators.progressive.error_model import ErrorModel, mean_change, validation_batches
from chdstat.estimators.progressive.learned import Trust

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network
    from chdstat.estimators.progressive.shrinkage import ShrunkNetwork

__all__ = ["measure_trust", "train_network"]

_VALIDATION = 0.1
"""Share of the pixels that train nothing, and tell how large the errors are."""
_VALIDATION_ALONE, _MOST_VALIDATION = 512, 0.25
"""Without a reference that takes at least so many, up to this share: what they say is noisy."""
_FEWEST = 2


def train_network(
    training_set: TrainingSet, *, channels: int, seed: int, progress: bool | None
) -> tuple[Network, Trust, ErrorModel, npt.NDArray[np.float64]]:
    """Train a network; some pixels only watch, and tell how large the errors are.

    Parameters
    ----------
    material
        What to train with.
    channels
        Of a sample.
    seed
        Draws the first weights, the pixels that watch, and the minibatches.
    progress
        Show a progress bar; None shows it on a terminal.

    Returns
    -------
    network : Network
    trust : Trust
        How far to go from the mean to its estimate.
    spread : Spread
        Of the errors at this trust.
    history : ndarray
        As of `training.learn`.

    Raises
    ------
    InputError
        If there are too few pixels.
    """
    import torch

    from chdstat.estimators.progressive.network import Network
    from chdstat.estimators.progressive.training import learn

    count = len(training_set.pixels)
    if count < _FEWEST:
        message = (
            f"training needs at least {_FEWEST} pixels without a bad sample, got {count}; give a "
            "larger image"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    order = rng.permutation(count)
    held_out = _validation_count(count, alone=not training_set.config.reference)
    auxiliary = training_set.auxiliary
    shape = Architecture(
        channels=channels,
        described=auxiliary.described.shape[1],
        neighbours=auxiliary.weight.shape[1] > 0,
        parts=training_set.splits.parts,
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Network(shape)
    with track("training", training_set.config.iterations, unit="it", show=progress) as advance:
        history = learn(
            network,
            training_set,
            train=order[held_out:],
            validation=order[:held_out],
            rng=rng,
            advance=advance,
        )
    shrunk, trust = measure_trust(network, training_set, order[:held_out], rng)
    error_model = ErrorModel.learn(shrunk, training_set, pixels=order[:held_out], rng=rng)
    return network, trust, error_model, history


def _validation_count(count: int, *, alone: bool) -> int:
    """Return how many of the pixels watch."""
    usual = round(count * _VALIDATION)
    more = min(_VALIDATION_ALONE, round(count * _MOST_VALIDATION)) if alone else 0
    return max(1, usual, more)


def measure_trust(
    network: Network,
    training_set: TrainingSet,
    validation: npt.NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[ShrunkNetwork, Trust]:
    """Return a network that goes as far from the mean as it pays, and how far that is."""
    from chdstat.estimators.progressive.shrinkage import (
        Move,
        ShrunkNetwork,
        keeping_mean,
        own_shares,
        reference_trust,
    )

    if training_set.config.reference:
        # Rare lamps and fireflies are in all pixels, hardly in a tenth of them.
        pixels = np.arange(len(training_set.pixels))
        trust = reference_trust(validation_batches(network, training_set, pixels=pixels, rng=rng))
    else:
        held_out = validation_batches(network, training_set, pixels=validation, rng=rng)
        shares = own_shares(map(Move.of, held_out))
        trust = keeping_mean(*shares, mean_change(network, training_set))
    return ShrunkNetwork(network, trust), trust
