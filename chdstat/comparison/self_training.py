"""Self-training: an estimate without a reference, and its errors against all other samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np

from chdstat.comparison.side_by_side import compare
from chdstat.comparison.tables import Comparison
from chdstat.estimators import Estimator, Progressive
from chdstat.estimators.progressive import Estimates
from chdstat.samples import Samples

__all__ = ["LEVELS", "SelfTraining", "coverage"]

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities that intervals state."""
_SPP = 64
"""Samples that are improved without a reference."""


@dataclass(frozen=True)
class SelfTraining:
    """An estimate without a reference, and its errors.

    Attributes
    ----------
    comparison
        Of the mean and the estimate from the same samples.
    estimates
        The estimate of the whole image, with its certainty and the interval of 90 %.
    coverage
        Share of the intervals that contain the reference, at `LEVELS`, by what estimated.
    iterations
        Minibatches of the training.
    """

    comparison: Comparison
    estimates: Estimates
    coverage: Mapping[str, tuple[float, ...]]
    iterations: int

    @classmethod
    def of(
        cls,
        samples: Samples,
        comparison: Comparison,
        *,
        iterations: int | None,
        progress: bool | None,
    ) -> Self | None:
        """Train on the first samples; None where they are too few, or ours was not compared.

        Parameters
        ----------
        samples, comparison
            The scene, and how estimators compare on it.
        iterations
            Minibatches of the training; None takes the estimator's own number.
        progress
            As for `chdstat.compare`.
        """
        supervised = comparison.models.get("progressive")
        if not isinstance(supervised, Progressive) or samples.spp < 2 * _SPP:
            return None
        features = samples.features
        few = samples.read(ss=slice(0, _SPP))
        model = Progressive(inputs=["features", "neighbours"] if features else ["neighbours"])
        model.train(
            Samples.from_array(few, features=features, axes="yxcs"),
            reference=False,
            iterations=iterations,
            progress=progress,
        )
        ours = Estimator(
            "self_trained",
            partial(model.predict, trust=1.0),
            "this library",
            joint_channels=True,
            uses_neighbours=True,
            uses_features=True,
        )
        found = compare(samples, ["mean", ours], n=_SPP, max_batches=1, progress=progress)
        first = samples.read(ss=slice(0, comparison.n))
        own = {
            level: model.estimate(few, features=features, level=level, trust=1.0)
            for level in LEVELS
        }
        return cls(
            comparison=found,
            estimates=own[0.9],
            coverage={
                f"{_SPP} spp, without a reference": coverage(own.__getitem__, found),
                f"{comparison.n} spp, with one": coverage(
                    lambda level: supervised.estimate(first, level=level, trust=1.0), comparison
                ),
            },
            iterations=int(model.history.iteration[-1]),
        )


def coverage(estimate: Callable[[float], Estimates], comparison: Comparison) -> tuple[float, ...]:
    """Return the share of the test pixels' intervals, at `LEVELS`, that contain the reference."""
    usable = comparison.test_pixels & np.isfinite(comparison.first_reference).all(axis=-1)
    reference = comparison.first_reference[usable].astype(np.float32)
    found = [estimate(level) for level in LEVELS]
    return tuple(
        float(((x.low[usable] <= reference) & (reference <= x.high[usable])).mean()) for x in found
    )
