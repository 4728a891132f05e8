"""Training of the paper's network: from an image's samples to weights, history and provenance.

`PRESETS` are published networks, each a frozen list of choices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._core.arrays import generator
from chdstat._core.executor import track
from chdstat.errors import InputError
from chdstat.estimators.validation import (
    PUBLISHED_PIXELS,
    check_spp,
    checked_pixels,
    draw_pixels,
    training_batches,
)
from chdstat.samples import Samples

__all__ = ["PRESETS", "History", "Preset", "Trained", "train"]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How a network is built and trained; what the source leaves open is marked as chosen here.

    Attributes
    ----------
    name, source
        What it is called by, and where it was published.
    inputs
        Samples of one channel that go in, in the order drawn.
    hidden
        Neurons of each dense layer (ReLU, chosen here); one linear output follows.
    pixels
        Pixels drawn for training: 6400 where the image has them and at least a quarter of it
        remains to judge, 93 x 93 pixels or more; half of a smaller image.
    validation_share
        Part of the batches that only watch.
    iterations
        Minibatches seen.
    learning_rate
        Constant step size.
    minibatch
        Rows per iteration, drawn with replacement; chosen here.
    optimiser
        Adam with its usual moments (0.9, 0.999); chosen here.
    initialisation
        He-uniform matrices, zero biases; chosen here.
    scaling
        Radiance is divided by one constant, the mean training reference, and multiplied by it
        afterwards, so that training does not depend on the unit of radiance; chosen here.
    """

    name: str
    source: str
    inputs: int = 32
    hidden: tuple[int, ...] = (32, 32, 32)
    pixels: int = PUBLISHED_PIXELS
    validation_share: float = 0.1
    iterations: int = 30_000
    learning_rate: float = 0.005
    minibatch: int = 256
    optimiser: str = "adam"
    initialisation: str = "he-uniform"
    scaling: str = "training mean"

    @property
    def sizes(self) -> tuple[int, ...]:
        """Neurons of every layer, input and output among them."""
        return (self.inputs, *self.hidden, 1)


PRESETS = {
    preset.name: preset
    for preset in (
        Preset(
            name="elek2019",
            source="Elek, Thomas and Forbes 2019",
        ),
    )
}
"""Published networks by name."""


@dataclass(frozen=True)
class History:
    """How the training went; every field has shape (record,), errors are squared radiance.

    Attributes
    ----------
    iteration
        Iterations done.
    train_loss
        Mean loss of the minibatches since the record before.
    validation_loss
        Loss on (up to 16384 rows of) the validation part.
    train_baseline, validation_baseline
        Squared error of the sample mean on the same rows.
    """

    iteration: npt.NDArray[np.float64]
    train_loss: npt.NDArray[np.float64]
    validation_loss: npt.NDArray[np.float64]
    train_baseline: npt.NDArray[np.float64]
    validation_baseline: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trained:
    """All that training leaves behind.

    Attributes
    ----------
    weights
        A matrix (in, out) and a bias (out,) per layer.
    history
        Rows of `History`.
    train_pixels
        Pixels used, rows (y, x).
    train_shape
        Height and width of the image they lie in.
    scale
        Mean training reference; the network works in units of it.
    provenance
        Where it comes from, ready for JSON.
    """

    weights: list[npt.NDArray[np.float32]]
    history: npt.NDArray[np.float64]
    train_pixels: npt.NDArray[np.int64]
    train_shape: tuple[int, int]
    scale: float
    provenance: Mapping[str, Any]


def train(
    preset: Preset,
    samples: Samples,
    *,
    seed: int,
    iterations: int | None = None,
    pixels: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Trained:
    """Train a network on a part of an image's pixels; see `MLP.train`."""
    wanted = preset.iterations if iterations is None else iterations
    if wanted < 1:
        message = f"iterations must be at least 1, got {wanted}"
        raise InputError(message)
    check_spp(samples, preset.inputs)
    shape = samples.shape[:2]
    if pixels is None:
        chosen = draw_pixels(shape, preset.pixels, seed=seed)
    else:
        chosen = checked_pixels(pixels, shape)
    batches, references = training_batches(samples, chosen, preset.inputs)
    if len(batches) < 2:
        message = (
            f"training needs at least 2 batches without a bad sample, got {len(batches)} from "
            f"{len(chosen)} pixels with {samples.spp} spp; give a larger image or more samples"
        )
        raise InputError(message)
    scale = float(references.mean())
    weights, history = _fit(
        preset,
        *_scaled(batches, references, scale),
        iterations=wanted,
        rng=generator(seed).spawn(1)[0],
        progress=progress,
    )
    history[:, 1:] *= scale**2
    provenance = {
        "scene": samples.name,
        "samples": samples.attrs,
        "samples_shape": list(samples.shape),
        "seed": seed,
        "pixels_wanted": preset.pixels if pixels is None else len(chosen),
        "pixels_used": len(chosen),
        "batches_used": len(batches),
        "batches_excluded": len(chosen) * (samples.spp // preset.inputs) - len(batches),
        "iterations": int(history[-1, 0]) if len(history) else 0,
        "chdstat": chdstat.__version__,
    }
    return Trained(weights, history, chosen, shape, scale, provenance)


def _scaled(
    batches: npt.NDArray[np.float32], references: npt.NDArray[np.float64], scale: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Divide by the scene's mean; batches in place, for they are large. Black stays black."""
    unit = scale or 1.0
    batches /= np.float32(unit)
    return batches, (references / unit).astype(np.float32)


def _fit(
    preset: Preset,
    batches: npt.NDArray[np.float32],
    references: npt.NDArray[np.float32],
    *,
    iterations: int,
    rng: np.random.Generator,
    progress: bool | None,
) -> tuple[list[npt.NDArray[np.float32]], npt.NDArray[np.float64]]:
    """Run the descent on batches (batch, channel, sample) and references (batch, channel)."""
    from chdstat.estimators.network import TrainingRows, descend, initial_weights

    count, channels, n = batches.shape
    order = rng.permutation(count)
    watching = max(1, round(count * preset.validation_share))
    inputs, targets = batches.reshape(-1, n), references.reshape(-1)
    data = TrainingRows(
        inputs,
        targets,
        baseline=(inputs.mean(axis=1) - targets) ** 2,
        train=_rows(order[watching:], channels),
        validation=_rows(order[:watching], channels),
    )
    with track("training", iterations, unit="it", show=progress) as advance:
        return descend(
            initial_weights(preset.sizes, rng),
            data,
            iterations=iterations,
            minibatch=preset.minibatch,
            learning_rate=preset.learning_rate,
            rng=rng,
            advance=advance,
        )


def _rows(batches: npt.NDArray[np.int64], channels: int) -> npt.NDArray[np.int64]:
    """Return the rows of batches: their channels stay together on one side of the split."""
    return (batches[:, np.newaxis] * channels + np.arange(channels)).reshape(-1)
