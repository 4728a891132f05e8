"""Judging: compare estimates from the same batches with held-out references.

`trained_candidates` trains the learned estimators, on pixels that do not judge. `Units` are the
judging pixels. They depend only on the image and the seed, so no row of a table depends on the
other estimators; if no estimator was trained on an image of this size, all pixels judge. `judge`
sums the errors of every estimator over them. These `Errors`, by unit, estimator and channel, are
all that a comparison, its breakdown by label and a curve over n are computed from.

Memory is bounded: one batch of the image, one estimate of it, and sums over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, block_numbers, flag_attributes, flag_names, whole
from chdstat._core.progress import portion, track
from chdstat._core.resampling import Interval
from chdstat._core.work import in_order
from chdstat.comparison.estimator_choice import (
    Chosen,
    Denoised,
    Entry,
    estimate_by,
    takes,
    without_denoiser,
)
from chdstat.comparison.judges import Judge, PartialSums
from chdstat.comparison.metrics import SUMS, counts, errors_of, measures_of
from chdstat.errors import InputError
from chdstat.estimators.estimates import check_denoiser
from chdstat.estimators.held_out import draw_pixels, judging_pixels
from chdstat.estimators.registry import LearnedEstimator, Model, lookup
from chdstat.estimators.robust_means import mean
from chdstat.patterns import Label, classify
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

Models = Model | Mapping[str, Model] | None
"""A trained model, or several by the name of their estimator."""


# --- who estimates ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Candidates:
    """Estimators of an image, trained where they learn.

    Attributes
    ----------
    samples
        The image.
    totals
        Sums over its samples, from which references are computed.
    entries
        By name, in the order given.
    models
        Trained models by name; entries that share a training share a model.
    left_out
        Default estimators that cannot be compared, with the reason.
    seed, max_batches
        Seed of the pixels, and most batches of a pixel; None for all.
    """

    samples: Samples
    totals: PartialSums
    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    left_out: Mapping[str, str]
    seed: int
    max_batches: int | None

    @property
    def uses_neighbours(self) -> npt.NDArray[np.bool_]:
        """Whether each uses the pixels around, shape (estimator,)."""
        return np.array([entry.uses_neighbours for entry in self.entries.values()], bool)

    def test_units(self, labels: npt.NDArray[np.int64] | None = None) -> Units:
        """Return the judging pixels: all if no model was trained on an image of this shape.

        Raises
        ------
        InputError
            If there is none.
        """
        shape = self.samples.shape[:2]
        seen = [_seen(model, shape) for model in self.models.values()]
        test = (
            judging_pixels(shape, seed=self.seed) if any(map(len, seen)) else np.ones(shape, bool)
        )
        for pixels in seen:
            test[tuple(pixels.T)] = False
        if not test.any():
            message = (
                "the models were trained on every pixel of this image; none is left to judge by"
            )
            raise InputError(message)
        return Units.of(test, labels)

    @property
    def provenance(self) -> dict[str, Any]:
        """Scene, samples and settings of a comparison, and the provenance of the models."""
        return {
            "scene": self.samples.name,
            "samples": self.samples.attrs,
            "samples_shape": list(self.samples.shape),
            "seed": self.seed,
            "max_batches": self.max_batches,
            "left_out": self.left_out,
            "models": {n: getattr(model, "provenance", {}) for n, model in self.models.items()},
        }


def trained_candidates(
    chosen: Chosen,
    samples: Samples,
    *,
    sizes: Sequence[int],
    seed: int,
    max_batches: int | None,
    model: Models,
    progress: bool,
    denoise: bool = False,
) -> Candidates:
    """Train the learned estimators, except those with a given model.

    With `denoise`, all denoised versions that the image allows are appended.

    Raises
    ------
    InputError
        If no sample is good, the denoiser is missing, a model belongs to no estimator, or an
        estimator needs features that the image lacks.
    """
    if max_batches is not None:
        max_batches = whole("max_batches", max_batches, least=1)
    entries, left_out = dict(chosen.entries), dict(chosen.left_out)
    totals = PartialSums.of(samples)
    if not totals.count.any():
        message = "every sample of the image is bad (NaN or infinite); none can judge"
        raise InputError(message)
    # Check everything before training.
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
    trained = _given(model, learned)
    for name, entry in list(learned.items()):
        if entry.train in trained:
            continue
        # An estimator that takes any number of samples is trained for the judged sizes.
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
    if denoise:
        guided = (False, True) if "albedo" in samples.features else (False,)
        plain = [entry for entry in entries.values() if not isinstance(entry, Denoised)]
        for added in (Denoised(entry, guides) for entry in plain for guides in guided):
            entries.setdefault(added.name, added)
    return Candidates(samples, totals, entries, models, left_out, seed, max_batches)


def _given(model: Models, learned: Mapping[str, LearnedEstimator]) -> dict[Any, Model]:
    """Return the given models by the training that they replace."""
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
    return model.train_pixels if model.train_shape == shape else np.zeros((0, 2), np.int64)


# --- what judges --------------------------------------------------------------------------------

_ACROSS = 8
"""Blocks along each side of the image."""


@dataclass(frozen=True)
class Units:
    """Judging pixels, grouped into units: the pixels of a label in a block of the image.

    Attributes
    ----------
    ys, xs
        The pixels, unit by unit, shape (pixel,).
    starts
        Where each unit begins, shape (unit,).
    label, block
        Label and block of each unit, shape (unit,).
    """

    ys: npt.NDArray[np.intp]
    xs: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    label: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]

    @classmethod
    def of(cls, test: npt.NDArray[np.bool_], labels: npt.NDArray[np.int64] | None = None) -> Units:
        """Group the pixels of `test` by 8 x 8 blocks of the image, and by label."""
        ys, xs = np.nonzero(test)
        label = np.zeros(len(ys), np.int64) if labels is None else labels[ys, xs]
        block = block_numbers(*test.shape, across=_ACROSS)[ys, xs]
        order = np.lexsort((block, label))
        label, block = label[order], block[order]
        new = (np.diff(label, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0)
        starts = np.flatnonzero(new)
        return cls(ys[order], xs[order], starts, label[starts], block[starts])

    def __call__(self, image: Array) -> Array:
        """Return the values of an image at the pixels, shape (pixel, ...)."""
        return np.asarray(image[self.ys, self.xs])

    def sum(self, values: Array) -> Array:
        """Add up values (pixel, ...) within each unit."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))

    def image(self, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
        """Return where the pixels are, shape (y, x)."""
        found = np.zeros(shape, bool)
        found[self.ys, self.xs] = True
        return found


def labels_of(
    given: npt.ArrayLike | xr.DataArray | xr.Dataset | str,
    samples: Samples,
    *,
    progress: bool = True,
) -> tuple[npt.NDArray[np.int64], dict[int, str]]:
    """Return the labels of an image as codes (y, x), and the names of the codes.

    Parameters
    ----------
    given
        Codes of `Label`, shape (y, x); a labelled map of other codes with the attributes
        ``flag_values`` and ``flag_meanings``; a dataset with such a map as ``label``; or
        "classify".

    Raises
    ------
    InputError
        If it is none of these, has another shape, or holds codes without a name.
    """
    found: Any = given
    if isinstance(given, str):
        if given != "classify":
            message = f"labels must be a map of labels or 'classify', got {given!r}"
            raise InputError(message)
        found = classify(samples, progress=progress)
    if hasattr(found, "data_vars"):
        if "label" not in found:
            message = f"a dataset of labels has a variable 'label'; this one has {list(found)}"
            raise InputError(message)
        found = found["label"]
    codes = np.asarray(found)
    if codes.shape != samples.shape[:2] or codes.dtype.kind not in "iu":
        message = (
            f"labels must be integers of shape {samples.shape[:2]}, one for each pixel; "
            f"got {codes.dtype} of shape {codes.shape}"
        )
        raise InputError(message)
    attrs = getattr(found, "attrs", {})
    flags = attrs if "flag_meanings" in attrs else flag_attributes(Label)
    names = flag_names(flags)
    unknown = set(np.unique(codes).tolist()) - set(names)
    if unknown:
        message = f"labels must be among {names}, got {sorted(unknown)} too"
        raise InputError(message)
    return codes.astype(np.int64), names


@dataclass(frozen=True)
class Errors:
    """Summed errors of estimators on the same batches, from which all measures follow.

    Attributes
    ----------
    sums
        Sums over batches by the names of `SUMS`, shape (unit, sum, 1 + estimator, channel); the
        sample mean is estimator 0. NaN for estimators that do not take so many samples.
    label, block, area
        Label, block and number of pixels of each unit, shape (unit,).
    excluded
        Number of batches of test pixels without a reference.
    estimates
        Estimates of the whole image from the first batch, by estimators that take so many samples,
        shape (estimator, y, x, channel).
    mean
        Mean of the first batch, shape (y, x, channel).
    reference
        Of the first batch: of all other samples.
    """

    sums: npt.NDArray[np.float64]
    label: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]
    area: npt.NDArray[np.int64]
    excluded: int
    estimates: npt.NDArray[np.float32]
    mean: npt.NDArray[np.float32]
    reference: Judge

    @property
    def batches(self) -> int:
        """Number of estimates that count."""
        return int(counts(self.sums).sum())

    @property
    def pixels(self) -> int:
        """Number of pixels in the units in which an estimate counts."""
        return int(self.area[counts(self.sums) > 0].sum())

    def of_labels(self) -> dict[int, Errors]:
        """Return the errors by the labels of which an estimate counts."""
        seen = np.unique(self.label[counts(self.sums) > 0]).tolist()
        return {code: self._units(self.label == code) for code in seen}

    def _units(self, where: npt.NDArray[np.bool_]) -> Errors:
        kept = {n: getattr(self, n)[where] for n in ("sums", "label", "block", "area")}
        return replace(self, **kept)

    def measures(self, *, seed: int) -> dict[str, Interval[Array]]:
        """Return all measures, with intervals over blocks, whatever the labels of their pixels."""
        blocks, block = np.unique(self.block, return_inverse=True)
        by_block = np.zeros((len(blocks), *self.sums.shape[1:]))
        np.add.at(by_block, block, self.sums)
        return measures_of(by_block, seed=seed)


def judge(
    candidates: Candidates,
    units: Units,
    *,
    n: int,
    progress: bool,
    client: Client | None,
) -> Errors:
    """Sum the errors of every estimator that takes n samples, on the same batches.

    The image is read with n samples at a time, and one estimator runs at a time; with a client,
    each worker does so for its own batch. If pixels have different numbers of samples, only batches
    that all pixels have are used; references use all samples.

    Raises
    ------
    InputError
        If an estimator returns another shape, or no batch has a reference.
    """
    samples = candidates.samples
    height, width, channels, _ = samples.shape
    rounds = min(samples.fewest // n, candidates.max_batches or samples.spp)
    sums = len(SUMS), 1 + len(candidates.entries), channels
    by_unit, excluded = np.zeros((len(units.starts), *sums)), 0
    parts = (samples.isel(sample=slice(k * n, (k + 1) * n)) for k in range(rounds))
    # The data sent to workers with a batch contains no samples of other batches.
    light = replace(candidates, samples=samples.isel(sample=slice(1)))
    task = partial(_errors_of_batch, light, units, n)
    with track(f"comparing at N = {n}", rounds * height * width, unit="px", show=progress) as told:
        counted: Any = {"advance": told, "size": lambda _: height * width}
        results = in_order(task, enumerate(parts), workers=1, client=client, **counted)
        for index, (of_batch, without, images, reference) in enumerate(results):
            if index == 0:
                (first_mean, *estimates), first_reference = images, reference
            by_unit += of_batch
            excluded += without
    if not counts(by_unit).any():
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    shown = np.stack(estimates), first_mean, cast("Judge", first_reference)
    area = units.sum(np.ones(len(units.ys), np.int64))
    return Errors(by_unit, units.label, units.block, area, excluded, *shown)


def _errors_of_batch(
    candidates: Candidates, units: Units, n: int, batch: tuple[int, Samples]
) -> tuple[Array, int, list[npt.NDArray[np.float32]], Judge | None]:
    """Compute the errors of every estimator that takes n samples on one batch.

    Returns
    -------
    tuple
        Sums over each unit, the number of test pixels without a reference, and of the first batch
        alone the images of the estimates and the reference.
    """
    number, x = batch[0], batch[1].read()
    totals, features = candidates.totals, candidates.samples.features
    average, reference = mean(x), totals.judge(x, first=number * n)
    truth, of_mean = reference[units.ys, units.xs], units(average)
    usable = np.asarray(np.isfinite(truth.mean).all(axis=-1))
    truth = truth[usable]
    entries = [None, *candidates.entries.values()]  # the sample mean, and the estimators
    sums = np.full((len(units.starts), len(SUMS), len(entries), average.shape[-1]), np.nan)
    estimates = []
    for k, entry in enumerate(entries):
        estimate = average
        if entry is not None:
            if not takes(entry, n):
                continue
            own = without_denoiser(entry).name
            with portion(1 / len(entries)):
                model = candidates.models.get(own)
                given: Any = {"features": features, "film": batch[1].film}
                estimate = estimate_by(entry, x, **given, model=model)
            if estimate.shape != average.shape:
                message = (
                    f"{entry.name} must return one estimate for each pixel and channel, shape "
                    f"{average.shape}, got {estimate.shape}"
                )
                raise InputError(message)
        found = np.zeros((len(usable), *sums.shape[1::2]))
        found[usable] = errors_of(
            units(estimate)[usable], of_mean[usable], truth, scene_mean=totals.scene_mean
        )
        sums[:, :, k] = units.sum(found)
        if number == 0:
            estimates.append(estimate.astype(np.float32))
    return sums, int((~usable).sum()), estimates, reference if number == 0 else None


def measures_of_image(
    estimates: Sequence[Array], mean: Array, reference: Judge, units: Units, scene_mean: Array
) -> dict[str, Interval[Array]]:
    """Return the measures of estimates of an image from one batch.

    Parameters
    ----------
    estimates, mean
        Estimates of the image, and the mean of the same samples, each of shape (y, x, channel).
    reference
        Of the image.
    units
        The pixels that judge.
    scene_mean
        Mean radiance of the scene, shape (channel,).
    """
    truth, of_mean = reference[units.ys, units.xs], units(mean)
    usable = np.asarray(np.isfinite(truth.mean).all(axis=-1))
    sums = []
    for image in (mean, *estimates):
        found = np.zeros((len(usable), len(SUMS), mean.shape[-1]))
        found[usable] = errors_of(
            units(image)[usable], of_mean[usable], truth[usable], scene_mean=scene_mean
        )
        sums.append(units.sum(found))
    return measures_of(np.stack(sums, axis=2), seed=0)
