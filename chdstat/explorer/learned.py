"""Learned: what trained estimators say of one place, beside the fixed ones of `judged`.

One that looks at the pixels around is asked about a part of the picture, not all of it: its
estimate is close to that of `chdstat.estimate`, not the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from chdstat.errors import InputError
from chdstat.estimators import MLP, Estimates, Progressive
from chdstat.explorer.judged import Batches, Estimate, Floats, compared
from chdstat.explorer.sources import StoreSource
from chdstat.models import AnyModel, load_model

__all__ = ["Learner", "judged_learners", "learners"]

_RADIUS = 24
"""Pixels to each side that a model sees, where it looks around."""
_PART = 256
"""Side of the part of an image that tells how far a model is followed."""
_MOST_AROUND = 4
"""Batches of a model that looks around."""

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Learner:
    """A trained estimator.

    Attributes
    ----------
    name
        Of its file, or of the model.
    model
        What is asked.
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
        """Whether it wants a picture, for first-hit features or for neighbours."""
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


def judged_learners(
    found: Sequence[Learner],
    batches: Batches,
    source: StoreSource | None,
    place: tuple[int, ...],
    unit: float | None,
    *,
    step: Callable[[], None] = lambda: None,
) -> list[Estimate]:
    """Judge trained estimators on the batches of a place.

    Left out is what cannot be asked: a model for another number of samples or channels, and one
    that looks around where there is no picture, as for a region.

    Parameters
    ----------
    found
        The estimators.
    batches
        Of the place, as `chdstat.explorer.judged.batches_of` makes them.
    source
        The store, whose samples lie around; None where there is none.
    place
        (y, x), or the four numbers of a region.
    unit
        Mean radiance of the picture; None where it is not known.
    step
        Called before each; whatever it raises ends the judgement.
    """
    estimates = []
    for learner in found:
        step()
        if learner.looks_around:
            if source is None or len(place) != 2:
                continue
            some = batches.first(_MOST_AROUND)
            says = _around(learner, some, source, (place[0], place[1]), unit)
        else:
            some = batches
            says = _alone(learner, some.x, source, unit)
        if says is not None:
            estimates.append(_judged(learner.name, says, some))
    return estimates


def _alone(
    learner: Learner, x: Image, source: StoreSource | None, unit: float | None
) -> Estimates | None:
    """Ask about batches (batch, channel, sample), each for itself."""
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
    learner: Learner, some: Batches, source: StoreSource, place: tuple[int, int], unit: float | None
) -> Estimates | None:
    """Ask about a part of the picture, batch by batch, and keep what is said of its middle."""
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


def _judged(name: str, says: Estimates, some: Batches) -> Estimate:
    judged = compared(name, np.asarray(says.radiance, np.float64), some)
    return replace(
        judged,
        certainty=float(_average(says.certainty)),
        low=_average(says.low),
        high=_average(says.high),
    )


def _average(values: npt.NDArray[np.float32]) -> Floats:
    known = np.isfinite(values)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.where(known, values, 0).sum(axis=0, dtype=np.float64)
        return np.asarray(total / known.sum(axis=0))
