"""Estimates of one place by fixed and trained estimators, and their errors.

`batches_of` cuts the samples of a place into batches; `scored` and `scored_around` let the fixed
estimators estimate from them, `score_model` scores a trained one. An estimator that looks at the
pixels around, as the default estimate does, is given a part of the image with its first-hit
features, not all of it: its estimate is close to that of `chdstat.estimate`, not the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat import estimators
from chdstat._core.arrays import Floats, Image, is_bad
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.comparison.entries import choose, estimate_by, takes
from chdstat.comparison.judges import Judge, PartialSums
from chdstat.comparison.metrics import SUMS, UNDECIDED, errors_of
from chdstat.estimators import registry
from chdstat.estimators.training import TrainedModel
from chdstat.explorer.sources import StoreSource
from chdstat.explorer.view import BATCHES, PixelIndex

_MOST_BATCHES = 32
"""Batches that estimators are scored on."""
BATCHES_AROUND = 4
"""Batches that estimators which look at the pixels around are scored on: they are slow."""
_AROUND, _AROUND_DEFAULT = 10, 24
"""Pixels to each side that estimators look at: others, and those that are compared by default."""

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
        Mean squared error over that of the sample mean, over channels and batches, without the
        noise of the reference; NaN where it cannot tell, as the next two.
    bias
        Mean error relative to the mean reference.
    improved
        Share of the estimates that are nearer to the truth than the sample mean.
    certainty
        Of a trained estimator, the mean over batches; NaN where it has none.
    low, high
        Of a trained estimator, the ends of its interval, means over batches, shape (channel,).
    given
        Whether it is a trained estimator that the page was opened with.
    """

    name: str
    value: Floats
    mse_ratio: float = float("nan")
    bias: float = float("nan")
    improved: float = float("nan")
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
        Shape (batch, channel, sample), float32; NaN where a sample is bad.
    reference
        What the samples that judge a batch tell, shape (batch, channel); unknown (NaN) where there
        are too few.
    mean
        Sample mean of each batch, shape (batch, channel).
    """

    x: Image
    reference: Judge
    mean: Floats

    @property
    def n(self) -> int:
        """Samples of a batch."""
        return int(self.x.shape[-1])

    @property
    def scored(self) -> bool:
        """Whether estimates can be scored."""
        return bool(np.isfinite(self.reference.mean).any())

    def first(self, count: int) -> ScoringBatches:
        """Return the first of them."""
        part = slice(count)
        return ScoringBatches(self.x[part], self.reference[part], self.mean[part])

    def score(self, name: str, estimates: npt.ArrayLike) -> ScoredEstimate:
        """Compare the estimates of an estimator, shape (batch, channel), with the reference."""
        estimates = np.asarray(estimates, np.float64)
        found = ScoredEstimate(name, _average(estimates))
        known = np.isfinite(self.reference.mean + estimates + self.mean).all(axis=-1)
        if not known.any():
            return found
        reference, mean = self.reference[known], self.mean[known]
        own, of_mean = (
            dict(zip(SUMS, np.moveaxis(errors, 1, 0), strict=True))
            for errors in (
                errors_of(p, mean, reference, scene_mean=np.ones(1))
                for p in (estimates[known], mean)
            )
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            bias = float(own["error"].mean() / reference.mean.mean())
            each = of_mean["squared"].sum(axis=-1)
            doubt = np.hypot(each.std() * np.sqrt(len(each)), reference.variance.sum())
            # An error of the mean that may be 0 divides nothing.
            told = each.sum() > 2 * doubt
            ratio = max(float(own["squared"].sum() / each.sum()), 0.0) if told else np.nan
        if name == "mean":
            return replace(found, mse_ratio=1.0 if told else np.nan, bias=bias)
        undecided = own["undecided"].mean() > UNDECIDED
        improved = np.nan if undecided else (own["improved"] + own["undecided"] / 2).mean()
        return replace(found, mse_ratio=ratio, bias=bias, improved=float(improved))


def batches_of(
    x: Image, n: int, judging: Image | None = None, *, most: int = _MOST_BATCHES
) -> ScoringBatches | None:
    """Return batches of consecutive samples, None where there are too few.

    Parameters
    ----------
    x
        Linear radiance, shape (channel, sample); a sample with a bad channel is left out.
    n
        Samples of a batch.
    judging
        Other samples of the place, same shape. Without, a batch is judged by all other samples, as
        in `chdstat.compare`. Fewer than `BATCHES` - 1 times n are too few.
    most
        Batches at most.
    """
    count = min(x.shape[-1] // n, most)
    if count == 0:
        return None
    x = np.where(is_bad(x).any(axis=-2, keepdims=True), np.float32(np.nan), x)
    batches = np.moveaxis(x[..., : count * n].reshape(*x.shape[:-1], count, n), -2, 0)
    sums = PartialSums.of_array(x if judging is None else judging)
    enough = (x.shape[-1] - n if judging is None else judging.shape[-1]) >= (BATCHES - 1) * n
    if judging is None:
        found = [sums.of_pixel(batch, first=k * n) for k, batch in enumerate(batches)]
    else:
        found = [sums.of_pixel()] * count
    reference = Judge.stack(found)
    if not enough:
        reference = replace(reference, mean=np.full_like(reference.mean, np.nan))
    return ScoringBatches(batches, reference, np.asarray(estimators.mean(batches), np.float64))


def _average(values: npt.NDArray[np.floating[Any]]) -> Floats:
    known = np.isfinite(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.where(known, values, 0).sum(axis=0, dtype=np.float64)
        return np.asarray(total / known.sum(axis=0))


def _windows(
    source: StoreSource, place: PixelIndex, batches: ScoringBatches, radius: int
) -> tuple[list[Image], dict[str, Image], PixelIndex]:
    """Return the batches of the pixels around one, their features, and its place among them."""
    ys, xs = (
        slice(max(0, at - radius), min(length, at + radius + 1))
        for at, length in zip(place, source.size, strict=True)
    )
    n, count = batches.n, len(batches.x)
    window = source.read(ys, xs, slice(0, count * n))
    features = {name: image[ys, xs] for name, image in source.samples.features.items()}
    cuts = [np.ascontiguousarray(window[..., i * n : (i + 1) * n]) for i in range(count)]
    return cuts, features, (place[0] - ys.start, place[1] - xs.start)


# --- fixed estimators ---------------------------------------------------------------------------


def fixed(*, neighbours: bool = False) -> dict[str, registry.Estimator]:
    """Return the fixed estimators of one pixel by name, or those that look at the pixels around."""
    entries = map(registry.lookup, registry.names("fixed"))
    return {
        entry.name: entry
        for entry in entries
        if isinstance(entry, registry.Estimator) and entry.uses_neighbours == neighbours
    }


def scored(batches: ScoringBatches) -> list[ScoredEstimate]:
    """Score every fixed estimator of one pixel.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 512)).astype(np.float32)
    >>> first = scored(batches_of(x, 32))[0]
    >>> first.name, first.mse_ratio
    ('mean', 1.0)
    """
    return [
        batches.score(name, entry(batches.x))
        for name, entry in fixed().items()
        if batches.n >= entry.minimum_samples
    ]


def scored_around(
    batches: ScoringBatches, source: StoreSource, place: PixelIndex, *, step: Step = lambda: None
) -> list[ScoredEstimate]:
    """Score the estimators that look at the pixels around, on a few batches; default ones first.

    Parameters
    ----------
    batches
        Batches of the pixel.
    source
        The store, of whose pixels those around are read.
    place
        (y, x) of the pixel.
    step
        Called before each batch; whatever it raises ends the computation.
    """
    batches, found = batches.first(BATCHES_AROUND), []
    default = choose(None, [batches.n], samples=source.samples).entries.values()
    around: list[Any] = [(e, _AROUND_DEFAULT) for e in default if e.uses_neighbours]
    around += [
        (entry, _AROUND)
        for name, entry in fixed(neighbours=True).items()
        if name not in DEFAULT_ESTIMATORS and not entry.learns and takes(entry, batches.n)
    ]
    for entry, radius in around:
        cuts, features, at = _windows(source, place, batches, radius)
        estimates = []
        for cut in cuts:
            step()
            estimates.append(estimate_by(entry, cut, features=features)[at])
        found.append(batches.score(entry.name, np.stack(estimates)))
    return found


# --- trained estimators -------------------------------------------------------------------------


def score_model(
    name: str, model: TrainedModel[Any], batches: ScoringBatches
) -> ScoredEstimate | None:
    """Score a trained estimator; None where it takes another number of samples.

    Parameters
    ----------
    name, model
        What it is called, and the model.
    batches
        Batches of the place.
    """
    if getattr(model, "inputs", None) not in (None, batches.n):
        return None
    if not hasattr(model, "estimate"):
        return replace(batches.score(name, model.predict(batches.x)), given=True)
    found = model.estimate(batches.x)
    return replace(
        batches.score(name, found.radiance),
        certainty=float(_average(found.certainty)),
        low=_average(found.low),
        high=_average(found.high),
        given=True,
    )
