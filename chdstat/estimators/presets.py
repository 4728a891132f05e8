"""Presets: published networks, each a frozen list of choices."""

from __future__ import annotations

from dataclasses import dataclass

from chdstat.estimators.heldout import PUBLISHED_PIXELS

__all__ = ["PRESETS", "Preset"]


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
