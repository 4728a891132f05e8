"""Candidates: the estimators of a comparison, looked up, checked, and trained where they learn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison.accumulate import Directed, Function
from chdstat.errors import InputError
from chdstat.estimators.denoising import Denoised, variants
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.registry import Estimator, LearnedEstimator, Model, lookup, names
from chdstat.estimators.validation import Totals, direct_of, draw_pixels, judging_pixels
from chdstat.samples import Samples

__all__ = [
    "DEFAULT",
    "Candidates",
    "Entry",
    "Given",
    "learned_of",
    "least_taken",
    "looked_up",
    "looks_around",
    "options_of",
    "own_of",
    "resolve",
    "takes",
    "totals_of",
]

Entry = Estimator | LearnedEstimator | Denoised

DEFAULT = tuple(name for name in names() if lookup(name).default)
"""Estimators of a comparison that names none."""


def resolve(estimators: Sequence[str | Entry], sizes: Sequence[int]) -> dict[str, Entry]:
    """Look the names up, those that use neighbours last.

    Raises
    ------
    InputError
        If one is unknown, named twice, or takes none of the `sizes`.
    """
    found = looked_up(estimators)
    entries = {entry.name: entry for entry in sorted(found, key=looks_around)}
    if not entries or len(entries) < len(found):
        message = f"estimators must be one or more different names, got {[e.name for e in found]}"
        raise InputError(message)
    for entry in map(own_of, found):
        if not any(takes(entry, n) for n in sizes):
            exact = isinstance(entry, LearnedEstimator)
            least = f"{'exactly' if exact else 'at least'} {least_taken(entry)}"
            given = f"n={sizes[0]}" if len(sizes) == 1 else f"sizes {tuple(sizes)}"
            message = f"{entry.name} takes {least} samples, got {given}; give another n"
            raise InputError(message)
    return entries


def looked_up(estimators: Sequence[str | Entry]) -> list[Entry]:
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


def looks_around(entry: Entry) -> bool:
    """Say whether one looks at the pixels around."""
    return entry.uses_neighbours


def own_of(entry: Entry) -> Estimator | LearnedEstimator:
    """Return what estimates, without a denoiser after it."""
    return entry.entry if isinstance(entry, Denoised) else entry


def takes(entry: Entry, n: int) -> bool:
    """Say whether one takes n samples."""
    own = own_of(entry)
    if isinstance(own, LearnedEstimator):
        return own.inputs is None or n == own.inputs
    return n >= own.minimum_samples


def least_taken(entry: Entry) -> int:
    """Return the fewest samples that one takes."""
    own = own_of(entry)
    return (own.inputs or 1) if isinstance(own, LearnedEstimator) else own.minimum_samples


def learned_of(entries: Mapping[str, Entry]) -> dict[str, LearnedEstimator]:
    """Return those that learn, be it before a denoiser, by their own name."""
    found = map(own_of, entries.values())
    return {entry.name: entry for entry in found if isinstance(entry, LearnedEstimator)}


Array = npt.NDArray[Any]
Given = Model | Mapping[str, Model] | None
"""A trained model, or several by the name of the estimator that they are trained for."""


@dataclass(frozen=True)
class Candidates:
    """Estimators that are ready to estimate.

    Attributes
    ----------
    entries
        By name: those that look at one pixel in the order asked for, then those that use
        neighbours.
    models
        Those that were trained, by name; entries that share a training share a model.
    features
        First-hit features of the image, for those who look at them.
    judging
        Pixels that no training draws, shape (y, x), whoever takes part.
    direct
        Whether the direct part of the samples is known.
    foreign
        Those of the models that did not train on this scene, by name.
    """

    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    features: Mapping[str, Array]
    judging: npt.NDArray[np.bool_]
    direct: bool
    foreign: frozenset[str] = frozenset()

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
        """Train what learns, each on as many pixels as it wants, except for the models at hand."""
        for entry in entries.values():
            if isinstance(entry, Denoised):
                entry.check(samples)
        learned = learned_of(entries)
        if any(entry.uses_direct for entry in learned.values()):
            direct_of(samples)  # refused before the training, not after
        given = _given(model, learned)
        models = _train(learned, samples, given, sizes=sizes, seed=seed, progress=progress)
        _check_certainty(entries, models)
        direct = samples.direct
        known = direct is not None and direct.spp >= samples.spp
        judging = judging_pixels(samples.shape[:2], seed=seed)
        foreign = frozenset(
            name
            for name, entry in learned.items()
            if entry.train in given and not _trained_on(given[entry.train], samples)
        )
        return cls(entries, models, samples.features, judging, known, foreign)

    def with_denoised(self) -> Candidates:
        """Enter all of them once more, followed by the denoiser, at the end."""
        added = [
            found
            for entry in self.entries.values()
            if not isinstance(entry, Denoised)
            for found in variants(
                entry,
                certain=_says_certainty(self.models.get(entry.name)),
                features=self.features,
            )
        ]
        own = dict(self.entries)
        return replace(self, entries=own | {e.name: e for e in added if e.name not in own})

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(self.entries)

    @property
    def uses_neighbours(self) -> npt.NDArray[np.bool_]:
        """Which of them look at the pixels around, shape (estimator,)."""
        return np.array([looks_around(entry) for entry in self.entries.values()], bool)

    @property
    def provenance(self) -> dict[str, Any]:
        """What the trained ones say of their training."""
        return {name: getattr(model, "provenance", {}) for name, model in self.models.items()}

    def taking(self, n: int) -> dict[str, Function]:
        """Return those that take n samples, as functions of the samples of the image."""
        return {
            name: self._function(entry) for name, entry in self.entries.items() if takes(entry, n)
        }

    def _function(self, entry: Entry) -> Function:
        function = self._called(entry)
        return Directed(function) if self.direct and own_of(entry).uses_direct else function

    def _called(self, entry: Entry) -> Callable[..., Array]:
        """Return a function from samples, and options of one estimate, to estimates."""
        if isinstance(entry, Denoised):
            estimate = (
                self._certain(entry.entry)
                if entry.certainty
                else _uncertain(self._called(entry.entry))
            )
            return partial(entry, estimate, self.features)
        options = self._options(entry)
        if isinstance(entry, LearnedEstimator):
            return partial(self.models[entry.name].predict, **options)
        return partial(entry, **options)

    def _options(self, entry: Estimator | LearnedEstimator) -> dict[str, Any]:
        """Return what an estimator is called with beside the samples."""
        options = options_of(entry, self.features)
        own = entry.name not in self.foreign
        if own and isinstance(self.models.get(entry.name), Progressive):
            options["trust"] = 1.0
        return options

    def _certain(self, entry: Estimator | LearnedEstimator) -> Callable[..., tuple[Array, Array]]:
        """Return a function from samples to estimates and their certainty."""
        model: Any = self.models[entry.name]
        options = self._options(entry)

        def estimate(x: npt.ArrayLike, **more: Any) -> tuple[Array, Array]:
            found = model.estimate(x, **options, **more)
            return found.radiance, found.certainty

        return estimate

    def test_pixels(self, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
        """Return the pixels that judge: all where no model was trained on an image of this shape.

        Raises
        ------
        InputError
            If there are none.
        """
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


def totals_of(samples: Samples) -> Totals:
    """Return the sums that references are made of.

    Raises
    ------
    InputError
        If no sample is good.
    """
    totals = Totals.of(samples)
    if not totals.count.any():
        message = "every sample of the image is bad (NaN or infinite); none can judge"
        raise InputError(message)
    return totals


def _given(model: Given, learned: Mapping[str, LearnedEstimator]) -> dict[Any, Model]:
    """Return the models that are at hand, by the training that they stand for."""
    if model is None:
        return {}
    named = model if isinstance(model, Mapping) else {model.name: model}
    trainings = {entry.train for entry in learned.values()}
    found = {}
    for name, own in named.items():
        entry = learned[name] if name in learned else lookup(name)
        if not isinstance(entry, LearnedEstimator) or entry.train not in trainings:
            message = (
                f"the model is a {name!r}, which is not among {list(learned)}, those that learn; "
                "name it there"
            )
            raise InputError(message)
        found[entry.train] = own
    return found


def _train(
    learned: Mapping[str, LearnedEstimator],
    samples: Samples,
    given: Mapping[Any, Model],
    *,
    sizes: Sequence[int],
    seed: int,
    progress: bool | None,
) -> dict[str, Model]:
    trained = dict(given)
    for entry in learned.values():
        if entry.train not in trained:
            # Whoever takes any number of samples learns those that it is judged at.
            options = {} if entry.inputs else {"sizes": tuple(sizes)}
            pixels = draw_pixels(samples.shape[:2], entry.pixels, seed=seed)
            trained[entry.train] = entry.train(
                samples, seed=seed, pixels=pixels, progress=progress, **options
            )
    return {name: trained[entry.train] for name, entry in learned.items()}


def _seen(model: Model, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return the pixels of an image of this shape that trained a model, rows (y, x)."""
    if hasattr(model, "seen"):  # it may have been trained on several images
        return np.asarray(model.seen(shape))
    return model.train_pixels if model.train_shape == shape else np.zeros((0, 2), np.int64)


def options_of(
    entry: Estimator | LearnedEstimator, features: Mapping[str, Array]
) -> dict[str, Any]:
    """Return what an estimator is called with beside the samples, on whatever scene."""
    options = dict(entry.options) if isinstance(entry, LearnedEstimator) else {}
    return options | ({"features": features} if entry.uses_features and features else {})


def _trained_on(model: Model, samples: Samples) -> bool:
    return isinstance(model, Progressive) and model.trained_on(samples.attrs)


def _uncertain(function: Callable[..., Array]) -> Callable[..., tuple[Array, None]]:
    return lambda x, **more: (function(x, **more), None)


def _says_certainty(model: Model | None) -> bool:
    return hasattr(model, "estimate")


def _check_certainty(entries: Mapping[str, Entry], models: Mapping[str, Model]) -> None:
    asked = (e for e in entries.values() if isinstance(e, Denoised) and e.certainty)
    for entry in asked:
        if not _says_certainty(models.get(entry.entry.name)):
            message = f"{entry.entry.name} says no certainty; leave {entry.name!r} out"
            raise InputError(message)
