"""Registry of estimators, and what those of one row of samples are written with.

A fixed estimator is a function of samples, ``x (..., sample) -> (...)``, entered with `register`.
Every one takes an image (y, x, channel, sample); two flags say which need more of that shape than
the last axis: those that look at the channels of a sample together, and those that look at other
pixels. The decorated function takes array-likes and returns the dtype of the samples; the function
itself is given a floating-point array of at least these axes.

A learned estimator is entered with `register_learned` as a function that trains it on a scene and
returns a `Model`. Both are found by name with `lookup`, which also tells their label and place.

An estimator of single pixels is a kernel on rows of good samples. `estimate_rows` hands them over
in float64, with their mean size brought to about 1 by a power of two, which changes no digit:
squares and cubes of a radiance of 1e30 or of subnormal radiance neither overflow nor vanish. Rows
that miss samples are gathered by how many they have, so that a kernel never sees a mask.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Floats,
    Reals,
    all_good,
    as_pixels,
    as_samples,
    is_bad,
    spans,
    warn_left_out,
)
from chdstat._core.display import Card, Shown, png
from chdstat._core.image_scales import tonemap
from chdstat.errors import InputError, check_option, check_probability
from chdstat.scenes.plugins import owns_estimator

__all__ = [
    "ENTRIES",
    "LABELS",
    "Estimates",
    "Estimator",
    "LearnedEstimator",
    "Model",
    "check_positive",
    "check_probability",
    "converge",
    "estimate_rows",
    "forget",
    "known_features",
    "lookup",
    "mean_of_good",
    "median_of_sorted",
    "names",
    "register",
    "register_learned",
    "whole_samples",
]

Function = TypeVar("Function", bound=Callable[..., Reals])

_LAST = 100
"""Place of an estimator that names none."""
_CHUNK = 2**15
"""Samples worked on at once: their float64 copies, and those of a kernel, stay in the cache."""
_STEPS = 200
"""Bisection alone arrives in a quarter as many."""


class Model(Protocol):
    """What a trained estimator offers to those who apply or judge it."""

    @property
    def name(self) -> str:
        """Registered name of the estimator that it is."""

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it has seen, rows (y, x); no judgement may use them."""

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the image that `train_pixels` lie in."""

    def predict(self, x: npt.ArrayLike, /) -> Reals:
        """Estimate from samples (..., sample); the result has shape (...)."""


@dataclass(frozen=True, repr=False)
class Estimates(Shown):
    """Estimates of pixels, with certainty and interval.

    Attributes
    ----------
    radiance
        Shape (..., channel), in the unit of the samples; NaN where no sample is good.
    certainty
        How far the estimate rests on more than the mean of the pixel's samples, 0 to 1, shape
        (...): where it is 0, the estimate is this mean.
    low, high
        Ends of the interval that contains the radiance with probability `level`, shape (...,
        channel).
    level
        Probability of the interval.
    """

    radiance: npt.NDArray[np.float32]
    certainty: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    level: float

    def _card(self) -> Card:
        card = super()._card()
        if self.radiance.ndim != 3 or self.radiance.shape[-1] not in (1, 3):
            return card
        shown = {"estimate": png(tonemap(self.radiance)), "certainty": png(self.certainty)}
        return replace(card, images=shown)


@dataclass(frozen=True, repr=False)
class Estimator(Shown):
    """A fixed estimator: call it with samples (..., sample) for estimates (...).

    Attributes
    ----------
    name
        What it is called by.
    function
        The function itself.
    source
        Author, year, DOI.
    label
        What text and figures call it; "" for the name with spaces.
    place
        Place in lists of estimators, ascending; those of one place are in the order of their
        registration.
    minimum_samples
        Fewest samples that it takes.
    uses_neighbours
        Whether it looks across pixels, and at all their channels; then it takes an image (y, x,
        channel, sample).
    joint_channels
        Whether it looks at the channels together; then it takes samples (..., channel, sample), and
        a sample of which any channel is bad is left out as a whole.
    uses_features
        Whether it takes ``features=``, the first-hit features of the image, where there are any.
    learns
        Whether it trains on the samples at hand each time that it is called.
    """

    name: str
    function: Callable[..., Reals]
    source: str
    label: str = ""
    place: int = _LAST
    minimum_samples: int = 1
    uses_neighbours: bool = False
    joint_channels: bool = False
    uses_features: bool = False
    learns: bool = False

    @property
    def about(self) -> str:
        """What it does, in a sentence: the first of its documentation."""
        return (self.function.__doc__ or "").strip().partition("\n")[0].replace("`", "")

    def __call__(self, x: npt.ArrayLike, **options: Any) -> Reals:
        """Estimate the radiance that the samples `x` are draws of.

        Parameters
        ----------
        x
            Samples, shape (..., sample).
        **options
            Keywords of the function itself.

        Raises
        ------
        InputError
            If there are too few samples, or `x` lacks the axes that the estimator looks at.
        """
        return self.function(self.checked(x, minimum=self.minimum_samples), **options)

    def checked(self, x: npt.ArrayLike, *, minimum: int = 1) -> Reals:
        """Return samples as a floating-point array with the axes that the estimator looks at."""
        if self.joint_channels or self.uses_neighbours:
            return as_pixels(x, minimum=minimum, image=self.uses_neighbours)
        return as_samples(x, minimum=minimum)


@dataclass(frozen=True, repr=False)
class LearnedEstimator(Shown):
    """An estimator that is trained on a scene before it estimates.

    Attributes
    ----------
    name
        What it is called by.
    train
        ``train(samples, *, seed, iterations, pixels, progress)`` returns a trained `Model`; one
        that takes any number of samples also takes ``sizes``, those that it will estimate from.
    source
        Author, year, DOI.
    label, place
        As for `Estimator`.
    inputs
        Samples per estimate, where it takes neither more nor fewer; None for any number.
    pixels
        Pixels that it wants to train on.
    options
        Keywords of its models' ``predict``: entries that share `train` share one model, and differ
        in these.
    about
        What it does, in a sentence.
    uses_features, joint_channels
        As for `Estimator`.
    learns, uses_neighbours
        It trains, and with a reference none looks across pixels.
    """

    name: str
    train: Callable[..., Model]
    source: str
    inputs: int | None
    pixels: int
    about: str = ""
    label: str = ""
    place: int = _LAST
    options: Mapping[str, Any] = field(default_factory=dict)
    uses_features: bool = False
    joint_channels: bool = False
    learns: ClassVar[bool] = True
    uses_neighbours: ClassVar[bool] = False


ENTRIES: dict[str, Estimator | LearnedEstimator] = {}
"""The registered estimators, by name."""
LABELS: dict[str, str] = {}
"""What text and figures call the registered estimators, by name."""


def register(name: str, source: str, **facts: Any) -> Callable[[Function], Function]:
    """Enter the decorated function as the estimator `name`; see `Estimator` for the parameters.

    Of a function that looks at the channels of a sample together, what is not finite becomes the
    mean of the channel's good samples. A function that is defined again, as in a cell of a
    notebook, takes the place of the former one.

    Examples
    --------
    >>> from chdstat.estimators import registry
    >>> @registry.register("first", source="this example")
    ... def first(x):
    ...     return x[..., 0]
    >>> registry.lookup("first")([[1.0, 2.0], [3.0, 4.0]])
    array([1., 3.])
    >>> registry.forget("first")
    """
    joint = facts.get("joint_channels", False) or facts.get("uses_neighbours", False)
    facts["joint_channels"] = joint

    def enter(function: Function) -> Function:
        @functools.wraps(function)
        def estimate(x: npt.ArrayLike, *args: Any, **options: Any) -> Reals:
            samples = entry.checked(x)
            warn_left_out(samples, channel_axis=-2 if joint else None, within="chdstat.estimators")
            found = np.asarray(function(samples, *args, **options), samples.dtype)
            missing = ~np.isfinite(found)
            if joint and missing.any():
                found = np.where(missing, mean_of_good(samples).astype(samples.dtype), found)
            return found

        entry = Estimator(name, estimate, source, **facts)
        _enter(entry)
        return cast("Function", estimate)

    return enter


def register_learned(entry: LearnedEstimator) -> None:
    """Enter an estimator that has to be trained."""
    _enter(entry)


def forget(name: str) -> None:
    """Take an estimator out again."""
    lookup(name)
    del ENTRIES[name], LABELS[name]


def names(kind: Literal["fixed", "learned"] | None = None) -> tuple[str, ...]:
    """Return the names of all estimators, or of one kind, in the order of their places.

    Examples
    --------
    >>> from chdstat import estimators
    >>> "mean" in estimators.names("fixed"), "mean" in estimators.names("learned")
    (True, False)
    """
    entries = sorted(ENTRIES.values(), key=lambda entry: entry.place)
    return tuple(e.name for e in entries if kind is None or e.learns == (kind == "learned"))


def lookup(name: str) -> Estimator | LearnedEstimator:
    """Return the entry of an estimator.

    Raises
    ------
    InputError
        If there is no estimator of that name.
    """
    check_option("estimator", name, ENTRIES, more="'chdstat list estimators'")
    return ENTRIES[name]


def _enter(entry: Estimator | LearnedEstimator) -> None:
    known = ENTRIES.get(entry.name)
    held = known is not None and _defined_at(known) != _defined_at(entry)
    if not owns_estimator(entry.name, held=held):
        message = f"an estimator called {entry.name!r} is registered already; choose another name"
        raise InputError(message)
    ENTRIES[entry.name] = entry
    LABELS[entry.name] = entry.label or entry.name.replace("_", " ")


def _defined_at(entry: Estimator | LearnedEstimator) -> tuple[Any, ...]:
    """Return module and name of the function that an estimator is."""
    function = entry.function if isinstance(entry, Estimator) else entry.train
    return function.__module__, getattr(function, "__qualname__", function)


def mean_of_good(x: npt.NDArray[np.floating[Any]]) -> Floats:
    """Average the good samples of (..., sample) in float64; NaN where there is none."""
    with np.errstate(invalid="ignore"):
        found = np.asarray(x.mean(axis=-1, dtype=np.float64))
        if np.isfinite(found).all():
            return found
        bad = is_bad(x)
        total = np.where(bad, 0, x).sum(axis=-1, dtype=np.float64)
        return np.asarray(total / (~bad).sum(axis=-1))


def estimate_rows(
    x: npt.NDArray[np.floating[Any]],
    kernel: Callable[..., Floats],
    *beside: npt.NDArray[np.floating[Any]],
    ordered: bool = False,
) -> npt.NDArray[Any]:
    """Estimate from the good samples of each row.

    Parameters
    ----------
    x
        Samples, shape (..., sample).
    kernel
        ``kernel(rows, *beside) -> (row,)`` for rows (row, m) of m >= 1 good samples and what stands
        beside them (row,). Equivariant under a change of the unit of radiance.
    beside
        Radiances that belong to the rows, shape (...).
    ordered
        Whether the kernel wants ascending samples. Without, a row that misses samples is sorted,
        too, so the kernel must not depend on their order.

    Returns
    -------
    ndarray
        Shape (...), dtype of `x`; NaN where no sample is good.
    """
    rows = x.reshape(-1, x.shape[-1])
    others = [other.reshape(-1) for other in beside]
    result = np.full(len(rows), np.nan)
    for where, good in _good_rows(rows, ordered):
        relative = good.astype(np.float64)
        m = relative.shape[-1]
        _, exponent = np.frexp(np.abs(relative) @ np.full(m, 1 / m))
        # The unit and its inverse are finite for every mean, 0 included.
        unit = np.ldexp(1.0, exponent - 1)
        relative /= unit[:, np.newaxis]
        result[where] = kernel(relative, *(other[where] / unit for other in others)) * unit
    return result.astype(x.dtype).reshape(x.shape[:-1])


def _good_rows(rows: npt.NDArray[Any], ordered: bool) -> Iterator[tuple[Any, npt.NDArray[Any]]]:
    """Yield the good samples of some rows, as many of each, and the places of these rows."""
    for part in spans(len(rows), max(1, _CHUNK // rows.shape[-1])):
        chunk = rows[part]
        if all_good(chunk):
            yield part, np.sort(chunk) if ordered else chunk
            continue
        # Bad samples sort behind the others.
        ascending = np.sort(np.where(is_bad(chunk), np.inf, chunk))
        count = np.count_nonzero(np.isfinite(ascending), axis=-1)
        for m in np.unique(count[count > 0]):
            same = np.flatnonzero(count == m)
            yield part.start + same, ascending[same, :m]


def median_of_sorted(rows: Floats) -> Floats:
    """Return the medians of ascending rows."""
    m = rows.shape[-1]
    return np.asarray(0.5 * (rows[:, (m - 1) // 2] + rows[:, m // 2]))


def whole_samples(
    x: npt.NDArray[np.floating[Any]],
) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.bool_]]:
    """Return samples (..., channel, sample), 0 where a channel is bad, and which have none bad."""
    good = np.asarray(~is_bad(x).any(axis=-2))
    return x if good.all() else np.where(good[..., np.newaxis, :], x, 0), good


def known_features(
    features: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...], names: Sequence[str]
) -> dict[str, Floats]:
    """Return those of some first-hit features that there are, finite, shape (y, x, number)."""
    found = {}
    for name in [name for name in names if name in features]:
        field = np.asarray(features[name], np.float64)
        if field.shape[:2] != shape or field.ndim not in (2, 3):
            message = f"feature {name!r} must have shape {shape} or {shape} x 3, got {field.shape}"
            raise InputError(message)
        found[name] = np.nan_to_num(np.atleast_3d(field), posinf=0, neginf=0)
    return found


def check_positive(**options: float) -> None:
    """Refuse options, by name, that are not larger than 0."""
    for name, value in options.items():
        if not value > 0:
            message = f"{name} must be larger than 0, got {value}"
            raise InputError(message)


def converge(
    update: Callable[..., tuple[Floats, ...]], start: Floats, near: Floats, *beside: Floats
) -> Floats:
    """Repeat an update until it moves no row by more than `near`; rows that arrive drop out.

    ``update(theta, *beside)`` returns the next theta (row,), and what stands beside it then.
    """
    theta, left = start.copy(), np.arange(len(start))
    for _ in range(_STEPS):
        there, *others = update(theta[left], *beside)
        going = np.abs(there - theta[left]) > near
        theta[left] = there
        if not going.any():
            break
        if going.all():
            beside = tuple(others)
        else:
            left, near, beside = left[going], near[going], tuple(one[going] for one in others)
    return theta
