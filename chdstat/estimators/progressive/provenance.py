"""Provenance: where a trained progressive estimator comes from, ready for JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import chdstat
from chdstat.estimators.progressive.inputs import InputConfig
from chdstat.estimators.progressive.lessons import Material
from chdstat.estimators.progressive.results import Trust
from chdstat.samples import Samples

__all__ = ["Origin", "provenance_of"]


@dataclass(frozen=True)
class Origin:
    """A picture that trained.

    Attributes
    ----------
    scene
        Its name.
    attrs
        Provenance of its samples.
    shape
        Of its samples, (y, x, channel, sample).
    unit
        Its mean radiance.
    """

    scene: str
    attrs: Mapping[str, Any]
    shape: tuple[int, ...]
    unit: float

    @classmethod
    def of(cls, picture: Samples, unit: float) -> Self:
        """Return that of samples."""
        return cls(picture.name, picture.attrs, picture.shape, unit)

    def to_dict(self, pixels_used: int) -> dict[str, Any]:
        """Return the fields, and how many of its pixels were used, ready for JSON."""
        return {
            "scene": self.scene,
            "samples": dict(self.attrs),
            "samples_shape": list(self.shape),
            "unit": self.unit,
            "pixels_used": pixels_used,
        }


def provenance_of(
    origins: Sequence[Origin],
    material: Material,
    *,
    inputs: InputConfig,
    seed: int,
    trust: Trust,
) -> dict[str, Any]:
    """Return what is known of a training.

    Parameters
    ----------
    origins
        What trained.
    material
        What was made of it.
    inputs
        Of the estimator.
    seed
        Of the training.
    trust
        How far to go from the mean to what the network estimates; its average is noted.
    """
    scenes = [one.to_dict(used) for one, used in zip(origins, material.parts, strict=True)]
    return {
        "scene": ", ".join(one.scene for one in origins),
        "scenes": scenes,
        "samples": scenes[0]["samples"],
        "samples_shape": scenes[0]["samples_shape"],
        "reference": material.lesson.reference,
        "inputs": list(inputs.names),
        "seed": seed,
        "pixels_used": len(material.pixels),
        "pixels_excluded": material.excluded,
        "sizes": sorted(set(material.lesson.sizes)),
        "iterations": material.lesson.iterations,
        "trust": float(trust.shares.mean()),
        "chdstat": chdstat.__version__,
    }
