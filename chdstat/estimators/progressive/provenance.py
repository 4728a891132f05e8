"""Provenance: where a trained progressive estimator comes from, ready for JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import chdstat
from chdstat.estimators.progressive.lessons import Material
from chdstat.samples import Samples

__all__ = ["provenance_of"]


def provenance_of(
    pictures: Sequence[Samples],
    material: Material,
    *,
    units: Sequence[float],
    sights: Mapping[str, bool],
    seed: int,
    trust: float,
) -> dict[str, Any]:
    """Return what is known of a training.

    Parameters
    ----------
    pictures, units
        What trained, and the mean radiance of each.
    material
        What was made of it.
    sights
        What the estimator looks at.
    seed
        Of the training.
    trust
        How far to go from the mean to what the network estimates.
    """
    return {
        "scene": ", ".join(picture.name for picture in pictures),
        "scenes": [
            {
                "scene": picture.name,
                "samples": picture.attrs,
                "samples_shape": list(picture.shape),
                "unit": unit,
                "pixels_used": used,
            }
            for picture, unit, used in zip(pictures, units, material.parts, strict=True)
        ],
        "samples": pictures[0].attrs,
        "samples_shape": list(pictures[0].shape),
        "reference": material.lesson.reference,
        **sights,
        "seed": seed,
        "pixels_used": len(material.pixels),
        "pixels_excluded": material.excluded,
        "sizes": sorted(set(material.lesson.sizes)),
        "iterations": material.lesson.iterations,
        "trust": trust,
        "chdstat": chdstat.__version__,
    }
