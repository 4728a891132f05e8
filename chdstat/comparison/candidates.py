"""Candidates: the estimators of a comparison, looked up, checked, and trained where they learn.

`DEFAULT_ESTIMATORS` is the one list of what is compared where nobody names any. `Denoised` is an
estimator followed by Open Image Denoise: use it to see whether a denoiser does better from a
better start. ``compare(..., denoise=True)`` adds every estimator so; `denoised` makes one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, whole
from chdstat._core.image_scales import mean_radiance
from chdstat.errors import InputError
from chdstat.estimators.estimates import check_denoiser, through_denoiser
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.registry import Estimator, LearnedEstimator, Model, lookup
from chdstat.estimators.validation import Totals, check_spp, draw_pixels, judging_pixels
from chdstat.samples import Samples

__all__ = [
    "DEFAULT_ESTIMATE",
    "DEFAULT_ESTIMATORS",
    "Candidates",
    "Chosen",
    "Denoised",
    "Entry",
    "Given",
    "choose",
    "curve_sizes",
    "denoised",
    "entry_of",
    "estimate_by",
    "takes",
    "without_denoiser",
]


DEFAULT_ESTIMATE = "combination"
"""What `chdstat.estimate` returns where nothing else is asked for."""
DEFAULT_ESTIMATORS = (
    DEFAULT_ESTIMATE,
    "mean",
    "mean + OIDN features",
    "median_of_means",
    "elek2019",
)
"""What is compared where no estimators are named: the default estimate; the sample mean, to which
errors are ratios; its denoised image, a robust mean and the network of the paper."""

_EDGE = 8
"""Edge in pixels of the image of equal samples on which an estimator says what it refuses."""
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
    if not isinstance(given, str):
        return _checked_entry(given)
    for end in (" + OIDN", " + OIDN features"):
        if given.endswith(end):
            return denoised(given.removesuffix(end), with_features=end.endswith("features"))
    return lookup(given)


def _checked_entry(given: Any) -> Entry:
    if not isinstance(given, Entry):
        message = f"expected names of estimators or entries of your own, got {given!r}"
        raise InputError(message)
    return given


@dataclass(frozen=True)
class Chosen:
    """Estimators that are compared.

    Attributes
    ----------
    entries
        By name, in the order asked for.
    left_out
        Those of `DEFAULT_ESTIMATORS` that do not apply, with the reason.
    by_default
        Whether nobody named them: then one that cannot be trained is left out, too.
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
        The image, on which default estimators train; None where there are several images, and
        nothing is trained.

    Raises
    ------
    InputError
        If one is unknown, named twice, or takes none of the `sizes`.
    """
    if estimators is None:
        return _defaults(sizes, samples)
    found = _entries(estimators)
    entries = {entry.name: entry for entry in found}
    if not entries or len(entries) < len(found):
        message = f"estimators must be one or more different names, got {[e.name for e in found]}"
        raise InputError(message)
    for entry in found:
        if reason := _too_few(entry, sizes):
            message = f"{without_denoiser(entry).name} {reason}; give another n"
            raise InputError(message)
    return Chosen(entries)


def _entries(estimators: Sequence[str | Entry]) -> list[Entry]:
    if isinstance(estimators, str):
        message = f"estimators must be a list of names, got the single name {estimators!r}"
        raise InputError(message)
    return [entry_of(given) for given in estimators]


def _defaults(sizes: Sequence[int], samples: Samples | None) -> Chosen:
    """Return the default estimators that apply to an image and a number of samples."""
    entries: dict[str, Entry] = {}
    left_out: dict[str, str] = {}
    for name in DEFAULT_ESTIMATORS:
        entry = entry_of(name)
        if isinstance(entry, Denoised) and samples is not None:
            entry = replace(entry, with_features="albedo" in samples.features)
        reason = _too_few(entry, sizes) or _refusal(entry, sizes, samples)
        if reason:
            left_out[entry.name] = reason
        else:
            entries[entry.name] = entry
    return Chosen(entries, left_out, by_default=True)


def _too_few(entry: Entry, sizes: Sequence[int]) -> str:
    """Return why an estimator takes none of the numbers of samples; "" where it takes one."""
    if any(takes(entry, n) for n in sizes):
        return ""
    exact = isinstance(without_denoiser(entry), LearnedEstimator)
    given = f"n={sizes[0]}" if len(sizes) == 1 else f"sizes {tuple(sizes)}"
    return f"takes {'exactly' if exact else 'at least'} {_least_taken(entry)} samples, got {given}"


def _refusal(entry: Entry, sizes: Sequence[int], samples: Samples | None) -> str:
    """Return why an estimator takes no such image; "" where it does."""
    own = without_denoiser(entry)
    if isinstance(own, LearnedEstimator):
        return "" if samples is not None else "trains on each scene, against a reference"
    channels = 3 if samples is None else samples.shape[2]
    equal = np.ones((_EDGE, _EDGE, channels, max(sizes)), np.float32)
    try:
        estimate_by(entry, equal)
    except InputError as error:
        return str(error)
    return ""


def curve_sizes(
    samples: Samples,
    estimators: Sequence[str | Entry] | None = None,
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
        entries = _entries(DEFAULT_ESTIMATORS if estimators is None else estimators)
        fewest = {_least_taken(e) for e in entries if not any(takes(e, n) for n in doubled)}
        sizes = [*doubled, *(n for n in fewest if 2 * n <= samples.spp)]
    if np.ndim(sizes) != 1:
        message = f"sizes must be several numbers, got {sizes!r}"
        raise InputError(message)
    chosen = tuple(sorted(whole("a size", n, least=1) for n in sizes))
    if not chosen or len(set(chosen)) < len(chosen):
        message = f"sizes must be one or more different numbers from 1, got {chosen}"
        raise InputError(message)
    check_spp(samples, chosen[-1])
    choose(estimators, chosen, samples=samples)
    return chosen


def takes(entry: Entry, n: int) -> bool:
    """Return whether an estimator takes n samples."""
    own = without_denoiser(entry)
    if isinstance(own, LearnedEstimator):
        return own.inputs is None or n == own.inputs
    return n >= own.minimum_samples


def _least_taken(entry: Entry) -> int:
    """Return the fewest samples that an estimator takes."""
    own = without_denoiser(entry)
    return (own.inputs or 1) if isinstance(own, LearnedEstimator) else own.minimum_samples


def without_denoiser(entry: Entry) -> Estimator | LearnedEstimator:
    """Return the estimator that a denoiser follows, or the estimator itself."""
    return entry.entry if isinstance(entry, Denoised) else entry


def estimate_by(
    entry: Entry,
    x: Array,
    *,
    features: Mapping[str, Array] | None = None,
    model: Any = None,
    at_home: bool = False,
) -> Array:
    """Estimate radiance (y, x, channel) from samples (y, x, channel, sample).

    Parameters
    ----------
    entry
        What estimates; a denoiser follows where it is `Denoised`.
    x
        Samples of a whole image, or of as much as it should see.
    features
        First-hit features of the same pixels, for those that take them.
    model
        Of an estimator that learns.
    at_home
        Whether the model was trained on this scene, so that it is followed all the way.
    """
    own, known = without_denoiser(entry), features or {}
    options = dict(own.options) if isinstance(own, LearnedEstimator) else {}
    if own.uses_features and known:
        options["features"] = known
    if at_home and isinstance(model, Progressive):
        options["unit"] = mean_radiance(x)
    if not isinstance(entry, Denoised):
        return np.asarray(own(x, **options) if model is None else model.predict(x, **options))  # type: ignore[operator]
    guides = known if entry.with_features else {}
    if entry.with_certainty:
        found = model.estimate(x, **options)
        return through_denoiser(found.radiance, guides, certainty=found.certainty)
    radiance = estimate_by(own, x, features=known, model=model, at_home=at_home)
    return through_denoiser(radiance, guides)


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
        By name, in the order asked for.
    models
        Those that were trained, by name; entries that share a training share a model.
    judging
        Pixels that no training draws, shape (y, x), whoever takes part.
    at_home
        Those of the models that were trained on this scene, by name.
    left_out
        As of `Chosen`.
    """

    samples: Samples
    totals: Totals
    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    judging: npt.NDArray[np.bool_]
    at_home: frozenset[str]
    left_out: Mapping[str, str]

    @classmethod
    def of(
        cls,
        chosen: Chosen,
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
        entries, left_out = dict(chosen.entries), dict(chosen.left_out)
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
        own = [without_denoiser(entry) for entry in entries.values()]
        learned = {e.name: e for e in own if isinstance(e, LearnedEstimator)}
        given = _given(model, learned)
        trained = dict(given)
        for name, entry in list(learned.items()):
            if entry.train in trained:
                continue
            # What takes any number of samples is trained for those that it is judged at.
            options = {} if entry.inputs else {"sizes": tuple(sizes)}
            pixels = draw_pixels(samples.shape[:2], entry.pixels, seed=seed)
            try:
                trained[entry.train] = entry.train(
                    samples, seed=seed, pixels=pixels, progress=progress, **options
                )
            except InputError as error:
                if not chosen.by_default:
                    raise
                del learned[name], entries[name]
                left_out[name] = str(error)
        models = {name: trained[entry.train] for name, entry in learned.items()}
        for name, entry in entries.items():
            base = without_denoiser(entry).name
            certain = isinstance(entry, Denoised) and entry.with_certainty
            if certain and not hasattr(models[base], "estimate"):
                message = f"{base} says no certainty; leave {name!r} out"
                raise InputError(message)
        at_home = frozenset(
            name
            for name, entry in learned.items()
            if entry.train not in given
            or (isinstance(one := models[name], Progressive) and one.trained_on(samples.attrs))
        )
        judging = judging_pixels(samples.shape[:2], seed=seed)
        return cls(samples, totals, entries, models, judging, at_home, left_out)

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
            "left_out": dict(self.left_out),
            "models": {n: getattr(model, "provenance", {}) for n, model in self.models.items()},
        }

    def taking(self, n: int) -> dict[str, Callable[[Array], Array]]:
        """Return those that take n samples, as functions of samples (y, x, channel, sample)."""
        found: dict[str, Callable[[Array], Array]] = {}
        for name, entry in self.entries.items():
            if takes(entry, n):
                own = without_denoiser(entry).name
                found[name] = partial(
                    estimate_by,
                    entry,
                    features=self.samples.features,
                    model=self.models.get(own),
                    at_home=own in self.at_home,
                )
        return found

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
