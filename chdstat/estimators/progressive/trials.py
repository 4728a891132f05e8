"""Trials: estimates from some samples of pixels, and what the other samples say of them.

The samples that an estimate p has not seen are cut in two. Their means t and u are independent and
unbiased, and so ``(p - t)(p - u)`` has the expectation ``(p - y)^2`` whatever the truth y is: this
tells errors without a reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans
from chdstat.estimators.progressive.causes import causes_of
from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.shapes import AIMS
from chdstat.estimators.progressive.splits import Part

if TYPE_CHECKING:
    from torch import nn

__all__ = ["Trial", "change_of", "trials_of"]

_DRAWS, _TIMES, _SAMPLES = 16, 4, 256
"""Splits of each size, of each pixel on average, and samples of a pixel in all of these, at least:
few samples of a lamp or a firefly are noisy."""
_ROWS = 1024
_CUTS = 4
"""Ways to cut the other samples in two: together they tell their noise better than one does. With a
reference it is small, and one tells enough."""

Floats = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Trial:
    """Estimates of some pixels, in units of the picture's radiance.

    Attributes
    ----------
    size
        Samples of each estimate.
    rows
        Which pixels, shape (row,).
    estimate
        Shape (aim, row, channel).
    mean, target
        Of the samples that were seen and of the others, shape (row, channel).
    noise
        Unbiased for the variance of the target, shape (row, channel).
    causes
        Of squared errors, shape (aim, row, channel, cause).
    """

    size: int
    rows: npt.NDArray[np.int64]
    estimate: Floats
    mean: Floats
    target: Floats
    noise: Floats
    causes: Floats

    @property
    def squared(self) -> Floats:
        """Unbiased for the squared error of the estimate, shape (aim, row, channel)."""
        return np.asarray((self.estimate - self.target) ** 2 - self.noise)

    @classmethod
    def of(
        cls, network: nn.Module, material: Material, part: Part, rng: np.random.Generator
    ) -> Self:
        """Estimate from a part of the samples."""
        import torch

        from chdstat.estimators.progressive.training import look

        with torch.inference_mode():
            answer = network(look(part.profile, material.scenery[part.rows], part.shared, "cpu"))
        times = 1 if material.lesson.reference else _CUTS
        noise = [material.splits.halves(part, rng).noise for _ in range(times)]
        return cls(
            size=part.size,
            rows=part.rows,
            estimate=np.moveaxis(answer.estimate.numpy().astype(np.float64), 1, 0),
            mean=answer.mean.numpy().astype(np.float64),
            target=part.target.astype(np.float64),
            noise=np.mean(noise, axis=0),
            causes=np.stack([causes_of(answer, part.profile, aim) for aim in range(len(AIMS))]),
        )


def trials_of(
    network: nn.Module,
    material: Material,
    *,
    pixels: npt.NDArray[np.int64],
    rng: np.random.Generator,
    samples: int = _SAMPLES,
) -> list[Trial]:
    """Return trials of pixels at all sizes of the lesson, four or more of each pixel.

    So many `samples` of a pixel are seen at least in all its trials of a size.
    """
    found = []
    for n in sorted(set(material.lesson.sizes)):
        drawn, least = 0, _DRAWS
        while least > 0 or drawn < max(_TIMES, samples / n) * len(pixels):
            part = material.splits.draw(pixels, n, _ROWS, rng)
            found.append(Trial.of(network, material, part, rng))
            drawn, least = drawn + len(part.rows), least - 1
    return found


def change_of(network: nn.Module, material: Material) -> Floats:
    """Return what a network adds to the mean of all samples of pixels, shape (pixel, channel).

    It is the mean of what it adds under each aim, in units of the picture's radiance, and nothing
    where all samples are the same light: there the mean is kept.
    """
    import torch

    from chdstat.estimators.progressive.training import look

    splits, found = material.splits, []
    for block in spans(len(splits), _ROWS):
        profile, shared = splits.whole(np.arange(block.start, block.stop))
        with torch.inference_mode():
            answer = network(look(profile, material.scenery[block], shared, "cpu"))
        found.append((answer.estimate.mean(dim=1) - answer.mean).numpy().astype(np.float64))
    noisy = splits.variance.any(axis=-1, keepdims=True)
    lit = splits.mean.any(axis=-1, keepdims=True)
    return np.where(noisy | ~lit, np.concatenate(found), 0)
