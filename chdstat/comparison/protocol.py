"""Protocol: estimators side by side on the same batches, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel. Estimators that learn are
trained first, each on as many pixels as it asks for among those that do not judge. Which pixels
judge depends on the image and the seed alone, so that no row of the table depends on the other
estimators. Where no estimator was trained on an image of this size, all pixels judge.

`error_curve` does the same for many n: use it to see up to which size an estimator is worth it. The
error of an estimator with a constant bias stops falling.

Memory is bounded: one batch of the image, one estimate of it, and sums over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Seed, block_numbers, seed_number, whole
from chdstat._core.reasons import flag_attributes
from chdstat._core.work import in_order, track
from chdstat.comparison.entries import (
    Chosen,
    Denoised,
    Entry,
    choose,
    curve_sizes,
    estimate_by,
    takes,
    without_denoiser,
)
from chdstat.comparison.metrics import SUMS, counts, errors_of, measures_of, stacked
from chdstat.comparison.tables import Breakdown, Comparison, ErrorCurve
from chdstat.errors import InputError
from chdstat.estimators.estimates import check_denoiser
from chdstat.estimators.order import mean
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.registry import LearnedEstimator, Model, lookup
from chdstat.estimators.validation import Totals, check_spp, draw_pixels, judging_pixels
from chdstat.patterns import Label, classify
from chdstat.samples import ImageLike, Samples, check_equal_counts, samples_of

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

__all__ = ["Units", "compare", "error_curve"]

Given = Model | Mapping[str, Model] | None
"""A trained model, or several by the name of the estimator that they are trained for."""


def compare(
    samples: ImageLike | npt.ArrayLike,
    estimators: Sequence[str | Entry] | None = None,
    *,
    n: int = 32,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Given = None,
    denoise: bool = False,
    labels: npt.ArrayLike | xr.DataArray | xr.Dataset | str | None = None,
    progress: bool | None = None,
    client: Client | None = None,
) -> Comparison:
    r"""Measure estimators on the same batches of n samples, against held-out references.

    With p an estimate, y its reference, :math:`\bar x` the mean of its samples, and m the mean
    reference of the scene, the measures are, for each channel,

    - ``mse``: :math:`\overline{(p - y)^2}`, and ``mse_ratio``, over that of the sample mean;
    - ``relmse``: :math:`\overline{(p - y)^2 / (y^2 + 0.01\, m^2)}`, and ``relmse_ratio``;
    - ``improved``: the share with :math:`|p - y| < |\bar x - y|`; ``unchanged``: the share with
      :math:`p = \bar x` to six digits; what remains got worse;
    - ``bias``: :math:`\overline{p - y} / \bar y`;
    - ``fireflies``: the share with :math:`p - y > 3 \sqrt{y^2 + 0.01\, m^2}`, at least two stops
      too bright (a threshold of our own), and ``fireflies_left``, over that of the sample mean.

    The reference of a batch is the mean of the other samples of its pixel. It is itself noisy: its
    variance, about n/(spp - n) times that of a batch's mean, is part of every squared error, a
    share n/spp of that of the sample mean. Where all batches estimate, the errors of the sample
    mean cancel within each pixel: its bias is then 0 by construction.

    Parameters
    ----------
    samples
        The image, as `Samples`, an array (y, x, channel, sample) or the path of a store, at least
        2 n samples per pixel.
    estimators
        Names of registered estimators, alone or followed by " + OIDN" or " + OIDN features" for
        Open Image Denoise after them; or entries of your own. None takes those of
        `chdstat.comparison.DEFAULT_ESTIMATORS` that apply to the image and to n: the default
        estimate first, then the sample mean. An estimator that uses neighbours, as the default
        estimate does, is given the whole image of each batch with its first-hit features; it is
        marked, as it sees more than n samples of a pixel.
    n
        Samples per estimate.
    seed
        Draws training and bootstrap.
    max_batches
        Batches per pixel that estimate, in stored order; None takes all. All samples count for
        the reference.
    model
        A trained estimator to take in place of training the one of its name, or several by the
        name of the estimator that they are. Where one was trained on an image of the same size,
        its pixels do not judge.
    denoise
        Judge every estimator with Open Image Denoise after it, too: with the image alone, with
        first-hit features where there are any, and mixed with the estimate by its certainty where
        it has one.
    labels
        What to break the measures down by: ``label`` of `chdstat.classify` or the dataset itself,
        codes of `chdstat.patterns.Label`, shape (y, x), or any map with the attributes
        ``flag_values`` and ``flag_meanings``. "classify" labels these samples. A label that rests
        on the samples that are judged selects among them: a pixel may be firefly-dominated because
        of one batch, and is easy to improve there. Labels of an independent render do not.
    progress
        Show progress bars; None shows them on a terminal.
    client
        A Dask client, whose workers estimate, one batch a task, to the same bits; trainings are
        done here.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or does not take n samples; if there are too few
        samples; if labels do not fit the image; if Open Image Denoise is wanted and missing; if
        a model is given of an estimator that is not compared; or if no pixel is left to judge by.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(8, 8, 3, 128)))
    >>> found = chd.compare(samples, ["mean", "median_of_means"])
    >>> for row in found.table():
    ...     print(row["estimator"], round(row["mse_ratio"], 1), row["bias"] < -0.05)
    mean 1.0 False
    median_of_means 1.5 True
    """
    samples, seed = samples_of(samples), seed_number(seed)
    n, max_batches = whole("n", n, least=1), _limit(max_batches)
    chosen = choose(estimators, [n], samples=samples)
    check_spp(samples, n)
    if denoise:
        check_denoiser(samples.shape[2])  # before the training, not after
    codes, names = (None, {}) if labels is None else labels_of(labels, samples, progress=progress)
    found, left_out = _trained(
        chosen, samples, sizes=[n], seed=seed, model=model, progress=progress
    )
    found = found.with_denoised() if denoise else found
    units = found.test_units(seed, codes)
    errors = _judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
    sums, judged = errors.by_unit, counts(errors.by_unit) > 0
    blocks, block = np.unique(units.block, return_inverse=True)
    by_block = np.zeros((len(blocks), *sums.shape[1:]))
    np.add.at(by_block, block, sums)
    test = np.zeros(samples.shape[:2], bool)
    test[units.ys, units.xs] = True
    # float32 is what an image holds, and 1e30 squared is beyond it.
    with np.errstate(over="ignore"):
        squared = [np.square(p - errors.reference).astype(np.float32) for p in errors.estimates]
    breakdown = None
    if codes is not None:
        pixels = np.where(judged, units.sum(np.ones(len(units.ys), np.int64)), 0)
        seen = {code: units.label == code for code in np.unique(units.label[judged]).tolist()}
        breakdown = Breakdown(
            labels=tuple(names[code] for code in seen),
            estimators=tuple(found.entries),
            uses_neighbours=found.uses_neighbours,
            pixels=np.array([pixels[of_label].sum() for of_label in seen.values()]),
            measures=stacked([measures_of(sums[here], seed=seed) for here in seen.values()]),
        )
    return Comparison(
        estimators=tuple(found.entries),
        uses_neighbours=found.uses_neighbours,
        channels=samples.channels,
        measures=measures_of(by_block, seed=seed),
        over_batches=measures_of(errors.by_batch, seed=seed),
        estimates=errors.estimates,
        squared_error=np.stack(squared),
        first_mean=errors.mean,
        first_reference=errors.reference,
        reference=found.totals.mean(),
        test_pixels=test,
        n=n,
        batches=int(counts(sums).sum()),
        excluded=errors.excluded,
        breakdown=breakdown,
        models=found.models,
        provenance=_provenance(found, left_out, seed, max_batches),
    )


def error_curve(
    samples: ImageLike | npt.ArrayLike,
    estimators: Sequence[str | Entry] | None = None,
    *,
    sizes: Sequence[int] | None = None,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Given = None,
    progress: bool | None = None,
    client: Client | None = None,
) -> ErrorCurve:
    r"""Measure the error of estimators at many numbers of samples, N.

    At every N, batches of N samples estimate, and the mean of the other samples of the pixel is the
    reference, as in `chdstat.compare`. The variance of a sample is :math:`\sigma^2`; the sample
    mean shows :math:`\sigma^2 / N + \sigma^2 / (\text{spp} - N)`, of which the second part is the
    noise of the reference. It is N/spp of the whole, which is how it is known without knowing
    :math:`\sigma^2`; for relMSE, the same share is an approximation.

    Parameters
    ----------
    samples
        The image, as `compare` takes it, at least twice as many samples per pixel as the largest N.
    estimators
        As `compare` takes them. Where one does not take N samples, there is no number.
    sizes
        N, in any order; None doubles from 4 to an eighth of the samples, and adds the fewest that
        an estimator takes where these are none.
    seed, max_batches, model, progress, client
        As for `chdstat.compare`. Pixels that trained a model count at no N. Small batches are
        read one by one: `Samples.load` a store first.

    Returns
    -------
    ErrorCurve

    Raises
    ------
    InputError
        If `sizes` are not different whole numbers from 1, there are too few samples for them, an
        estimator takes none of them, or nothing is left to judge by.

    Examples
    --------
    The bias of a median stays, so that its error stops falling:

    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(16, 16, 1, 1024)))
    >>> curve = error_curve(samples, ["mean", "median"], sizes=[16, 128])
    >>> curve.measures["mse_ratio"].value.round()
    array([[ 1.,  2.],
           [ 1., 11.]])
    """
    samples, seed = samples_of(samples), seed_number(seed)
    check_equal_counts(samples)
    max_batches = _limit(max_batches)
    numbers = curve_sizes(samples, estimators, sizes=sizes)
    chosen = choose(estimators, numbers, samples=samples)
    found, left_out = _trained(
        chosen, samples, sizes=numbers, seed=seed, model=model, progress=progress
    )
    units = found.test_units(seed)
    parts, noise, judged = [], [], []
    for n in numbers:
        errors = _judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
        sums = errors.by_unit
        parts.append(measures_of(sums, seed=seed))
        judged.append(counts(sums).sum())
        # The reference adds the share N / spp of the sample mean's own error.
        of_mean = sums[:, :2, 0].sum(axis=0).mean(axis=-1) / judged[-1]
        noise.append(of_mean * (n / samples.spp))
    return ErrorCurve(
        estimators=tuple(found.entries),
        uses_neighbours=found.uses_neighbours,
        sizes=numbers,
        measures=stacked(parts),
        reference_noise=dict(zip(("mse", "relmse"), np.transpose(noise), strict=True)),
        batches=np.array(judged),
        test_pixels=len(units.ys),
        models=found.models,
        provenance=_provenance(found, left_out, seed, max_batches),
    )


def _limit(max_batches: int | None) -> int | None:
    return None if max_batches is None else whole("max_batches", max_batches, least=1)


def _provenance(
    found: Candidates, left_out: Mapping[str, str], seed: int, max_batches: int | None
) -> dict[str, Any]:
    """Return scene, samples and settings of a comparison, and what is known of the models."""
    return {
        "scene": found.samples.name,
        "samples": found.samples.attrs,
        "samples_shape": list(found.samples.shape),
        "seed": seed,
        "max_batches": max_batches,
        "left_out": left_out,
        "models": {n: getattr(model, "provenance", {}) for n, model in found.models.items()},
    }


# --- who estimates ------------------------------------------------------------------------------


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
        By name, in the order given.
    models
        Those that were trained, by name; entries that share a training share a model.
    at_home
        Those of the models that were trained on this scene, by name.
    """

    samples: Samples
    totals: Totals
    entries: Mapping[str, Entry]
    models: Mapping[str, Model]
    at_home: frozenset[str]

    @property
    def uses_neighbours(self) -> npt.NDArray[np.bool_]:
        """Which of them look at the pixels around, shape (estimator,)."""
        return np.array([entry.uses_neighbours for entry in self.entries.values()], bool)

    def with_denoised(self) -> Candidates:
        """Add every way to denoise each of them that the image and its model allow, at the end."""
        entries = dict(self.entries)
        guided = (False, True) if "albedo" in self.samples.features else (False,)
        for entry in self.entries.values():
            if not isinstance(entry, Denoised):
                certain = hasattr(self.models.get(entry.name), "estimate")
                for kept, guides in product((False, True) if certain else (False,), guided):
                    added = Denoised(entry, guides, kept)
                    entries.setdefault(added.name, added)
        return replace(self, entries=entries)

    def test_units(self, seed: int, labels: npt.NDArray[np.int64] | None = None) -> Units:
        """Return the pixels that judge: all where no model was trained on an image of this shape.

        Raises
        ------
        InputError
            If there are none.
        """
        shape = self.samples.shape[:2]
        seen = [_seen(model, shape) for model in self.models.values()]
        test = judging_pixels(shape, seed=seed) if any(map(len, seen)) else np.ones(shape, bool)
        for pixels in seen:
            test[tuple(pixels.T)] = False
        if not test.any():
            message = (
                "the models were trained on every pixel of this image; none is left to judge by"
            )
            raise InputError(message)
        return Units.of(test, labels)


def _trained(
    chosen: Chosen,
    samples: Samples,
    *,
    sizes: Sequence[int],
    seed: int,
    model: Given,
    progress: bool | None,
) -> tuple[Candidates, dict[str, str]]:
    """Train what learns, each on as many pixels as it wants, except for the models at hand.

    Returns
    -------
    tuple
        What can be compared, and why the default estimators that cannot are left out.

    Raises
    ------
    InputError
        If no sample is good, the denoiser is missing, a model is given that no estimator is, or an
        estimator needs what the image lacks.
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
        # An estimator that takes any number of samples is trained for the sizes it is judged at.
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
    return Candidates(samples, totals, entries, models, at_home), left_out


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


# --- what judges --------------------------------------------------------------------------------

_ACROSS = 8
"""Blocks along each side of the image."""


@dataclass(frozen=True)
class Units:
    """Pixels that judge, gathered into units: those of a label in a block of the image.

    Attributes
    ----------
    ys, xs
        The pixels, unit by unit, shape (pixel,).
    starts
        Where each unit begins, shape (unit,).
    label, block
        Of each unit, shape (unit,).
    """

    ys: npt.NDArray[np.intp]
    xs: npt.NDArray[np.intp]
    starts: npt.NDArray[np.intp]
    label: npt.NDArray[np.int64]
    block: npt.NDArray[np.int64]

    @classmethod
    def of(cls, test: npt.NDArray[np.bool_], labels: npt.NDArray[np.int64] | None = None) -> Units:
        """Gather the pixels of `test`, in 8 x 8 blocks of the image."""
        ys, xs = np.nonzero(test)
        label = np.zeros(len(ys), np.int64) if labels is None else labels[ys, xs]
        block = block_numbers(*test.shape, across=_ACROSS)[ys, xs]
        order = np.lexsort((block, label))
        label, block = label[order], block[order]
        new = (np.diff(label, prepend=-1) != 0) | (np.diff(block, prepend=-1) != 0)
        starts = np.flatnonzero(new)
        return cls(ys[order], xs[order], starts, label[starts], block[starts])

    def __call__(self, image: Array) -> Array:
        """Return an image's values at the pixels, shape (pixel, ...)."""
        return np.asarray(image[self.ys, self.xs])

    def sum(self, values: Array) -> Array:
        """Add up values (pixel, ...) within each unit."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))


def labels_of(
    given: npt.ArrayLike | xr.DataArray | xr.Dataset | str,
    samples: Samples,
    *,
    progress: bool | None = None,
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
        If it is neither, has another shape, or holds codes without a name.
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
    values = np.atleast_1d(flags["flag_values"]).tolist()
    names = dict(zip(values, flags["flag_meanings"].split(), strict=True))
    unknown = set(np.unique(codes).tolist()) - set(names)
    if unknown:
        message = f"labels must be among {names}, got {sorted(unknown)} too"
        raise InputError(message)
    return codes.astype(np.int64), names


@dataclass(frozen=True)
class _Errors:
    """What many estimators did on the same batches.

    Attributes
    ----------
    by_unit, by_batch
        Sums, see `measures_of`: over batches, one row a unit of pixels, and over pixels, one row a
        batch; NaN for estimators that do not take so many samples.
    excluded
        Batches of test pixels without a reference.
    estimates
        Of the whole image from the first batch, of those that take as many, shape (estimator, y, x,
        channel).
    mean, reference
        Of the first batch and of all other samples, shape (y, x, channel).
    """

    by_unit: npt.NDArray[np.float64]
    by_batch: npt.NDArray[np.float64]
    excluded: int
    estimates: npt.NDArray[np.float32]
    mean: npt.NDArray[np.float32]
    reference: npt.NDArray[np.float64]


def _judge(
    candidates: Candidates,
    units: Units,
    *,
    n: int,
    limit: int | None,
    progress: bool | None,
    client: Client | None,
) -> _Errors:
    """Let every estimator that takes n samples estimate from the same batches; add up its errors.

    The image is read with n samples at a time and estimated by one estimator at a time; with a
    client, each of its workers does so with a batch of its own.

    Raises
    ------
    InputError
        If an estimator returns another shape, or no batch has a reference.
    """
    samples = candidates.samples
    height, width, channels, spp = samples.shape
    rounds = spp // n if limit is None else min(limit, spp // n)
    sums = len(SUMS), 1 + len(candidates.entries), channels
    by_unit, by_batch = np.zeros((len(units.starts), *sums)), np.zeros((rounds, *sums))
    excluded = 0
    parts = (samples.isel(sample=slice(k * n, (k + 1) * n)) for k in range(rounds))
    # What travels to workers with every batch holds no samples of others.
    light = replace(candidates, samples=samples.isel(sample=slice(1)))
    task = partial(_errors_of_batch, light, units, n)
    with track(f"comparing at N = {n}", rounds * height * width, unit="px", show=progress) as told:
        results = in_order(task, enumerate(parts), workers=1, client=client)
        for index, (of_batch, without, images, reference) in enumerate(results):
            if index == 0:
                (first_mean, *estimates), first_reference = images, reference
            by_unit += of_batch
            by_batch[index] = of_batch.sum(axis=0)
            excluded += without
            told(height * width)
    if not counts(by_unit).any():
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    shown = np.stack(estimates), first_mean, first_reference
    return _Errors(by_unit, by_batch, excluded, *shown)


def _errors_of_batch(
    candidates: Candidates, units: Units, n: int, batch: tuple[int, Samples]
) -> tuple[Array, int, list[npt.NDArray[np.float32]], Array]:
    """Let every estimator that takes n samples estimate from one batch, given with its number.

    Returns
    -------
    tuple
        Sums over each unit, the number of test pixels without a reference, the images of the
        estimates (of the first batch alone), and the reference.
    """
    number, x = batch[0], batch[1].read()
    totals, features = candidates.totals, candidates.samples.features
    scene_mean = totals.mean()[totals.count > 0].mean(axis=0)
    average, reference = mean(x), totals.mean_without(x)
    truth, of_mean = units(reference), units(average)
    usable = np.asarray(np.isfinite(truth).all(axis=-1))
    entries = [None, *candidates.entries.values()]  # the sample mean, and the estimators
    sums = np.full((len(units.starts), len(SUMS), len(entries), average.shape[-1]), np.nan)
    estimates = []
    for k, entry in enumerate(entries):
        estimate = average
        if entry is not None:
            if not takes(entry, n):
                continue
            own = without_denoiser(entry).name
            estimate = estimate_by(
                entry,
                x,
                features=features,
                model=candidates.models.get(own),
                at_home=own in candidates.at_home,
            )
            if estimate.shape != average.shape:
                message = (
                    f"{entry.name} must return one estimate for each pixel and channel, shape "
                    f"{average.shape}, got {estimate.shape}"
                )
                raise InputError(message)
        found = np.zeros((len(usable), *sums.shape[1::2]))
        found[usable] = errors_of(
            units(estimate)[usable], of_mean[usable], truth[usable], scene_mean=scene_mean
        )
        sums[:, :, k] = units.sum(found)
        if number == 0:
            estimates.append(estimate.astype(np.float32))
    return sums, int((~usable).sum()), estimates, reference
