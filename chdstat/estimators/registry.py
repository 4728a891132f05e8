"""Registry of estimators, and helpers to write estimators of single pixels.

A fixed estimator is a function of samples, ``x (..., sample) -> (...)``, registered with
`register`. All of them take an image (y, x, channel, sample). Two flags say which axes an estimator
needs besides the last: `joint_channels` for the channel axis, `uses_neighbours` for the whole
image. The decorated function takes array-likes and returns the dtype of the samples; the function
itself gets a floating-point array with the axes that it needs.

A learned estimator is registered with `register_learned`, as a function that trains it on a scene
and returns a `Model`. `lookup` finds both by name.

An estimator of single pixels is a kernel on rows of good samples. `estimate_rows` passes them in
float64, divided by a power of two so that their mean size is about 1: squares and cubes of very
large or subnormal radiance then neither overflow nor vanish. Rows with missing samples are grouped
by their number of good samples, so a kernel never sees a mask.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt
from scipy import special

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
from chdstat.errors import InputError, check_option

Function = TypeVar("Function", bound=Callable[..., Reals])

_LAST = 100
"""Place of an estimator that is registered without one."""
_CHUNK = 2**15
"""Samples per block: their float64 copies and those of a kernel stay in the cache."""
_STEPS = 200
"""Largest number of steps; bisection alone converges in a quarter of them."""


class Model(Protocol):
    """Interface of a trained estimator."""

    @property
    def name(self) -> str:
        """Registered name of the estimator."""

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on, rows (y, x); they must not judge it."""

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
        Weight of everything but the mean of the pixel's samples, 0 to 1, shape (...). Where it is
        0, the estimate is this mean.
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
        Registered name.
    function
        The function itself.
    source
        Author, year, DOI.
    label
        Name in text and figures; "" for the registered name with spaces.
    place
        Place in lists of estimators, ascending; estimators of the same place follow in the order of
        their registration.
    minimum_samples
        Fewest samples that it takes.
    uses_neighbours
        Whether it uses other pixels, with all their channels; then it takes an image (y, x,
        channel, sample).
    joint_channels
        Whether it uses all channels together; then it takes samples (..., channel, sample), and
        leaves out samples with a bad channel.
    uses_features
        Whether it takes ``features=``, the first-hit features of the image, where there are any.
    uses_film
        Whether it takes ``film=``, where in its pixel each sample fell, if that is known.
    learns
        Whether each call trains on the samples that it is given.
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
    uses_film: bool = False
    learns: bool = False

    @property
    def about(self) -> str:
        """What it does: the first sentence of its documentation."""
        return (self.function.__doc__ or "").strip().partition("\n")[0].replace("`", "")

    def __call__(self, x: npt.ArrayLike, **options: Any) -> Reals:
        """Estimate the radiance from samples.

        Parameters
        ----------
        x
            Samples, shape (..., sample).
        **options
            Keywords of the function.

        Raises
        ------
        InputError
            If there are too few samples, or `x` lacks axes that the estimator needs.
        """
        return self.function(self.checked(x, minimum=self.minimum_samples), **options)

    def checked(self, x: npt.ArrayLike, *, minimum: int = 1) -> Reals:
        """Return samples as a floating-point array with the axes that the estimator needs."""
        if self.joint_channels or self.uses_neighbours:
            return as_pixels(x, minimum=minimum, image=self.uses_neighbours)
        return as_samples(x, minimum=minimum)


@dataclass(frozen=True, repr=False)
class LearnedEstimator(Shown):
    """An estimator that is trained on a scene before it estimates.

    Attributes
    ----------
    name
        Registered name.
    train
        ``train(samples, *, seed, iterations, pixels, progress)`` returns a trained `Model`. If the
        model takes any number of samples, ``train`` also takes ``sizes``, the numbers to estimate
        from.
    source
        Author, year, DOI.
    label, place
        As for `Estimator`.
    inputs
        Number of samples that an estimate takes; None for any number.
    pixels
        Number of pixels to train on.
    about
        What it does, in a sentence.
    uses_features
        As for `Estimator`.
    learns, uses_neighbours, uses_film
        True and False: it trains, and learned estimators use no other pixels and no places.
    """

    name: str
    train: Callable[..., Model]
    source: str
    inputs: int | None
    pixels: int
    about: str = ""
    label: str = ""
    place: int = _LAST
    uses_features: bool = False
    learns: ClassVar[bool] = True
    uses_neighbours: ClassVar[bool] = False
    uses_film: ClassVar[bool] = False


ENTRIES: dict[str, Estimator | LearnedEstimator] = {}
"""The registered estimators, by name."""
LABELS: dict[str, str] = {}
"""Labels of the registered estimators in text and figures, by name."""
_FILES: dict[str, str] = {}
"""Files of the plugins that have registered the estimators, by name; "" without a plugin."""
_PLUGINS: list[tuple[str, set[str]]] = [("", set())]
"""The file that registers at present, and the names that it has registered."""


def register(name: str, source: str, **facts: Any) -> Callable[[Function], Function]:
    """Register the decorated function as the estimator `name`; see `Estimator` for the parameters.

    If the function uses all channels together, estimates that are not finite are replaced by the
    mean of the channel's good samples. A function that is defined again, as in a notebook cell,
    replaces the earlier one.

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
    """Register an estimator that has to be trained."""
    _enter(entry)


def forget(name: str) -> None:
    """Remove an estimator."""
    lookup(name)
    del ENTRIES[name], LABELS[name], _FILES[name]


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


def title_of(estimator: str) -> str:
    """Return what one reads for the name of an estimator, which one types.

    Examples
    --------
    >>> from chdstat.estimators import registry
    >>> [registry.title_of(name) for name in ("catoni", "mean + OIDN", "my own")]
    ['Catoni', 'sample mean + OIDN', 'my own']
    """
    name, denoised, how = estimator.partition(" + ")
    return LABELS.get(name, name) + denoised + how


@contextlib.contextmanager
def registered_by(file: str) -> Iterator[set[str]]:
    """Note the estimators that a plugin registers; only its own may be registered again.

    Yields their names.
    """
    entered: set[str] = set()
    _PLUGINS.append((file, entered))
    try:
        yield entered
    finally:
        _PLUGINS.pop()


def _enter(entry: Estimator | LearnedEstimator) -> None:
    known = ENTRIES.get(entry.name)
    held = known is not None and _defined_at(known) != _defined_at(entry)
    file, entered = _PLUGINS[-1]
    if held and (not file or _FILES.get(entry.name) != file):
        message = f"an estimator called {entry.name!r} is registered already; choose another name"
        raise InputError(message)
    _FILES[entry.name] = file
    entered.add(entry.name)
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


def interval_of_mean(
    mean: Reals, error: Reals, count: Reals, level: float, *, signed: bool
) -> Reals:
    """Return the lower and upper ends of intervals of means of any shape (...), shape (2, ...).

    Means of positive samples are taken as gamma distributed with the shape k = (mean / error)^2.
    That is exact for exponential samples and nearly true for k equal samples among many nulls
    (Garwood 1936, doi:10.1093/biomet/28.3-4.437). For few samples, k is multiplied by the squared
    ratio of the normal quantile to Student's. Signed samples get Student's interval.
    """
    tails = np.array((0.5 + level / 2, 0.5 - level / 2))
    n = np.maximum(count.astype(np.float64) - 1, 1)
    student = special.stdtrit(n, tails[0])
    ends = np.stack([mean - student * error, mean + student * error])
    skewed = (mean > 0) & (error > 1e-3 * mean) & (not signed)
    m, of_error = mean[skewed], error[skewed]
    k = np.square(m / of_error * (special.ndtri(tails[0]) / student[skewed]))
    ends[:, skewed] = m * k / np.maximum(special.gammaincinv(k, tails[:, np.newaxis]), 1e-30)
    return ends


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
        ``kernel(rows, *beside) -> (row,)`` for rows (row, m) of m >= 1 good samples and the values
        `beside` of these rows (row,). It must scale with the unit of radiance.
    beside
        Other radiances of each row, shape (...).
    ordered
        Whether the kernel needs ascending samples. If not, it must not depend on their order: rows
        with missing samples are sorted anyway.

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
        # The unit and its inverse are finite for every mean, also for 0.
        unit = np.ldexp(1.0, exponent - 1)
        relative /= unit[:, np.newaxis]
        result[where] = kernel(relative, *(other[where] / unit for other in others)) * unit
    return result.astype(x.dtype).reshape(x.shape[:-1])


def _good_rows(rows: npt.NDArray[Any], ordered: bool) -> Iterator[tuple[Any, npt.NDArray[Any]]]:
    """Yield rows with equally many good samples: their places, and these samples."""
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
    """Return samples (..., channel, sample), 0 where a channel is bad, and a mask of the others."""
    good = np.asarray(~is_bad(x).any(axis=-2))
    return x if good.all() else np.where(good[..., np.newaxis, :], x, 0), good


def known_features(
    features: Mapping[str, npt.NDArray[Any]], shape: tuple[int, ...], names: Sequence[str]
) -> dict[str, Floats]:
    """Return the features of these names that exist, made finite, shape (y, x, number)."""
    found = {}
    for name in [name for name in names if name in features]:
        field = np.asarray(features[name], np.float64)
        if field.shape[:2] != shape or field.ndim not in (2, 3):
            message = f"feature {name!r} must have shape {shape} or {shape} x 3, got {field.shape}"
            raise InputError(message)
        found[name] = np.nan_to_num(np.atleast_3d(field), posinf=0, neginf=0)
    return found


def check_positive(**options: float) -> None:
    """Raise InputError for an option that is not larger than 0."""
    for name, value in options.items():
        if not value > 0:
            message = f"{name} must be larger than 0, got {value}"
            raise InputError(message)


def converge(
    update: Callable[..., tuple[Floats, ...]], start: Floats, near: Floats, *beside: Floats
) -> Floats:
    """Repeat an update until it moves no row by more than `near`; converged rows drop out.

    ``update(theta, *beside)`` returns the next theta (row,) and the next `beside`.
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
