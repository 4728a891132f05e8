"""Teaching: a new network from material, how far to believe it, and what errors to expect of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat._core.executor import track
from chdstat.errors import InputError
from chdstat.estimators.progressive.architecture import Shape
from chdstat.estimators.progressive.dataset import Material
from chdstat.estimators.progressive.error_model import Spread, change_of, trials_of
from chdstat.estimators.progressive.learned import Trust

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network
    from chdstat.estimators.progressive.shrinkage import Trusted

__all__ = ["teach", "trusted"]

_WATCHING = 0.1
"""Share of the pixels that train nothing, and tell how large the errors are."""
_WATCHING_ALONE, _MOST_WATCHING = 512, 0.25
"""Without a reference that takes at least so many, up to this share: what they say is noisy."""
_FEWEST = 2


def teach(
    material: Material, *, channels: int, seed: int, progress: bool | None
) -> tuple[Network, Trust, Spread, npt.NDArray[np.float64]]:
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

    count = len(material.pixels)
    if count < _FEWEST:
        message = (
            f"training needs at least {_FEWEST} pixels without a bad sample, got {count}; give a "
            "larger image"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    order = rng.permutation(count)
    watching = _watching(count, alone=not material.lesson.reference)
    scenery = material.scenery
    shape = Shape(
        channels=channels,
        described=scenery.described.shape[1],
        neighbours=scenery.weight.shape[1] > 0,
        parts=material.splits.parts,
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Network(shape)
    with track("training", material.lesson.iterations, unit="it", show=progress) as advance:
        history = learn(
            network,
            material,
            train=order[watching:],
            validation=order[:watching],
            rng=rng,
            advance=advance,
        )
    believed, trust = trusted(network, material, order[:watching], rng)
    spread = Spread.learn(believed, material, pixels=order[:watching], rng=rng)
    return network, trust, spread, history


def _watching(count: int, *, alone: bool) -> int:
    """Return how many of the pixels watch."""
    usual = round(count * _WATCHING)
    more = min(_WATCHING_ALONE, round(count * _MOST_WATCHING)) if alone else 0
    return max(1, usual, more)


def trusted(
    network: Network,
    material: Material,
    validation: npt.NDArray[np.int64],
    rng: np.random.Generator,
) -> tuple[Trusted, Trust]:
    """Return a network that goes as far from the mean as it pays, and how far that is."""
    from chdstat.estimators.progressive.shrinkage import (
        Move,
        Trusted,
        keeping_mean,
        own_shares,
        reference_trust,
    )

    if material.lesson.reference:
        # Rare lamps and fireflies are in all pixels, hardly in a tenth of them.
        pixels = np.arange(len(material.pixels))
        trust = reference_trust(trials_of(network, material, pixels=pixels, rng=rng))
    else:
        held_out = trials_of(network, material, pixels=validation, rng=rng)
        shares = own_shares(map(Move.of, held_out))
        trust = keeping_mean(*shares, change_of(network, material))
    return Trusted(network, trust), trust
