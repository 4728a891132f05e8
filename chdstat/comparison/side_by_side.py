"""Comparison of estimators on the same samples, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel. Estimators that learn are
trained first, each on as many pixels as it wants of those that do not judge. Which pixels judge
depends on the image and the seed alone, so that no row of the table depends on who else is in it;
only where nobody was trained on an image of this size, all pixels judge. `error_curve` in
`chdstat.comparison.curves` does the same for many n.

`labels_of` names the pixels by which a comparison is broken down.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat._core.reasons import flag_attributes
from chdstat.comparison.accumulate import MEASURES, ErrorAccumulator, Units, judge, stack_intervals
from chdstat.comparison.candidates import DEFAULT, Candidates, Entry, Given, resolve, totals_of
from chdstat.comparison.tables import Breakdown, Comparison
from chdstat.errors import InputError
from chdstat.estimators.denoising import check_denoiser
from chdstat.estimators.validation import Totals, check_spp
from chdstat.patterns import Label, classify
from chdstat.samples import Image, Samples, samples_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["GivenLabels", "Labels", "compare", "labels_of"]

GivenLabels = npt.ArrayLike | Literal["classify"] | None
"""Codes (y, x), a labelled map or dataset of `chdstat.classify`, or the order to classify."""


@dataclass(frozen=True)
class Labels:
    """Codes of pixels and what they mean.

    Attributes
    ----------
    codes
        Shape (y, x).
    names
        By code.
    """

    codes: npt.NDArray[np.int64]
    names: dict[int, str]


def labels_of(given: Any, samples: Samples, *, progress: bool | None = None) -> Labels | None:
    """Return the labels of an image; None stays None.

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
    if given is None:
        return None
    if isinstance(given, str):
        if given != "classify":
            message = f"labels must be a map of labels or 'classify', got {given!r}"
            raise InputError(message)
        given = classify(samples, progress=progress)
    if hasattr(given, "data_vars"):
        given = _label_of(given)
    codes = np.asarray(given)
    if codes.shape != samples.shape[:2] or codes.dtype.kind not in "iu":
        message = (
            f"labels must be integers of shape {samples.shape[:2]}, one for each pixel; "
            f"got {codes.dtype} of shape {codes.shape}"
        )
        raise InputError(message)
    return _checked(codes.astype(np.int64), _names(getattr(given, "attrs", {})))


def _label_of(dataset: Any) -> Any:
    if "label" not in dataset:
        message = f"a dataset of labels has a variable 'label'; this one has {list(dataset)}"
        raise InputError(message)
    return dataset["label"]


def _names(attrs: dict[str, Any]) -> dict[int, str]:
    flags = attrs if "flag_meanings" in attrs else flag_attributes(Label)
    values = np.atleast_1d(flags["flag_values"]).tolist()
    return dict(zip(values, flags["flag_meanings"].split(), strict=True))


def _checked(codes: npt.NDArray[np.int64], names: dict[int, str]) -> Labels:
    unknown = set(np.unique(codes).tolist()) - set(names)
    if unknown:
        message = f"labels must be among {names}, got {sorted(unknown)} too"
        raise InputError(message)
    return Labels(codes, names)


def compare(
    samples: Image | npt.ArrayLike,
    estimators: Sequence[str | Entry] = DEFAULT,
    *,
    n: int = 32,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Given = None,
    denoise: bool = False,
    labels: npt.ArrayLike | xr.DataArray | xr.Dataset | str | None = None,
    progress: bool | None = None,
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
        Names of registered estimators, or entries of your own, such as `denoised` returns. Those
        that use neighbours come last in the result, and are marked: they see more than n samples.
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
        first-hit features where there are any, and mixed with the estimate as far as it says how
        certain it is.
    labels
        What to break the measures down by: ``label`` of `chdstat.classify` or the dataset itself,
        codes of `chdstat.patterns.Label`, shape (y, x), or any map with the attributes
        ``flag_values`` and ``flag_meanings``. "classify" labels these samples. A label that rests
        on the samples that are judged selects among them: a pixel may be firefly-dominated because
        of one batch, and is easy to improve there. Labels of an independent render do not.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or does not take n samples; if there are too few
        samples; if labels do not fit the image; if Open Image Denoise is wanted and missing; if
        a model is given that nobody asked for; or if no pixel is left to judge by.

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
    n = whole("n", n, least=1)
    if max_batches is not None:
        max_batches = whole("max_batches", max_batches, least=1)
    entries = resolve(estimators, [n])
    check_spp(samples, n)
    if denoise:
        check_denoiser(samples)  # before the training, not after
    totals = totals_of(samples)
    named = labels_of(labels, samples, progress=progress)
    candidates = Candidates.of(
        entries, samples, sizes=[n], seed=seed, model=model, progress=progress
    )
    candidates = candidates.with_denoised() if denoise else candidates
    functions = candidates.taking(n)
    test = candidates.test_pixels(samples.shape[:2])
    units = Units.of(test, None if named is None else named.codes)
    errors = judge(functions, samples, totals, units, n=n, limit=max_batches, progress=progress)
    if errors.by_unit.count.sum() == 0:
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    return _comparison(
        samples,
        candidates,
        totals=totals,
        test=test,
        errors=errors,
        breakdown=None if named is None else _breakdown(named, units, errors, candidates, seed),
        n=n,
        settings={"seed": seed, "max_batches": max_batches},
    )


def _comparison(
    samples: Samples,
    candidates: Candidates,
    *,
    totals: Totals,
    test: npt.NDArray[np.bool_],
    errors: ErrorAccumulator,
    breakdown: Breakdown | None,
    n: int,
    settings: Mapping[str, Any],
) -> Comparison:
    images = errors.images
    if images is None:
        message = "a comparison needs the images of its first batch"
        raise InputError(message)
    return Comparison(
        estimators=candidates.names,
        uses_neighbours=candidates.uses_neighbours,
        channels=samples.channels,
        measures=errors.by_block.measures(seed=settings["seed"]),
        over_batches=errors.by_batch.measures(seed=settings["seed"]),
        estimates=images.estimates,
        squared_error=images.squared_error,
        first_mean=images.mean,
        first_reference=images.reference,
        reference=totals.mean(),
        test_pixels=test,
        n=n,
        batches=int(errors.by_unit.count.sum()),
        excluded=errors.excluded,
        breakdown=breakdown,
        models=candidates.models,
        provenance={
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            **settings,
            "models": candidates.provenance,
        },
    )


def _breakdown(
    named: Labels, units: Units, errors: ErrorAccumulator, candidates: Candidates, seed: int
) -> Breakdown:
    """Measure the pixels of each label separately."""
    judged = errors.by_unit.count > 0
    codes = np.unique(units.label[judged])
    parts = [errors.by_unit[units.label == code].measures(seed=seed) for code in codes]
    return Breakdown(
        labels=tuple(named.names[code] for code in codes.tolist()),
        estimators=candidates.names,
        uses_neighbours=candidates.uses_neighbours,
        pixels=np.array([units.pixels[judged & (units.label == code)].sum() for code in codes]),
        measures={
            name: stack_intervals([part[name][:, -1] for part in parts]) for name in MEASURES
        },
    )
