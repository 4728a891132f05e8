"""Estimates of one place, by fixed and trained estimators.

`batches_of` cuts the samples of a place into batches; `estimates` and `estimates_around` let the
fixed estimators estimate from each of them, `estimates_of_model` a trained one. An estimator that
looks at the pixels around, as the default estimate does, is given a part of the image with its
first-hit features, not all of it: its estimate is close to that of `chdstat.estimate`, not the
same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Image, is_bad
from chdstat.comparison import DEFAULT_ESTIMATORS
from chdstat.comparison.estimator_choice import choose, estimate_by, takes
from chdstat.estimators import registry
from chdstat.estimators.training import TrainedModel
from chdstat.explorer.address import PixelIndex
from chdstat.explorer.image_sources import StoreSource

_MOST_BATCHES = 32
"""Batches that estimators estimate from."""
BATCHES_AROUND = 4
"""Batches of estimators which look at the pixels around: they are slow."""
_AROUND, _AROUND_DEFAULT = 10, 24
"""Pixels to each side that estimators look at: others, and those that are compared by default."""

Step = Callable[[], None]


@dataclass(frozen=True)
class PlaceEstimates:
    """Estimates of one place by one estimator.

    Attributes
    ----------
    name
        Of the estimator.
    values
        Estimate from each batch, shape (batch, channel), radiance.
    certainty
        Of a trained estimator, for each batch.
    """

    name: str
    values: npt.NDArray[np.floating[Any]]
    certainty: npt.NDArray[np.floating[Any]] | None = None


def batches_of(x: Image, n: int) -> Image:
    """Return batches of n consecutive samples, shape (batch, channel, n).

    Parameters
    ----------
    x
        Linear radiance, shape (channel, sample); a sample with a bad channel is left out.
    n
        Samples of a batch.
    """
    count = min(x.shape[-1] // n, _MOST_BATCHES)
    x = np.where(is_bad(x).any(axis=-2, keepdims=True), np.float32(np.nan), x)
    return np.moveaxis(x[..., : count * n].reshape(*x.shape[:-1], count, n), -2, 0)


def _fixed(*, neighbours: bool) -> list[registry.Estimator]:
    """Return the fixed estimators of one pixel, or those that look at the pixels around."""
    entries = map(registry.lookup, registry.names("fixed"))
    known = [entry for entry in entries if isinstance(entry, registry.Estimator)]
    return [entry for entry in known if entry.uses_neighbours == neighbours]


def estimates(batches: Image) -> list[PlaceEstimates]:
    """Return the estimates of every fixed estimator of one pixel from batches of a place.

    Examples
    --------
    >>> x = np.random.default_rng(1).gamma(2.0, size=(3, 512)).astype(np.float32)
    >>> first = estimates(batches_of(x, 32))[0]
    >>> first.name, first.values.shape
    ('mean', (16, 3))
    """
    n = batches.shape[-1]
    able = [entry for entry in _fixed(neighbours=False) if n >= entry.minimum_samples]
    return [PlaceEstimates(entry.name, np.asarray(entry(batches))) for entry in able]


def estimates_around(
    source: StoreSource, place: PixelIndex, n: int, *, step: Step = lambda: None
) -> list[PlaceEstimates]:
    """Return the estimates by those that look at the pixels around; the default ones come first.

    Parameters
    ----------
    source
        The store, of whose pixels those around are read.
    place
        (y, x) of the pixel.
    n
        Samples of a batch, of which there are a few.
    step
        Called before each estimate; whatever it raises ends the computation.
    """
    default = choose(None, [n], samples=source.samples).entries.values()
    around: list[Any] = [(e, _AROUND_DEFAULT) for e in default if e.uses_neighbours]
    around += [
        (entry, _AROUND)
        for entry in _fixed(neighbours=True)
        if entry.name not in DEFAULT_ESTIMATORS and not entry.learns and takes(entry, n)
    ]
    found = []
    for entry, radius in around:
        cuts, features, at = _windows(source, place, n, radius)
        values = []
        for cut in cuts:
            step()
            values.append(estimate_by(entry, cut, features=features)[at])
        found.append(PlaceEstimates(entry.name, np.stack(values)))
    return found


def _windows(
    source: StoreSource, place: PixelIndex, n: int, radius: int
) -> tuple[list[Image], dict[str, Image], PixelIndex]:
    """Return batches of the pixels around one, their features, and its place among them."""
    ys, xs = (
        slice(max(0, at - radius), min(length, at + radius + 1))
        for at, length in zip(place, source.size, strict=True)
    )
    count = min(source.samples.spp // n, BATCHES_AROUND)
    window = source.read(ys, xs, slice(0, count * n))
    features = {name: image[ys, xs] for name, image in source.samples.features.items()}
    cuts = [np.ascontiguousarray(window[..., i * n : (i + 1) * n]) for i in range(count)]
    return cuts, features, (place[0] - ys.start, place[1] - xs.start)


def estimates_of_model(name: str, model: TrainedModel[Any], batches: Image) -> list[PlaceEstimates]:
    """Return the estimates of a trained estimator; none where it takes another number of samples.

    Parameters
    ----------
    name, model
        What it is called, and the model.
    batches
        Batches of the place.
    """
    if getattr(model, "inputs", None) not in (None, batches.shape[-1]):
        return []
    if not hasattr(model, "estimate"):
        return [PlaceEstimates(name, np.asarray(model.predict(batches)))]
    found = model.estimate(batches)
    return [PlaceEstimates(name, found.radiance, found.certainty)]
