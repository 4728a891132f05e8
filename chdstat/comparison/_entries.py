"""Entries: who takes part in a comparison, looked up and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from chdstat.comparison.denoising import Denoised
from chdstat.errors import InputError
from chdstat.estimators.registry import Estimator, LearnedEstimator, lookup

__all__ = [
    "DEFAULT",
    "Entry",
    "learned_of",
    "least_taken",
    "looked_up",
    "looks_around",
    "own_of",
    "resolve",
    "takes",
]

Entry = Estimator | LearnedEstimator | Denoised

DEFAULT = ("mean", "median_of_means", "elek2019", "progressive")
"""Who takes part where nobody is named: the paper's three, and our own."""


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
