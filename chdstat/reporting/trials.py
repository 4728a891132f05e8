"""Trials: what the report asks of our own estimator, beyond its comparison with others.

`Trials.of` turns its knob from MSE to relMSE, asks how often its intervals are right and how far it
is from what one pixel's samples tell, and lets it learn without a reference on the few samples that
it is to improve. All judging is left to `chdstat.compare`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat.comparison import Comparison, compare
from chdstat.estimators import EmpiricalPrior, Estimator, Progressive, mean
from chdstat.estimators.progressive import Estimates
from chdstat.io import denoise
from chdstat.metrics import Interval
from chdstat.samples import Samples

__all__ = ["BALANCES", "LEVELS", "Alone", "Coverage", "Trials"]

BALANCES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Places of the knob, from the least MSE to the least relMSE."""
LEVELS = (0.5, 0.8, 0.9, 0.95)
"""Probabilities that intervals state."""
_ALONE_SPP = 64
"""Samples that are improved without a reference."""
_STRENGTH = 1000.0
"""Of the smoothing of the prior that tells the limit: to choose it takes three times as long."""
_SOURCE = "this library"

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Coverage:
    """How often intervals hold the reference.

    Attributes
    ----------
    measured
        Shares at `LEVELS`, over pixels and channels.
    estimates
        The estimates of the whole picture, with the interval of 90 %.
    n
        Samples that they are made of.
    """

    measured: tuple[float, ...]
    estimates: Estimates
    n: int

    @property
    def at_90(self) -> float:
        """Share of the intervals of 90 % that hold the reference."""
        return self.measured[LEVELS.index(0.9)]


@dataclass(frozen=True)
class Alone:
    """What was learned without a reference.

    Attributes
    ----------
    comparison
        Of all estimates from the same few samples.
    coverage
        Of its intervals.
    iterations
        Minibatches that it learned from.
    """

    comparison: Comparison
    coverage: Coverage
    iterations: int


@dataclass(frozen=True)
class Trials:
    """What was asked of our estimator.

    Attributes
    ----------
    knob
        Comparison of the places of the knob, of the limits, and of the sample mean.
    coverage
        Of its intervals.
    alone
        Without a reference; None where there are too few samples.
    iterations
        Minibatches that it learned from, with a reference.
    """

    knob: Comparison
    coverage: Coverage
    alone: Alone | None
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
        """Ask the estimator that took part in a comparison; None where it did not.

        Parameters
        ----------
        samples, comparison
            The scene, and how estimators compare on it.
        iterations
            Minibatches to learn from without a reference; None takes the estimator's own number.
        progress
            As for `chdstat.compare`.
        """
        model = comparison.models.get("progressive")
        if not isinstance(model, Progressive):
            return None
        entries = [
            _entry(_place(balance), partial(model.predict, balance=balance)) for balance in BALANCES
        ]
        knob = compare(
            samples,
            ["mean", "progressive", *entries, *_limits(samples, model)],
            n=comparison.n,
            max_batches=1,
            model=model,
            cost=False,
            progress=progress,
        )
        picture = samples.read(ss=slice(0, comparison.n))
        return cls(
            knob=knob,
            coverage=_coverage(lambda level: model.estimate(picture, level=level), comparison),
            alone=_alone(samples, iterations, progress),
            iterations=int(model.history.iteration[-1]),
        )

    def along(self, measure: str) -> Interval:
        """Return a measure along the knob, averaged over channels, shape (place,)."""
        places = [self.knob.estimators.index(_place(balance)) for balance in BALANCES]
        return self.knob.measures[measure][places, -1]

    def limit(self, error: str) -> float:
        """Return the MSE or relMSE ratio of the posterior mean that is best for it, or NaN."""
        name = f"limit_{error}"
        if name not in self.knob.estimators:
            return float("nan")
        place = self.knob.estimators.index(name)
        return float(self.knob.measures[f"{error}_ratio"].value[place, -1])


def _place(balance: float) -> str:
    return f"balance {balance:g}"


def _entry(name: str, function: Callable[..., Array], **flags: bool) -> Estimator:
    return Estimator(name, function, _SOURCE, joint_channels=True, **flags)


def _limits(samples: Samples, model: Progressive) -> list[Estimator]:
    """Return the posterior means under the pixels that the estimator was trained on."""
    if samples.shape[2] not in (1, 3):
        return []
    prior = EmpiricalPrior.of(samples, pixels=model.train_pixels, strength=_STRENGTH)
    return [
        _entry(f"limit_{error}", partial(prior.predict, relative=relative))
        for error, relative in (("mse", 0.0), ("relmse", 1.0))
    ]


def _alone(samples: Samples, iterations: int | None, progress: bool | None) -> Alone | None:
    """Learn from the first samples alone, and judge by all others."""
    if samples.spp < 2 * _ALONE_SPP:
        return None
    features = samples.features
    few = samples.read(ss=slice(0, _ALONE_SPP))
    model = Progressive(features=bool(features), neighbours=True)
    model.train(
        Samples.from_array(few, features=features),
        reference=False,
        iterations=iterations,
        progress=progress,
    )
    ours = _entry("self_trained", model.predict, uses_neighbours=True, uses_features=True)
    found = compare(
        samples,
        ["mean", ours, *_denoised(features, samples.shape[2])],
        n=_ALONE_SPP,
        max_batches=1,
        cost=False,
        progress=progress,
    )

    def estimate(level: float) -> Estimates:
        return model.estimate(few, features=features, level=level)

    return Alone(found, _coverage(estimate, found), int(model.history.iteration[-1]))


def _denoised(features: Mapping[str, Array], channels: int) -> list[Estimator]:
    """Return Open Image Denoise on the sample mean, if it is installed."""
    if importlib.util.find_spec("pyoidn") is None or channels not in (1, 3):
        return []
    seen = {name: features[name] for name in ("albedo", "normal") if name in features}
    kinds: dict[str, Mapping[str, Array]] = {"oidn": {}}
    if len(seen) == 2:
        kinds["oidn_features"] = seen
    return [
        _entry(name, partial(_denoise_mean, seen=shown), uses_neighbours=True)
        for name, shown in kinds.items()
    ]


def _denoise_mean(x: npt.ArrayLike, *, seen: Mapping[str, Array]) -> Array:
    return denoise(mean(x), albedo=seen.get("albedo"), normal=seen.get("normal"))


def _coverage(estimate: Callable[[float], Estimates], judged: Comparison) -> Coverage:
    """Return how often the reference lies in an interval, over the pixels that judge."""
    by_level = {level: estimate(level) for level in LEVELS}
    usable = judged.test_pixels & np.isfinite(judged.first_reference).all(axis=-1)
    reference = judged.first_reference[usable].astype(np.float32)
    shares = [
        float(((found.low[usable] <= reference) & (reference <= found.high[usable])).mean())
        for found in by_level.values()
    ]
    return Coverage(tuple(shares), by_level[0.9], judged.n)
