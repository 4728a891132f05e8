"""Estimates of one place by fixed and trained estimators, and their errors.

`batches_of` cuts the samples of a place into batches; `scored` and `scored_around` let the fixed
estimators estimate from them, `Learner.score` a trained one. An estimator that looks at the
pixels around, as the default estimate does, is given a part of the image with its first-hit
features, not all of it: its estimate is close to that of `chdstat.estimate`, not the same.
"""

from __future__ import annotations

import timeit
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import estimators
from chdstat._core.arrays import Floats, Image, is_bad
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.comparison.entries import Entry, choose, estimate_by, takes
from chdstat.comparison.metrics import SUMS, errors_of
from chdstat.errors import OtherSceneWarning
from chdstat.estimators import MLP, Progressive, registry
from chdstat.estimators.training import TrainedModel, load_model
from chdstat.estimators.validation import Totals
from chdstat.explorer.sources import StoreSource
from chdstat.explorer.view import Box, Pixel
from chdstat.samples import Samples

__all__ = [
    "BATCHES_AROUND",
    "Learner",
    "ScoredEstimate",
    "ScoringBatches",
    "batches_of",
    "fixed",
    "learners",
    "quick_names",
    "scored",
    "scored_around",
]

_MOST_BATCHES = 32
"""Batches that estimators are scored on."""
BATCHES_AROUND = 4
"""Batches that estimators which look at the pixels around are scored on: they are slow."""
_AROUND, _AROUND_LEARNED = 10, 24
"""Pixels to each side that fixed and trained estimators look at."""
_QUICK = 4e-3

Step = Callable[[], None]


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
    given
        Whether it is a trained estimator that the page was opened with.
    """

    name: str
    value: Floats
    mse_ratio: float
    bias: float
    improved: float
    certainty: float = float("nan")
    low: Floats | None = None
    high: Floats | None = None
    given: bool = False


@dataclass(frozen=True)
class ScoringBatches:
    """Batches of samples, with the references of their estimates.

    Attributes
    ----------
    x
        Shape (batch, ..., channel, sample), float32; NaN where a sample is bad.
    truth, mean
        Reference and sample mean of each batch, shape (batch, ..., channel).
    """

    x: Image
    truth: Floats
    mean: Floats

    @property
    def n(self) -> int:
        """Samples of a batch."""
        return int(self.x.shape[-1])

    def first(self, count: int) -> ScoringBatches:
        """Return the first of them."""
        return ScoringBatches(self.x[:count], self.truth[:count], self.mean[:count])


def batches_of(
    x: Image, n: int, reference: npt.ArrayLike | None = None, *, most: int = _MOST_BATCHES
) -> ScoringBatches | None:
    """Return batches of consecutive samples, None where there are too few.

    Parameters
    ----------
    x
        Linear radiance, shape (..., channel, sample); a sample with a bad channel is left out.
    n
        Samples of a batch.
    reference
        True radiance, shape (..., channel). Without, that of a batch is the mean of all other
        samples, as in `chdstat.compare`: no reference contains the batch that is scored against
        it. NaN where there are fewer than 2 n samples, or the batch holds a bad one.
    most
        Batches at most.
    """
    count = min(x.shape[-1] // n, most)
    if count == 0:
        return None
    x = np.where(is_bad(x).any(axis=-2, keepdims=True), np.float32(np.nan), x)
    batches = np.moveaxis(x[..., : count * n].reshape(*x.shape[:-1], count, n), -2, 0)
    truth = np.full(batches.shape[:-1], np.nan if reference is None else reference)
    if reference is None and x.shape[-1] >= 2 * n:
        good = np.isfinite(x).all(axis=-2)
        totals = Totals(np.nansum(x, axis=-1, dtype=np.float64), good.sum(axis=-1))
        truth = np.stack([totals.mean_without(batch) for batch in batches])
    return ScoringBatches(batches, truth, np.asarray(estimators.mean(batches), np.float64))


def _score(name: str, estimates: npt.ArrayLike, batches: ScoringBatches) -> ScoredEstimate:
    """Compare the estimates of an estimator, shape (batch, channel), with the reference."""
    estimates = np.asarray(estimates, np.float64)
    truth, mean = batches.truth, batches.mean
    known = np.isfinite(truth) & np.isfinite(estimates) & np.isfinite(mean)
    found = ScoredEstimate(name, _average(estimates), *(float("nan"),) * 3)
    if not known.any():
        return found
    own, of_mean = (
        dict(zip(SUMS, np.moveaxis(errors, 1, 0)[:, known], strict=True))
        for errors in (errors_of(p, mean, truth, scene_mean=np.ones(1)) for p in (estimates, mean))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = own["squared"].sum() / of_mean["squared"].sum()
        bias = own["error"].mean() / truth[known].mean()
    if name == "mean":
        return replace(found, mse_ratio=1.0, bias=float(bias))
    improved = float(own["improved"].mean())
    return replace(found, mse_ratio=float(ratio), bias=float(bias), improved=improved)


def _average(values: npt.NDArray[np.floating[Any]]) -> Floats:
    known = np.isfinite(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.where(known, values, 0).sum(axis=0, dtype=np.float64)
        return np.asarray(total / known.sum(axis=0))


# --- fixed estimators ---------------------------------------------------------------------------


def fixed(*, neighbours: bool = False) -> dict[str, registry.Estimator]:
    """Return the fixed estimators of one pixel by name, or those that look at the pixels around."""
    entries = {name: registry.lookup(name) for name in registry.names("fixed")}
    return {
        name: entry
        for name, entry in entries.items()
        if isinstance(entry, registry.Estimator) and entry.uses_neighbours == neighbours
    }


@cache
def quick_names() -> frozenset[str]:
    """Return the estimators that are quick enough for a click: 4 ms for all batches, tried once."""
    x = np.random.default_rng(0).gamma(0.5, size=(_MOST_BATCHES, 3, 32)).astype(np.float32)
    timed = ((n, timeit.repeat(partial(e, x), number=1, repeat=3)) for n, e in fixed().items())
    return frozenset(name for name, seconds in timed if min(seconds) < _QUICK)


def scored(
    batches: ScoringBatches, *, names: Collection[str] | None = None, step: Step = lambda: None
) -> list[ScoredEstimate]:
    """Score every fixed estimator of one pixel.

    Parameters
    ----------
    batches
        Batches of a place.
    names
        Which estimators; None for all.
    step
        Called before each estimator; whatever it raises ends the computation.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 512)).astype(np.float32)
    >>> first = scored(batches_of(x, 32))[0]
    >>> first.name, first.mse_ratio
    ('mean', 1.0)
    """
    found = []
    for name, entry in fixed().items():
        if batches.n >= entry.minimum_samples and (names is None or name in names):
            step()
            found.append(_score(name, entry(batches.x), batches))
    return found


def scored_around(
    batches: ScoringBatches,
    source: StoreSource,
    place: tuple[int, int],
    *,
    step: Step = lambda: None,
) -> list[ScoredEstimate]:
    """Score the fixed estimators that look at the pixels around, on a few batches.

    Parameters
    ----------
    batches
        Batches of the pixel.
    source
        The store, of whose pixels those around are read.
    place
        (y, x) of the pixel.
    step
        As for `scored`.
    """
    batches, found = batches.first(BATCHES_AROUND), []
    for entry, radius in _around(source.samples, batches.n):
        window, (y, x), (ys, xs) = source.around(*place, len(batches.x) * batches.n, radius=radius)
        features = {name: image[ys, xs] for name, image in source.samples.features.items()}
        estimates = []
        for cut in _cut(window, batches.n):
            step()
            estimates.append(estimate_by(entry, cut, features=features)[y, x])
        found.append(_score(entry.name, np.stack(estimates), batches))
    return found


def _around(samples: Samples, n: int) -> Iterator[tuple[Entry, int]]:
    """Yield what looks at the pixels around, and how far: the default estimators first."""
    default = choose(None, [n], samples=samples).entries
    for entry in default.values():
        if entry.uses_neighbours:
            yield entry, _AROUND_LEARNED
    for name, entry in fixed(neighbours=True).items():
        if name not in DEFAULT_ESTIMATORS and not entry.learns and takes(entry, n):
            yield entry, _AROUND


def _cut(window: Image, n: int) -> list[Image]:
    """Return the batches of an image (y, x, channel, sample)."""
    return [
        np.ascontiguousarray(window[..., i : i + n]) for i in range(0, window.shape[-1] - n + 1, n)
    ]


# --- trained estimators -------------------------------------------------------------------------


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
    model: TrainedModel[Any]

    def score(
        self,
        batches: ScoringBatches,
        source: StoreSource | None,
        place: Pixel | Box,
        unit: float | None,
    ) -> ScoredEstimate | None:
        """Return the estimate of a place; None where the model does not apply.

        That is one for another number of samples or channels, and one that looks around where there
        is no image, as for a region.

        Parameters
        ----------
        batches
            Batches of the place.
        source
            The store that has the pixels around; None where there is none.
        place
            (y, x), or the four numbers of a region.
        unit
            Mean radiance of the image; None where it is not known.
        """
        model, n = self.model, batches.n
        if isinstance(model, MLP):
            fits = model.inputs == n
            if not fits:
                return None
            return replace(_score(self.name, model.predict(batches.x), batches), given=True)
        if not isinstance(model, Progressive) or model.channels != batches.x.shape[-2]:
            return None
        names = ("radiance", "certainty", "low", "high")
        known = source is not None and model.trained_on(source.samples.attrs)
        if source is not None and len(place) == 2 and (model.with_features or not known):
            # Of another scene, the pixels around tell how far the model counts.
            batches = batches.first(BATCHES_AROUND)
            spp = len(batches.x) * n
            window, (y, x), (ys, xs) = source.around(*place, spp, radius=_AROUND_LEARNED)
            features = {k: field[ys, xs] for k, field in source.samples.features.items()}
            if model.with_features and not features:
                return None
            own = unit if known else None
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", OtherSceneWarning)
                found = [
                    model.estimate(cut, features=features, unit=own) for cut in _cut(window, n)
                ]
            fields = [np.stack([getattr(e, name)[y, x] for e in found]) for name in names]
        elif model.with_features:
            return None
        else:
            # Without an image, the batches of the place tell it.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", OtherSceneWarning)
                estimated = model.estimate(batches.x, unit=unit if known else None)
            fields = [getattr(estimated, name) for name in names]
        certainty, low, high = (_average(values) for values in fields[1:])
        one = _score(self.name, fields[0], batches)
        return replace(one, certainty=float(certainty), low=low, high=high, given=True)


def learners(models: Sequence[TrainedModel[Any] | str | Path]) -> list[Learner]:
    """Return trained estimators, read from their files where they are files.

    Raises
    ------
    StoreError
        If a file cannot be read, or holds something else.
    """
    return [
        Learner(Path(model).stem, load_model(model))
        if isinstance(model, str | Path)
        else Learner(model.name, model)
        for model in models
    ]
