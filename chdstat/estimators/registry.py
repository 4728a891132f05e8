"""Registry of estimators: what there is, where it comes from and what it needs.

A fixed estimator is a function of samples, ``x (..., sample) -> (...)``, entered with `register`.
Every one takes an image (y, x, channel, sample); two flags say which need more of that shape than
the last axis: those that look at the channels of a sample together, and those that look at other
pixels. The decorated function takes array-likes and returns the dtype of the samples; the function
itself is given a floating-point array of at least these axes.

A learned estimator is entered with `register_learned` as a function that trains it on a scene and
returns a `Model`. Both are found by name with `lookup`; `chdstat.compare` takes the names. Their
rows also hold the label and the place that reports, the explorer and the documentation show.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, as_samples, warn_left_out
from chdstat.errors import InputError

__all__ = [
    "LABELS",
    "Estimator",
    "LearnedEstimator",
    "Model",
    "forget",
    "lookup",
    "names",
    "register",
    "register_learned",
]

Array = npt.NDArray[Any]
Function = TypeVar("Function", bound=Callable[..., Array])

_LAST = 100
"""Place of an estimator that names none."""


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

    def predict(self, x: npt.ArrayLike, /) -> Array:
        """Estimate from samples (..., sample); the result has shape (...)."""


@dataclass(frozen=True)
class Estimator:
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
    default
        Whether it takes part in a comparison or report that names no estimators.
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
    uses_direct
        Whether it takes the direct part of the samples: no fixed estimator does.
    """

    name: str
    function: Callable[..., Array]
    source: str
    label: str = ""
    place: int = _LAST
    default: bool = False
    minimum_samples: int = 1
    uses_neighbours: bool = False
    joint_channels: bool = False
    uses_features: bool = False
    learns: bool = False
    uses_direct: ClassVar[bool] = False

    def __call__(self, x: npt.ArrayLike, **options: Any) -> Array:
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

    def checked(self, x: npt.ArrayLike, *, minimum: int = 1) -> Array:
        """Return samples as a floating-point array with the axes that the estimator looks at."""
        if self.joint_channels or self.uses_neighbours:
            return as_pixels(x, minimum=minimum, image=self.uses_neighbours)
        return as_samples(x, minimum=minimum)


@dataclass(frozen=True)
class LearnedEstimator:
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
    label, place, default
        As for `Estimator`.
    inputs
        Samples per estimate, where it takes neither more nor fewer; None for any number.
    pixels
        Pixels that it wants to train on.
    options
        Keywords of its models' ``predict``: entries that share `train` share one model, and differ
        in these.
    uses_features
        As for `Estimator`.
    joint_channels
        As for `Estimator`.
    uses_direct
        Whether its models take ``direct=``, the direct part of the samples; they cannot do without.
    learns, uses_neighbours
        It trains, and with a reference none looks across pixels.
    """

    name: str
    train: Callable[..., Model]
    source: str
    inputs: int | None
    pixels: int
    label: str = ""
    place: int = _LAST
    default: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    uses_features: bool = False
    joint_channels: bool = False
    uses_direct: bool = False
    learns: ClassVar[bool] = True
    uses_neighbours: ClassVar[bool] = False


Kind = Literal["fixed", "learned"]

_ENTRIES: dict[str, Estimator | LearnedEstimator] = {}

LABELS: dict[str, str] = {}
"""What text and figures call the registered estimators, by name."""


def register(
    name: str,
    source: str,
    *,
    label: str = "",
    place: int = _LAST,
    default: bool = False,
    minimum_samples: int = 1,
    uses_neighbours: bool = False,
    joint_channels: bool = False,
    uses_features: bool = False,
    learns: bool = False,
) -> Callable[[Function], Function]:
    """Enter the decorated function as the estimator `name`; see `Estimator` for the parameters.

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
    joint = joint_channels or uses_neighbours

    def enter(function: Function) -> Function:
        @functools.wraps(function)
        def estimate(x: npt.ArrayLike, *args: Any, **options: Any) -> Array:
            samples = entry.checked(x)
            warn_left_out(samples, channel_axis=-2 if joint else None, within="chdstat.estimators")
            return np.asarray(function(samples, *args, **options), samples.dtype)

        entry = Estimator(
            name,
            estimate,
            source,
            label=label,
            place=place,
            default=default,
            minimum_samples=minimum_samples,
            uses_neighbours=uses_neighbours,
            joint_channels=joint,
            uses_features=uses_features,
            learns=learns,
        )
        _enter(entry)
        return cast("Function", estimate)

    return enter


def register_learned(entry: LearnedEstimator) -> None:
    """Enter an estimator that has to be trained."""
    _enter(entry)


def forget(name: str) -> None:
    """Take an estimator out again."""
    lookup(name)
    del _ENTRIES[name], LABELS[name]


def names(kind: Kind | None = None) -> tuple[str, ...]:
    """Return the names of all estimators, or of one kind, in the order of their places.

    Examples
    --------
    >>> from chdstat import estimators
    >>> "mean" in estimators.names("fixed"), "mean" in estimators.names("learned")
    (True, False)
    """
    entries = sorted(_ENTRIES.values(), key=lambda entry: entry.place)
    return tuple(e.name for e in entries if kind is None or e.learns == (kind == "learned"))


def lookup(name: str) -> Estimator | LearnedEstimator:
    """Return the entry of an estimator.

    Raises
    ------
    InputError
        If there is no estimator of that name.
    """
    if name not in _ENTRIES:
        message = f"no estimator is called {name!r}; there are {', '.join(names())}"
        raise InputError(message)
    return _ENTRIES[name]


def _enter(entry: Estimator | LearnedEstimator) -> None:
    if entry.name in _ENTRIES:
        message = f"an estimator called {entry.name!r} is registered already; choose another name"
        raise InputError(message)
    _ENTRIES[entry.name] = entry
    LABELS[entry.name] = entry.label or entry.name.replace("_", " ")
