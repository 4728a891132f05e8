"""Candidates: the estimators of a comparison, looked up, checked, and trained where they learn.

`Denoised` is an estimator followed by Open Image Denoise: use it to see whether a denoiser does
better from a better start. ``compare(..., denoise=True)`` adds every estimator so; `denoised` makes
one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import whole
from chdstat._core.image_scales import mean_radiance
from chdstat.errors import InputError
from chdstat.estimators.estimates import check_denoiser, through_denoiser
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.registry import Estimator, LearnedEstimator, Model, lookup, names
from chdstat.estimators.validation import Totals, check_spp, draw_pixels, judging_pixels
from chdstat.samples import Samples

__all__ = [
    "DEFAULT",
    "Candidates",
    "Denoised",
    "Entry",
    "Given",
    "curve_sizes",
    "denoised",
    "options_of",
    "resolve",
]

Array = npt.NDArray[Any]

_SMALLEST, _SHARE = 4, 8
"""By default, sizes double from 4 to an eighth of the samples: the rest is the reference."""


@dataclass(frozen=True)
class Denoised:
    """An estimator followed by Open Image Denoise.

    Attributes
    ----------
    entry
        What estimates.
    with_features
        Whether the denoiser is given albedo and normal of the first hit.
    with_certainty
        Whether an estimate is kept as far as its model is certain of it.
    uses_neighbours
        A denoiser always looks across pixels.
    """

    entry: Estimator | LearnedEstimator
    with_features: bool = False
    with_certainty: bool = False
    uses_neighbours: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """What it is called by, such as "progressive + OIDN features"."""
        features = " features" if self.with_features else ""
        return f"{self.entry.name} + OIDN{features}{' certainty' if self.with_certainty else ''}"


def denoised(
    estimator: str | Estimator | LearnedEstimator,
    *,
    with_features: bool = False,
    with_certainty: bool = False,
) -> Denoised:
    """Return an estimator followed by Open Image Denoise, for `chdstat.compare`.

    Where it learns, it shares the training of the estimator itself. Negative estimates count as 0.

    Parameters
    ----------
    estimator
        Name of a registered estimator, or an entry.
    with_features
        Give the denoiser albedo and normal of the first hit; the image must have them.
    with_certainty
        Mix with the estimate as far as it is certain, ``c estimate + (1 - c) denoised``; only for
        learned estimators whose models predict a certainty.

    Raises
    ------
    InputError
        If there is no such estimator, or a certainty is wanted of one that does not learn.

    References
    ----------
    A. T. Afra, "Intel Open Image Denoise", https://www.openimagedenoise.org. The blend: Firmino,
    Frisvad and Jensen 2022, "Progressive denoising of Monte Carlo rendered images", Computer
    Graphics Forum 41(2), doi:10.1111/cgf.14454.

    Examples
    --------
    >>> denoised("mean").name
    'mean + OIDN'
    >>> denoised("progressive", with_features=True, with_certainty=True).name
    'progressive + OIDN features certainty'
    """
    entry = lookup(estimator) if isinstance(estimator, str) else estimator
    if with_certainty and not isinstance(entry, LearnedEstimator):
        message = f"with_certainty=True is for estimators that learn, and {entry.name!r} does not"
        raise InputError(message)
    return Denoised(entry, with_features, with_certainty)


Entry = Estimator | LearnedEstimator | Denoised
Given = Model | Mapping[str, Model] | None
"""A trained model, or several by the name of the estimator that they are trained for."""

DEFAULT = tuple(name for name in names() if lookup(name).default)
"""Estimators of a comparison that names none."""


def resolve(estimators: Sequence[str | Entry], sizes: Sequence[int]) -> dict[str, Entry]:
    """Look the names up, those that use neighbours last.

    Raises
    ------
    InputError
        If one is unknown, named twice, or takes none of the `sizes`.
    """
    found = _looked_up(estimators)
    entries = {e.name: e for e in sorted(found, key=lambda entry: entry.uses_neighbours)}
    if not entries or len(entries) < len(found):
        message = f"estimators must be one or more different names, got {[e.name for e in found]}"
        raise InputError(message)
    for entry in map(_without_denoiser, found):
        if not any(_takes(entry, n) for n in sizes):
            exact = isinstance(entry, LearnedEstimator)
            least = f"{'exactly' if exact else 'at least'} {_least_taken(entry)}"
            given = f"n={sizes[0]}" if len(sizes) == 1 else f"sizes {tuple(sizes)}"
            message = f"{entry.name} takes {least} samples, got {given}; give another n"
            raise InputError(message)
    return entries


def _looked_up(estimators: Sequence[str | Entry]) -> list[Entry]:
    """Return the entries of names, and entries as they are.

    Raises
    ------
    InputError
        If one is unknown, or neither a name nor an entry.
    """
    if isinstance(estimators, str):
        message = f"estimators must be a list of names, got the single name {estimators!r}"
        raise InputError(message)
    found: list[Any] = [lookup(e) if isinstance(e, str) else e for e in estimators]
    for entry in found:
        if not isinstance(entry, Entry):
            message = f"expected names of estimators or entries of your own, got {entry!r}"
            raise InputError(message)
    return found


def curve_sizes(
    samples: Samples,
    estimators: Sequence[str | Entry] = DEFAULT,
    *,
    sizes: Sequence[int] | None = None,
) -> tuple[int, ...]:
    """Return the N of an error curve in ascending order, checked before any work.

    Raises
    ------
    InputError
        As `error_curve` does.
    """
    if sizes is None:
        largest = max(_SMALLEST, samples.spp // _SHARE)
        doubled = [2**k for k in range(_SMALLEST.bit_length() - 1, largest.bit_length())]
        entries = _looked_up(estimators)
        fewest = {_least_taken(e) for e in entries if not any(_takes(e, n) for n in doubled)}
        sizes = [*doubled, *(n for n in fewest if 2 * n <= samples.spp)]
    if np.ndim(sizes) != 1:
        message = f"sizes must be several numbers, got {sizes!r}"
        raise InputError(message)
    chosen = tuple(sorted(whole("a size", n, least=1) for n in sizes))
    if not chosen or len(set(chosen)) < len(chosen):
        message = f"sizes must be one or more different numbers from 1, got {chosen}"
        raise InputError(message)
    check_spp(samples, chosen[-1])
    resolve(estimators, chosen)
    return chosen


def _takes(entry: Entry, n: int) -> bool:
    """Return whether an estimator takes n samples."""
    own = _without_denoiser(entry)
    if isinstance(own, LearnedEstimator):
        return own.inputs is None or n == own.inputs
    return n >= own.minimum_samples


def _least_taken(entry: Entry) -> int:
    """Return the fewest samples that an estimator takes."""
    own = _without_denoiser(entry)
    return (own.inputs or 1) if isinstance(own, LearnedEstimator) else own.minimum_samples


def options_of(
    entry: Estimator | LearnedEstimator, features: Mapping[str, Array]
) -> dict[str, Any]:
    """Return what an estimator is called with beside the samples, on whatever scene."""
    options = dict(entry.options) if isinstance(entry, LearnedEstimator) else {}
    return options | ({"features": features} if entry.uses_features and features else {})


def _without_denoiser(entry: Entry) -> Estimator | LearnedEstimator:
    return entry.entry if isinstance(entry, Denoised) else entry


@dataclass(frozen=True)
class Candidates:
    """Estimators that are ready to estimate an image.

    Attributes
    ----------
    samples
        The image.
    totals
        Sums over its samples, which references are made of.
    entries
        By name: those that look at one pixel in the order asked for, then those that use
        neighbours.
    models
        Those that were trained, by name; entries that share a training share a model.
    judging
        Pixels that no training draws, shape (y, x), whoever takes part.
    trained_here
        Those of the models that were trained for this comparison, by name.
    """

    samples: Samples
    totals: Totals
    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    judging: npt.NDArray[np.bool_]
    trained_here: frozenset[str]

    @classmethod
    def of(
        cls,
        entries: Mapping[str, Entry],
        samples: Samples,
        *,
        sizes: Sequence[int],
        seed: int,
        model: Given,
        progress: bool | None,
    ) -> Candidates:
        """Train what learns, each on as many pixels as it wants, except for the models at hand.

        Raises
        ------
        InputError
            If no sample is good, the denoiser is missing, a model is given that no estimator is,
            or an estimator needs what the image lacks.
        """
        totals = Totals.of(samples)
        if not totals.count.any():
            message = "every sample of the image is bad (NaN or infinite); none can judge"
            raise InputError(message)
        # What cannot be done is refused before the training.
        for entry in entries.values():
            if isinstance(entry, Denoised):
                check_denoiser(samples.shape[2])
                if entry.with_features and "albedo" not in samples.features:
                    message = (
                        f"{entry.name!r} needs the albedo of the first hit, which this image "
                        f"lacks; it has {sorted(samples.features) or 'none'}. "
                        "Give denoised(..., with_features=False)"
                    )
                    raise InputError(message)
        own = [_without_denoiser(entry) for entry in entries.values()]
        learned = {e.name: e for e in own if isinstance(e, LearnedEstimator)}
        given = _given(model, learned)
        trained = dict(given)
        for entry in learned.values():
            if entry.train not in trained:
                # What takes any number of samples is trained for those that it is judged at.
                options = {} if entry.inputs else {"sizes": tuple(sizes)}
                pixels = draw_pixels(samples.shape[:2], entry.pixels, seed=seed)
                trained[entry.train] = entry.train(
                    samples, seed=seed, pixels=pixels, progress=progress, **options
                )
        models = {name: trained[entry.train] for name, entry in learned.items()}
        for name, entry in entries.items():
            base = _without_denoiser(entry).name
            certain = isinstance(entry, Denoised) and entry.with_certainty
            if certain and not hasattr(models[base], "estimate"):
                message = f"{base} says no certainty; leave {name!r} out"
                raise InputError(message)
        here = frozenset(name for name, entry in learned.items() if entry.train not in given)
        judging = judging_pixels(samples.shape[:2], seed=seed)
        return cls(samples, totals, entries, models, judging, here)

    def with_denoised(self) -> Candidates:
        """Add every way to denoise each of them that the image and its model allow, at the end."""
        entries = dict(self.entries)
        guided = (False, True) if "albedo" in self.samples.features else (False,)
        for entry in self.entries.values():
            if not isinstance(entry, Denoised):
                certain = hasattr(self.models.get(entry.name), "estimate")
                for kept in (False, True) if certain else (False,):
                    for with_features in guided:
                        added = Denoised(entry, with_features, kept)
                        entries.setdefault(added.name, added)
        return replace(self, entries=entries)

    @property
    def uses_neighbours(self) -> npt.NDArray[np.bool_]:
        """Which of them look at the pixels around, shape (estimator,)."""
        return np.array([entry.uses_neighbours for entry in self.entries.values()], bool)

    def provenance(self, *, seed: int, max_batches: int | None) -> dict[str, Any]:
        """Return scene, samples and settings of a comparison, and what is known of the models."""
        return {
            "scene": self.samples.name,
            "samples": self.samples.attrs,
            "samples_shape": list(self.samples.shape),
            "seed": seed,
            "max_batches": max_batches,
            "models": {n: getattr(model, "provenance", {}) for n, model in self.models.items()},
        }

    def taking(self, n: int) -> dict[str, Callable[[Array], Array]]:
        """Return those that take n samples, as functions of samples (y, x, channel, sample)."""
        return {
            name: partial(self._estimate, entry)
            for name, entry in self.entries.items()
            if _takes(entry, n)
        }

    def _estimate(self, entry: Entry, x: Array) -> Array:
        own, features = _without_denoiser(entry), self.samples.features
        model: Any = self.models.get(own.name)
        options = options_of(own, features)
        if isinstance(model, Progressive):
            here = own.name in self.trained_here or model.trained_on(self.samples.attrs)
            options |= {"unit": mean_radiance(x)} if here else {}
        guides = features if isinstance(entry, Denoised) and entry.with_features else {}
        if isinstance(entry, Denoised) and entry.with_certainty:
            found = model.estimate(x, **options)
            return through_denoiser(found.radiance, guides, certainty=found.certainty)
        radiance = own(x, **options) if isinstance(own, Estimator) else model.predict(x, **options)
        return through_denoiser(radiance, guides) if isinstance(entry, Denoised) else radiance

    def test_pixels(self) -> npt.NDArray[np.bool_]:
        """Return the pixels that judge: all where no model was trained on an image of this shape.

        Raises
        ------
        InputError
            If there are none.
        """
        shape = self.samples.shape[:2]
        seen = [_seen(model, shape) for model in self.models.values()]
        test = self.judging.copy() if any(map(len, seen)) else np.ones(shape, bool)
        for pixels in seen:
            test[tuple(pixels.T)] = False
        if not test.any():
            message = (
                "the models were trained on every pixel of this image; none is left to judge by"
            )
            raise InputError(message)
        return test


def _given(model: Given, learned: Mapping[str, LearnedEstimator]) -> dict[Any, Model]:
    """Return the models that are at hand, by the training that they stand for."""
    if model is None:
        return {}
    trainings, found = {entry.train for entry in learned.values()}, {}
    for name, own in (model if isinstance(model, Mapping) else {model.name: model}).items():
        train = getattr(learned.get(name) or lookup(name), "train", None)
        if train not in trainings:
            message = (
                f"the model is a {name!r}, which is not among {list(learned)}, those that learn; "
                "name it there"
            )
            raise InputError(message)
        found[train] = own
    return found


def _seen(model: Model, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the pixels of an image of this shape that trained a model, rows (y, x)."""
    if hasattr(model, "train_pixels_of"):  # it may have been trained on several images
        return np.asarray(model.train_pixels_of(shape))
    return model.train_pixels if model.train_shape == shape else np.zeros((0, 2), np.int64)
