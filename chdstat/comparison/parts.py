"""Parts: what a comparison says of each pattern, and of a few pixels one by one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison._tables import row_of
from chdstat.errors import InputError
from chdstat.metrics import Interval

__all__ = ["Breakdown", "PixelEstimates"]


@dataclass(frozen=True)
class PixelEstimates:
    """A few pixels that no estimator was trained on, one batch each.

    Attributes
    ----------
    pixels
        Rows (y, x), from dark to bright, shape (pixel, 2).
    estimators
        Names.
    channels
        Names of the channels.
    reference
        Mean of all other samples, radiance, shape (pixel, channel).
    mean
        Sample mean of the batch, radiance, shape (pixel, channel).
    estimates
        Radiance, shape (estimator, pixel, channel).
    n
        Samples per estimate.
    """

    pixels: npt.NDArray[np.int64]
    estimators: tuple[str, ...]
    channels: tuple[str, ...]
    reference: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float32]
    estimates: npt.NDArray[np.float32]
    n: int

    def table(self) -> list[dict[str, Any]]:
        """Return one row per pixel and channel: where, reference, mean, every estimate."""
        return [
            {
                "y": int(y),
                "x": int(x),
                "channel": channel,
                "reference": float(self.reference[k, c]),
                "sample_mean": float(self.mean[k, c]),
                **{name: float(self.estimates[e, k, c]) for e, name in enumerate(self.estimators)},
            }
            for k, (y, x) in enumerate(self.pixels)
            for c, channel in enumerate(self.channels)
        ]


@dataclass(frozen=True)
class Breakdown:
    """Which estimator for which pattern: the measures by label, averaged over channels.

    Attributes
    ----------
    labels
        Names of the labels that occur among the pixels that judge.
    estimators
        Names.
    uses_neighbours
        Which estimators look at the pixels around, shape (estimator,).
    pixels
        Pixels with each label that judge, shape (label,).
    measures
        By the names of `MEASURES`: intervals over blocks, shape (label, estimator).
    """

    labels: tuple[str, ...]
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    pixels: npt.NDArray[np.int64]
    measures: Mapping[str, Interval]

    def best(self, measure: str = "relmse", *, neighbours: bool = False) -> tuple[str, ...]:
        """Return the estimator with the smallest error for each label; '' where none has one.

        Parameters
        ----------
        measure
            "mse" or "relmse".
        neighbours
            Whether those that look at the pixels around take part.

        Raises
        ------
        InputError
            If the measure is another.
        """
        if measure not in {"mse", "relmse"}:
            message = f"measure must be 'mse' or 'relmse', got {measure!r}"
            raise InputError(message)
        value = self.measures[measure].value
        eligible = np.asarray(np.isfinite(value) & (neighbours | ~self.uses_neighbours))
        known = np.asarray(eligible.any(axis=1))
        ranked = np.where(eligible, value, np.inf).argmin(axis=1)
        return tuple(
            self.estimators[k] if any_known else ""
            for k, any_known in zip(ranked.tolist(), known.tolist(), strict=True)
        )

    def table(self) -> list[dict[str, Any]]:
        """Return one row per label and estimator: names, pixels and every measure."""
        return [
            {
                "label": label,
                "pixels": int(self.pixels[row]),
                "estimator": name,
                "uses_neighbours": bool(self.uses_neighbours[k]),
                **row_of(self.measures, (row, k)),
            }
            for row, label in enumerate(self.labels)
            for k, name in enumerate(self.estimators)
        ]
