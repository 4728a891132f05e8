"""Teaching: a new network from material, with what errors to expect of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._arrays import generator
from chdstat.errors import InputError
from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.shapes import Shape
from chdstat.estimators.progressive.spread import Spread
from chdstat.progress import track

if TYPE_CHECKING:
    from chdstat.estimators.progressive.network import Network

__all__ = ["teach"]

_VALIDATION_SHARE = 0.1
_FEWEST = 2


def teach(
    material: Material, *, channels: int, seed: int, progress: bool | None
) -> tuple[Network, Spread, npt.NDArray[np.float64]]:
    """Train a network; one pixel in ten only watches, and tells how large the errors are.

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
    spread : Spread
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
            "larger picture"
        )
        raise InputError(message)
    rng = generator(seed).spawn(1)[0]
    order = rng.permutation(count)
    watching = max(1, round(count * _VALIDATION_SHARE))
    scenery = material.scenery
    shape = Shape(
        channels=channels,
        described=scenery.described.shape[1],
        neighbours=scenery.weight.shape[1] > 0,
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
    spread = Spread.learn(network, material, pixels=order[:watching], rng=rng)
    return network, spread, history
