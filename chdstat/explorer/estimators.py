"""Estimates of one place by fixed and trained estimators, and their errors.

`scored` and `scored_around` take the fixed estimators, `scored_learners` the trained ones. An
estimator that looks at the pixels around is given a part of the image, not all of it: its estimate
is close to that of `chdstat.estimate`, not the same to the bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import is_bad
from chdstat.comparison.accumulate import is_mean
from chdstat.errors import InputError
from chdstat.estimators import MLP, Estimates, Progressive, registry
from chdstat.estimators import mean as _mean
from chdstat.estimators.models import AnyModel, load_model
from chdstat.explorer.sources import StoreSource

__all__ = [
    "BATCHES_AROUND",
    "Learner",
    "ScoredEstimate",
    "ScoringBatches",
    "batches_of",
    "fixed_names",
    "learners",
    "quick_names",
    "score",
    "scored",
    "scored_around",
    "scored_learners",
]

_MOST_BATCHES = 32
"""Batches that estimators are scored on."""
BATCHES_AROUND = 4
"""Batches of those that look at the pixels around."""

_QUICK = 4e-3

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ScoredEstimate:
    """Estimate of one place by one estimator, with its errors.

    Attributes
    ----------
    name
        Of the estimator.
    value
        Mean of its estimates over the batches, shape (channel,), radiance.
    mse_ratio
        Mean squared error over that of the sample mean, over channels and batches; NaN where there
        is no reference, as the next two.
    bias
        Mean error relative to the mean reference.
    improved
        Share of the estimates that are nearer to the reference than the sample mean.
    certainty
        Of a trained estimator, the mean over batches; NaN where it has none.
    low, high
        Of a trained estimator, the ends of its interval, means over batches, shape (channel,).
    """

    name: str
    value: Floats
    mse_ratio: float
    bias: float
    improved: float
    certainty: float = float("nan")
    low: Floats | None = None
    high: Floats | None = None


@dataclass(frozen=True)
class ScoringBatches:
    """Batches of one place, with the references of their estimates.

    Attributes
    ----------
    x
        Shape (batch, channel, sample), float32; NaN where a sample is bad.
    truth, mean
        Reference and sample mean of each batch, shape (batch, channel).
    """

    x: npt.NDArray[np.float32]
    truth: Floats
    mean: Floats

    def first(self, count: int) -> ScoringBatches:
        """Return the first of them."""
        return ScoringBatches(self.x[:count], self.truth[:count], self.mean[:count])


def scored(
    x: npt.NDArray[np.float32],
    n: int,
    reference: npt.ArrayLike | None = None,
    *,
    names: Collection[str] | None = None,
    step: Callable[[], None] = lambda: None,
) -> list[ScoredEstimate]:
    """Judge every fixed estimator that needs no neighbours on batches of n samples.

    Parameters
    ----------
    x
        Linear radiance, shape (channel, sample); a sample with a bad channel counts for none.
    n
        Samples of a batch.
    reference
        True radiance, shape (channel,). Without, that of a batch is the mean of all other samples:
        no reference contains the batch that is scored against it.
    names
        Which estimators; None for all.
    step
        Called before each estimator; whatever it raises ends the computation.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 512)).astype(np.float32)
    >>> first = scored(x, 32)[0]
    >>> first.name, first.mse_ratio
    ('mean', 1.0)
    """
    batches = batches_of(x, n, reference)
    if batches is None:
        return []
    found = []
    for entry in _entries():
        if n >= entry.minimum_samples and (names is None or entry.name in names):
            step()
            found.append(score(entry.name, np.asarray(entry(batches.x), np.float64), batches))
    return found


def scored_around(
    x: npt.NDArray[np.float32],
    window: npt.NDArray[np.float32],
    place: tuple[int, int],
    n: int,
    reference: npt.ArrayLike | None = None,
    *,
    step: Callable[[], None] = lambda: None,
) -> list[ScoredEstimate]:
    """Judge the estimators that look at the pixels around, on a few batches: they are slow.

    Those that want first-hit features are left out: they learn from a whole image.

    Parameters
    ----------
    x, n, reference, step
        As for `scored`.
    window
        The first samples of the pixels around, shape (y, x, channel, sample).
    place
        (y, x) of the pixel in the window.
    """
    count = min(window.shape[-1] // n, BATCHES_AROUND)
    batches = batches_of(x, n, reference, most=count)
    if batches is None:
        return []
    cuts = [np.ascontiguousarray(window[..., i * n : (i + 1) * n]) for i in range(count)]
    found = []
    for entry in _entries(neighbours=True):
        if n >= entry.minimum_samples:
            step()
            estimates = np.stack([np.asarray(entry(cut), np.float64)[place] for cut in cuts])
            found.append(score(entry.name, estimates, batches))
    return found


def fixed_names() -> tuple[str, ...]:
    """Return the names of the fixed estimators that look at one pixel alone."""
    return tuple(entry.name for entry in _entries())


@cache
def quick_names() -> frozenset[str]:
    """Return the estimators that are quick enough for a click: 4 ms for all batches, tried once."""
    x = np.random.default_rng(0).gamma(0.5, size=(_MOST_BATCHES, 3, 32)).astype(np.float32)
    return frozenset(e.name for e in _entries() if min(_seconds(e, x) for _ in range(3)) < _QUICK)


def _seconds(entry: registry.Estimator, x: npt.NDArray[np.float32]) -> float:
    start = time.perf_counter()
    entry(x)
    return time.perf_counter() - start


def _entries(*, neighbours: bool = False) -> list[registry.Estimator]:
    entries = (registry.lookup(name) for name in registry.names("fixed"))
    fixed = (e for e in entries if isinstance(e, registry.Estimator))
    return [e for e in fixed if e.uses_neighbours == neighbours and not e.uses_features]


def batches_of(
    x: npt.NDArray[np.float32],
    n: int,
    reference: npt.ArrayLike | None = None,
    *,
    most: int = _MOST_BATCHES,
) -> ScoringBatches | None:
    """Return batches of n samples of a place, None for too few samples; options as of `scored`."""
    count = min(x.shape[1] // n, most)
    if count == 0:
        return None
    x = np.where(is_bad(x).any(axis=0), np.float32(np.nan), x)
    batches = x[:, : count * n].reshape(len(x), count, n).swapaxes(0, 1)
    if reference is None:
        truth = _held_out(x, batches)
    else:
        truth = np.broadcast_to(np.asarray(reference, np.float64), batches.shape[:2])
    return ScoringBatches(batches, truth, np.asarray(_mean(batches), np.float64))


def _held_out(x: npt.NDArray[np.float32], batches: npt.NDArray[np.float32]) -> Floats:
    """Return the mean of the samples outside each batch, NaN where they are fewer than in it."""
    total, of_batch = np.nansum(x, axis=-1, dtype=np.float64), np.isfinite(batches)
    sums = np.where(of_batch, batches, 0).sum(axis=-1, dtype=np.float64)
    rest = np.isfinite(x).sum(axis=-1) - np.count_nonzero(of_batch, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = np.maximum(total - sums, 0) / rest
    return np.where(rest >= batches.shape[-1], means, np.nan)


def score(name: str, estimates: Floats, batches: ScoringBatches) -> ScoredEstimate:
    """Compare the estimates of an estimator, shape (batch, channel), with the reference."""
    truth, mean = batches.truth, batches.mean
    known = np.isfinite(truth) & np.isfinite(estimates) & np.isfinite(mean)
    nan = float("nan")
    if not known.any():
        return ScoredEstimate(name, _average(estimates), nan, nan, nan)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # In units of the reference, so that 1e30 squared stays a number.
        scale = np.float64(truth[known].mean())
        difference = (estimates - truth)[known] / scale
        error, of_mean = difference**2, ((mean - truth)[known] / scale) ** 2
        ratio = float(error.sum() / of_mean.sum())
    if name == "mean":
        return ScoredEstimate(name, _average(estimates), 1.0, float(difference.mean()), nan)
    improved = float(((error < of_mean) & ~is_mean(estimates[known], mean[known])).mean())
    return ScoredEstimate(name, _average(estimates), ratio, float(difference.mean()), improved)


_RADIUS = 24
"""Pixels to each side that a model sees, where it looks around."""
_PART = 256
"""Side of the part of an image that tells how far a model is followed."""

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Learner:
    """A trained estimator.

    Attributes
    ----------
    name
        Of its file, or of the model.
    model
        The trained model.
    """

    name: str
    model: AnyModel
    _trust: dict[tuple[int, int], float] = field(default_factory=dict, repr=False)

    def trust(self, source: StoreSource, n: int) -> float:
        """Return how far it pays on an image to follow it, from n samples of each pixel.

        It is measured once, on a part of a large image: 1 where it was trained on the scene.
        """
        samples = source.samples
        if not isinstance(self.model, Progressive) or self.model.trained_on(samples.attrs):
            return 1.0
        key = id(samples), n
        if key not in self._trust:
            ys, xs = (
                slice((k - _PART) // 2, (k + _PART) // 2) if k > _PART else slice(None)
                for k in samples.shape[:2]
            )
            features = {name: own[ys, xs] for name, own in samples.features.items()}
            self._trust[key] = self.model.trust(
                samples.read(ys, xs, slice(n)),
                features=features if self.model.inputs.features else None,
            )
        return self._trust[key]

    @property
    def looks_around(self) -> bool:
        """Whether it wants an image, for first-hit features or for neighbours."""
        return isinstance(self.model, Progressive) and (
            self.model.inputs.features or self.model.inputs.neighbours
        )


def learners(models: Sequence[AnyModel | str | Path]) -> list[Learner]:
    """Return trained estimators, read from their files where they are files.

    Raises
    ------
    StoreError
        If a file cannot be read, or holds something else.
    InputError
        If one looks at direct light, which the page does not read.
    """
    found = [
        Learner(Path(model).stem, load_model(model))
        if isinstance(model, str | Path)
        else Learner(model.name, model)
        for model in models
    ]
    for learner in found:
        if isinstance(learner.model, Progressive) and learner.model.inputs.direct:
            message = (
                f"{learner.name} sees direct light, which the page does not read; give a model "
                "without that input"
            )
            raise InputError(message)
    return found


def scored_learners(
    found: Sequence[Learner],
    batches: ScoringBatches,
    source: StoreSource | None,
    place: tuple[int, ...],
    unit: float | None,
    *,
    step: Callable[[], None] = lambda: None,
) -> list[ScoredEstimate]:
    """Judge trained estimators on the batches of a place.

    Left out is what does not apply: a model for another number of samples or channels, and one
    that looks around where there is no image, as for a region.

    Parameters
    ----------
    found
        The estimators.
    batches
        Of the place, as `chdstat.explorer.estimators.batches_of` makes them.
    source
        The store, whose samples lie around; None where there is none.
    place
        (y, x), or the four numbers of a region.
    unit
        Mean radiance of the image; None where it is not known.
    step
        Called before each; whatever it raises ends the computation.
    """
    estimates = []
    for learner in found:
        step()
        if learner.looks_around:
            if source is None or len(place) != 2:
                continue
            some = batches.first(BATCHES_AROUND)
            estimated = _around(learner, some, source, (place[0], place[1]), unit)
        else:
            some = batches
            estimated = _alone(learner, some.x, source, unit)
        if estimated is not None:
            estimates.append(_scored_learner(learner.name, estimated, some))
    return estimates


def _alone(
    learner: Learner, x: Image, source: StoreSource | None, unit: float | None
) -> Estimates | None:
    """Return estimates from batches (batch, channel, sample), each by itself."""
    model = learner.model
    if isinstance(model, MLP):
        if x.shape[-1] != model.inputs:
            return None
        radiance = model.predict(x)
        nothing = np.full_like(radiance, np.nan)
        return Estimates(radiance, nothing[..., 0], nothing, nothing, float("nan"))
    if x.shape[-2] != model.channels:
        return None
    # Without an image, what the place tells must do.
    trust = model.trust(x, unit=unit) if source is None else learner.trust(source, x.shape[-1])
    return model.estimate(x, unit=unit, trust=trust)


def _around(
    learner: Learner,
    some: ScoringBatches,
    source: StoreSource,
    place: tuple[int, int],
    unit: float | None,
) -> Estimates | None:
    """Return estimates of a pixel from a part of the image around it, batch by batch."""
    model = learner.model
    known = set(source.samples.features)
    if isinstance(model, MLP) or some.x.shape[-2] != model.channels:
        return None
    if model.inputs.features and not known:
        return None
    count, _, n = some.x.shape
    window, (y, x), (ys, xs) = source.around(*place, count * n, radius=_RADIUS)
    features = {name: field[ys, xs] for name, field in source.samples.features.items()}
    trust = learner.trust(source, n)
    found = [
        model.estimate(
            np.ascontiguousarray(window[..., i * n : (i + 1) * n]),
            features=features if model.inputs.features else None,
            unit=unit,
            trust=trust,
        )
        for i in range(count)
    ]
    return Estimates(
        np.stack([e.radiance[y, x] for e in found]),
        np.stack([e.certainty[y, x] for e in found]),
        np.stack([e.low[y, x] for e in found]),
        np.stack([e.high[y, x] for e in found]),
        found[0].level,
    )


def _scored_learner(name: str, estimated: Estimates, some: ScoringBatches) -> ScoredEstimate:
    found = score(name, np.asarray(estimated.radiance, np.float64), some)
    return replace(
        found,
        certainty=float(_average(estimated.certainty)),
        low=_average(estimated.low),
        high=_average(estimated.high),
    )


def _average(values: npt.NDArray[np.floating[Any]]) -> Floats:
    known = np.isfinite(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.where(known, values, 0).sum(axis=0, dtype=np.float64)
        return np.asarray(total / known.sum(axis=0))
