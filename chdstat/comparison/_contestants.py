"""Contestants: the estimators of a comparison, looked up, checked, and trained where they learn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison._tally import Function
from chdstat.errors import InputError
from chdstat.estimators.heldout import Totals, draw_pixels
from chdstat.estimators.registry import Estimator, LearnedEstimator, Model, lookup
from chdstat.samples import Samples

__all__ = ["Contestants", "resolve", "totals_of"]

Entry = Estimator | LearnedEstimator


@dataclass(frozen=True)
class Contestants:
    """Estimators that are ready to estimate.

    Attributes
    ----------
    entries
        By name: those that look at one pixel in the order asked for, then those that use
        neighbours.
    models
        Those that were trained, by name; entries that share a training share a model.
    features
        First-hit features of the picture, for those who look at them.
    """

    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    features: Mapping[str, npt.NDArray[Any]]

    @classmethod
    def of(
        cls,
        entries: Mapping[str, Entry],
        samples: Samples,
        *,
        sizes: Sequence[int],
        seed: int,
        model: Model | None,
        progress: bool | None,
    ) -> Contestants:
        """Train what learns, all on the same pixels, except for the model that is at hand."""
        learned = {k: e for k, e in entries.items() if isinstance(e, LearnedEstimator)}
        if model is not None and model.name not in learned:
            message = (
                f"the model is a {model.name!r}, which is not among {list(entries)}; name it there"
            )
            raise InputError(message)
        wanted = max((e.pixels for e in learned.values()), default=0)
        pixels = draw_pixels(samples.shape[:2], wanted, seed=seed)
        trained = {} if model is None else {learned[model.name].train: model}
        for entry in learned.values():
            if entry.train not in trained:
                # Whoever takes any number of samples learns those that it is judged at.
                options = {} if entry.inputs else {"sizes": tuple(sizes)}
                trained[entry.train] = entry.train(
                    samples, seed=seed, pixels=pixels, progress=progress, **options
                )
        return cls(
            entries,
            {name: trained[entry.train] for name, entry in learned.items()},
            samples.features,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(self.entries)

    @property
    def uses_neighbours(self) -> npt.NDArray[np.bool_]:
        """Which of them look at the pixels around, shape (estimator,)."""
        return np.array([_looks_around(entry) for entry in self.entries.values()], bool)

    @property
    def provenance(self) -> dict[str, Any]:
        """What the trained ones say of their training."""
        return {name: getattr(model, "provenance", {}) for name, model in self.models.items()}

    def taking(self, n: int) -> dict[str, Function]:
        """Return those that take n samples, as functions of them."""
        return {
            name: self._function(entry) for name, entry in self.entries.items() if _takes(entry, n)
        }

    def _function(self, entry: Entry) -> Function:
        options: dict[str, Any] = {}
        if entry.uses_features and self.features:
            options["features"] = self.features
        if isinstance(entry, LearnedEstimator):
            return partial(self.models[entry.name].predict, **entry.options, **options)
        return partial(entry, **options)

    def test_pixels(self, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
        """Return the pixels that trained nothing.

        Raises
        ------
        InputError
            If there are none.
        """
        test = np.ones(shape, bool)
        for model in self.models.values():
            if model.train_shape == shape:
                test[tuple(model.train_pixels.T)] = False
        if not test.any():
            message = (
                "the models were trained on every pixel of this picture; none is left to judge by"
            )
            raise InputError(message)
        return test


def resolve(estimators: Sequence[str | Estimator], sizes: Sequence[int]) -> dict[str, Entry]:
    """Look the names up, those that use neighbours last.

    Raises
    ------
    InputError
        If one is unknown, named twice, or takes none of the `sizes`.
    """
    found = [lookup(e) if isinstance(e, str) else e for e in estimators]
    entries = {entry.name: entry for entry in sorted(found, key=_looks_around)}
    if not entries or len(entries) < len(found):
        message = f"estimators must be one or more different names, got {[e.name for e in found]}"
        raise InputError(message)
    for entry in found:
        if not any(_takes(entry, n) for n in sizes):
            least = (
                f"exactly {entry.inputs}"
                if isinstance(entry, LearnedEstimator)
                else f"at least {entry.minimum_samples}"
            )
            given = f"n={sizes[0]}" if len(sizes) == 1 else f"sizes {tuple(sizes)}"
            message = f"{entry.name} takes {least} samples, got {given}; give another n"
            raise InputError(message)
    return entries


def totals_of(samples: Samples) -> Totals:
    """Return the sums that references are made of.

    Raises
    ------
    InputError
        If no sample is good.
    """
    totals = Totals.of(samples)
    if not totals.count.any():
        message = "every sample of the picture is bad (NaN, infinite or negative); none can judge"
        raise InputError(message)
    return totals


def _looks_around(entry: Entry) -> bool:
    return entry.uses_neighbours


def _takes(entry: Entry, n: int) -> bool:
    if isinstance(entry, LearnedEstimator):
        return entry.inputs is None or n == entry.inputs
    return n >= entry.minimum_samples
