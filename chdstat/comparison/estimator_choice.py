"""Choice of the estimators of a comparison: looked up by name and checked.

`DEFAULT_ESTIMATORS` are compared by default. `Denoised` is an estimator followed by Open Image
Denoise: use it to see whether a denoiser profits from a better input. `denoised` makes one;
``compare(..., denoise=True)`` adds one for every estimator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, whole
from chdstat.comparison.judges import check_samples_for_judge
from chdstat.errors import InputError
from chdstat.estimators.default_estimate.candidates import through_denoiser
from chdstat.estimators.registry import (
    LABELS,
    Estimator,
    LearnedEstimator,
    lookup,
    title_of,
)
from chdstat.samples import Samples

DEFAULT_ESTIMATE = "combination"
"""What `chdstat.estimate` returns by default."""
DEFAULT_ESTIMATORS = (
    DEFAULT_ESTIMATE,
    "mean",
    "mean + OIDN features",
    "median_of_means",
    "elek2019",
)
"""Compared by default: the default estimate; the sample mean, by whose errors all are divided; its
denoised image; a robust mean; and the network of the paper."""

_EDGE = 8
"""Edge, in pixels, of the constant test image on which an estimator is tried."""
_SMALLEST, _SHARE = 4, 8
"""By default, sizes double from 4 to an eighth of the samples: the rest is the reference."""


@dataclass(frozen=True)
class Denoised:
    """An estimator followed by Open Image Denoise.

    Attributes
    ----------
    entry
        The estimator.
    with_features
        Whether the denoiser gets albedo and normal of the first hit.
    uses_neighbours
        A denoiser always looks across pixels.
    """

    entry: Estimator | LearnedEstimator
    with_features: bool = False
    uses_neighbours: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name, such as "mean + OIDN features"."""
        return f"{self.entry.name} + OIDN{' features' if self.with_features else ''}"


def denoised(
    estimator: str | Estimator | LearnedEstimator, *, with_features: bool = False
) -> Denoised:
    """Return an estimator followed by Open Image Denoise, for `chdstat.compare`.

    A learned estimator is trained once, for itself and for its denoised version. Negative estimates
    count as 0.

    Parameters
    ----------
    estimator
        Name of a registered estimator, or an entry.
    with_features
        Give the denoiser albedo and normal of the first hit; the image must have them.

    Raises
    ------
    InputError
        If there is no such estimator.

    References
    ----------
    A. T. Afra, "Intel Open Image Denoise", https://www.openimagedenoise.org.

    Examples
    --------
    >>> denoised("mean", with_features=True).name
    'mean + OIDN features'
    """
    entry = lookup(estimator) if isinstance(estimator, str) else estimator
    return Denoised(entry, with_features)


Entry = Estimator | LearnedEstimator | Denoised


def entry_of(given: str | Entry) -> Entry:
    """Return the entry of a name, which may end in " + OIDN" or " + OIDN features".

    Raises
    ------
    InputError
        If there is no such estimator, or it is neither a name nor an entry.

    Examples
    --------
    >>> entry_of("mean + OIDN features").with_features
    True
    """
    if isinstance(given, str):
        name, denoiser, guides = given.partition(" + OIDN")
        if denoiser and guides in ("", " features"):
            return denoised(name, with_features=bool(guides))
        return lookup(given)
    entry: Any = given
    if not isinstance(entry, Entry):
        message = f"expected names of estimators or entries of your own, got {given!r}"
        raise InputError(message)
    return entry


@dataclass(frozen=True)
class Chosen:
    """The estimators of a comparison.

    Attributes
    ----------
    entries
        By name, in the order given.
    left_out
        Names from `DEFAULT_ESTIMATORS` that do not apply, with the reason.
    by_default
        True if the caller named no estimators; then those that cannot be trained are left out.
    """

    entries: Mapping[str, Entry]
    left_out: Mapping[str, str] = field(default_factory=dict)
    by_default: bool = False


def choose(
    estimators: Sequence[str | Entry] | None,
    sizes: Sequence[int],
    *,
    samples: Samples | None = None,
) -> Chosen:
    """Look up the estimators of a comparison.

    Parameters
    ----------
    estimators
        Names or entries; None takes those of `DEFAULT_ESTIMATORS` that apply.
    sizes
        Samples per estimate.
    samples
        The image on which default estimators train; None if there are several images and nothing is
        trained.

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or takes none of the `sizes`.
    """
    found = _entries(estimators)
    if estimators is not None:
        entries = {entry.name: entry for entry in found}
        if not entries or len(entries) < len(found):
            names = [entry.name for entry in found]
            message = f"estimators must be one or more different names, got {names}"
            raise InputError(message)
        for entry in found:
            if reason := _too_few(entry, sizes):
                message = f"{without_denoiser(entry).name} {reason}; give another n"
                raise InputError(message)
        return Chosen(entries)
    if samples is not None:
        guided = "albedo" in samples.features
        found = [replace(e, with_features=guided) if isinstance(e, Denoised) else e for e in found]
    reasons = {e.name: _too_few(e, sizes) or _refusal(e, sizes, samples) for e in found}
    return Chosen(
        {entry.name: entry for entry in found if not reasons[entry.name]},
        {name: reason for name, reason in reasons.items() if reason},
        by_default=True,
    )


def _entries(estimators: Sequence[str | Entry] | None) -> list[Entry]:
    if isinstance(estimators, str):
        message = f"estimators must be a list of names, got the single name {estimators!r}"
        raise InputError(message)
    return [entry_of(given) for given in (DEFAULT_ESTIMATORS if estimators is None else estimators)]


def _too_few(entry: Entry, sizes: Sequence[int]) -> str:
    """Return why an estimator takes none of the numbers of samples; "" if it takes one."""
    if any(takes(entry, n) for n in sizes):
        return ""
    least, exact = _taken(entry)
    given = f"n={sizes[0]}" if len(sizes) == 1 else f"sizes {tuple(sizes)}"
    return f"takes {'exactly' if exact else 'at least'} {least} samples, got {given}"


def _refusal(entry: Entry, sizes: Sequence[int], samples: Samples | None) -> str:
    """Return why an estimator does not apply to an image; "" if it does."""
    if isinstance(without_denoiser(entry), LearnedEstimator):
        return "" if samples is not None else "trains on each scene, against a reference"
    channels = 3 if samples is None else samples.shape[2]
    try:
        estimate_by(entry, np.ones((_EDGE, _EDGE, channels, max(sizes)), np.float32))
    except InputError as error:
        return str(error)
    return ""


def curve_sizes(
    samples: Samples,
    estimators: Sequence[str | Entry] | None = None,
    *,
    sizes: Sequence[int] | None = None,
) -> tuple[int, ...]:
    """Return the sizes N of an error curve, checked and in ascending order.

    Raises
    ------
    InputError
        As `error_curve` does.
    """
    if sizes is None:
        largest = max(_SMALLEST, samples.fewest // _SHARE)
        sizes = [2**k for k in range(_SMALLEST.bit_length() - 1, largest.bit_length())]
        none = [entry for entry in _entries(estimators) if _too_few(entry, sizes)]
        fewest = {_taken(entry)[0] for entry in none}
        sizes += [n for n in fewest if 2 * n <= samples.fewest]
    if np.ndim(sizes) != 1:
        message = f"sizes must be several numbers, got {sizes!r}"
        raise InputError(message)
    chosen = tuple(sorted(whole("a size", n, least=1) for n in sizes))
    if not chosen or len(set(chosen)) < len(chosen):
        message = f"sizes must be one or more different numbers from 1, got {chosen}"
        raise InputError(message)
    check_samples_for_judge(samples, chosen[-1])
    choose(estimators, chosen, samples=samples)
    return chosen


def takes(entry: Entry, n: int) -> bool:
    """Return whether an estimator takes n samples."""
    least, exact = _taken(entry)
    return n == least if exact else n >= least


def _taken(entry: Entry) -> tuple[int, bool]:
    """Return the fewest samples that an estimator takes, and whether it only takes that number."""
    own = without_denoiser(entry)
    if isinstance(own, LearnedEstimator):
        return own.inputs or 1, own.inputs is not None
    return own.minimum_samples, False


def without_denoiser(entry: Entry) -> Estimator | LearnedEstimator:
    """Return the estimator without the denoiser after it."""
    return entry.entry if isinstance(entry, Denoised) else entry


def estimate_by(
    entry: Entry,
    x: Array,
    *,
    features: Mapping[str, Array] | None = None,
    film: Samples | None = None,
    model: Any = None,
) -> Array:
    """Estimate radiance (y, x, channel) from samples (y, x, channel, sample).

    Parameters
    ----------
    entry
        The estimator; if it is `Denoised`, a denoiser follows.
    x
        Samples of a whole image, or of the part that the estimator should see.
    features
        First-hit features of the same pixels, for estimators that take them.
    film
        Where in its pixel each sample fell, for estimators that take it, if known of all of them.
    model
        Trained model of an estimator that learns.
    """
    own, known = without_denoiser(entry), features or {}
    if isinstance(entry, Denoised):
        radiance = estimate_by(own, x, features=known, film=film, model=model)
        return through_denoiser(radiance, known if entry.with_features else {})
    options: Any = {"features": known} if own.uses_features and known else {}
    if own.uses_film and film is not None and film.shape[-1] == x.shape[-1]:
        options["film"] = film.read()
    return np.asarray(own(x, **options) if model is None else model.predict(x, **options))  # type: ignore[operator]


def notes(
    estimators: Sequence[str],
    *,
    uses_neighbours: npt.ArrayLike = (),
    left_out: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Return notes for a reader of a table of estimators.

    Parameters
    ----------
    estimators
        Names of the estimators in the rows.
    uses_neighbours
        Whether each uses the pixels around, shape (estimator,), if known.
    left_out
        Default estimators that do not apply, with the reason.

    Examples
    --------
    >>> notes(["mean", "zirr2018"], uses_neighbours=[False, True])
    {'use neighbours': 'Zirr et al. 2018'}
    """
    found = {}
    default = lookup(DEFAULT_ESTIMATE)
    if DEFAULT_ESTIMATE in estimators and isinstance(default, Estimator):
        about = f"{default.about[:1].lower()}{default.about[1:]}"
        found["default estimate"] = f"{LABELS[DEFAULT_ESTIMATE]}: {about}"
    around = [estimators[k] for k in np.flatnonzero(uses_neighbours).tolist()]
    if around:
        found["use neighbours"] = ", ".join(map(title_of, around))
    if left_out:
        reasons = (f"{title_of(name)} {why}" for name, why in left_out.items())
        found["left out"] = "; ".join(reasons)
    return found
