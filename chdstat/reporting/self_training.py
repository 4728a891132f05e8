"""Self-training: what the report shows of an estimate that has no reference to learn from.

In practice there is no reference image. `SelfTraining.of` trains on the first samples of a scene
alone, and lets all other samples judge the estimate, its certainty and its intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from chdstat import viz
from chdstat._image_scales import display_stops
from chdstat.comparison import Comparison, compare
from chdstat.estimators import Estimator, Progressive
from chdstat.estimators.progressive import Estimates
from chdstat.reporting.text import number, percent
from chdstat.samples import Samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["LEVELS", "SelfTraining"]

LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities that intervals state."""
_SPP = 64
"""Samples that are improved without a reference."""


@dataclass(frozen=True)
class SelfTraining:
    """An estimate without a reference, and how it was judged.

    Attributes
    ----------
    comparison
        Of the mean and the estimate from the same samples.
    estimates
        The estimate of the whole image, with its certainty and the interval of 90 %.
    coverage
        Share of the intervals that hold the reference, at `LEVELS`, by what estimated.
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
        """Train on the first samples; None where they are too few, or nobody compared ours.

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
        by_level = {
            level: model.estimate(few, features=features, level=level, trust=1.0)
            for level in LEVELS
        }
        return cls(
            comparison=found,
            estimates=by_level[0.9],
            coverage={
                f"{_SPP} spp, without a reference": coverage(by_level.__getitem__, found),
                f"{comparison.n} spp, with one": coverage(
                    lambda level: supervised.estimate(first, level=level, trust=1.0), comparison
                ),
            },
            iterations=int(model.history.iteration[-1]),
        )

    def content(self) -> dict[str, Any]:
        """Return its numbers, ready for JSON."""
        _, row = self.comparison.table()
        shares = [percent(measured[LEVELS.index(0.9)]) for measured in self.coverage.values()]
        return {
            "n": self.comparison.n,
            "iterations": self.iterations,
            "mse_ratio": number(row["mse_ratio"]),
            "relmse_ratio": number(row["relmse_ratio"]),
            "improved": percent(row["improved"]),
            "bias": percent(row["bias"], sign=True),
            "at_90": shares[0],
            "at_90_supervised": shares[1],
        }

    def figure(self) -> Figure:
        """Draw mean, estimate and reference; certainty, width and coverage of the intervals."""
        found = self.estimates
        with np.errstate(divide="ignore", invalid="ignore"):
            width = np.abs(found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)
        width[~np.isfinite(width)] = np.nan
        mean, ours = self.comparison.estimates
        exposure = display_stops(self.comparison.reference)
        images = {
            f"Mean of {self.comparison.n} samples": mean,
            "Self-trained": ours,
            "Reference": self.comparison.reference,
        }
        height, size = found.certainty.shape
        return viz.map_grid(
            [
                *(viz.image_map(x, title=t, exposure=exposure) for t, x in images.items()),
                viz.value_map(found.certainty, title="Certainty", limits=(0, 1)),
                viz.value_map(width, title="Width of the interval ÷ estimate", limits=(0, 3)),
                viz.coverage(LEVELS, self.coverage, title="Intervals that hold the reference"),
            ],
            columns=3,
            aspect=height / size,
        )


def coverage(estimate: Callable[[float], Estimates], judged: Comparison) -> tuple[float, ...]:
    """Return how often the reference lies in an interval of each level, over the test pixels."""
    usable = judged.test_pixels & np.isfinite(judged.first_reference).all(axis=-1)
    reference = judged.first_reference[usable].astype(np.float32)
    found = [estimate(level) for level in LEVELS]
    return tuple(
        float(((x.low[usable] <= reference) & (reference <= x.high[usable])).mean()) for x in found
    )
