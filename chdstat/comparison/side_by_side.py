"""Side by side: estimators on the same samples, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel. Estimators that learn are
trained first; the pixels that they saw do not count, for none of the estimators. `error_curve` in
`chdstat.comparison.curves` does the same for many n.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import whole
from chdstat.comparison._contestants import Contestants, Given, totals_of
from chdstat.comparison._cost import Cost, measure_cost
from chdstat.comparison._entries import DEFAULT, Entry, resolve
from chdstat.comparison._labels import Labels, labels_of
from chdstat.comparison._sums import MEASURES, stack_intervals
from chdstat.comparison._tally import Directed, Tally, Units, asked, judge
from chdstat.comparison._trainings import spread_over_trainings
from chdstat.comparison.denoising import check_denoiser
from chdstat.comparison.parts import Breakdown
from chdstat.comparison.results import Comparison
from chdstat.errors import InputError
from chdstat.estimators.heldout import Totals, check_spp, direct_of
from chdstat.samples import Samples, checked

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["compare"]

_COST_PIXELS = 64 * 64
"""Pixels that time and memory are measured on, about: enough to fill every chunk."""


def compare(
    samples: Samples,
    estimators: Sequence[str | Entry] = DEFAULT,
    *,
    n: int = 32,
    seed: int = 0,
    max_batches: int | None = 16,
    model: Given = None,
    training_seeds: int = 1,
    denoise: bool = False,
    labels: npt.ArrayLike | xr.DataArray | xr.Dataset | str | None = None,
    cost: bool = True,
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
      too bright (a threshold of our own), and ``fireflies_left``, over that of the sample mean;
    - ``time`` and ``peak_memory`` of an estimate.

    The reference of a batch is the mean of the other samples of its pixel. It is itself noisy: its
    variance, about n/(spp - n) times that of a batch's mean, is part of every squared error, a
    share n/spp of that of the sample mean. Where all batches estimate, the errors of the sample
    mean cancel within each pixel: its bias is then 0 by construction.

    Parameters
    ----------
    samples
        The picture, at least 2 n samples per pixel.
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
        name of the estimator that they are. Where one was trained on a picture of the same size,
        its pixels do not count.
    training_seeds
        How often those that learn are trained: with the seeds `seed`, ``seed + 1``, ..., on the
        same pixels. The measures are those of the first training; with more than one, their
        standard deviation over the trainings stands beside them. Only the first models are kept.
    denoise
        Judge every estimator with Open Image Denoise after it, too: with the picture alone, with
        first-hit features where there are any, and mixed with the estimate as far as it says how
        certain it is.
    labels
        What to break the measures down by: ``label`` of `chdstat.classify` or the dataset itself,
        codes of `chdstat.patterns.Label`, shape (y, x), or any map with the attributes
        ``flag_values`` and ``flag_meanings``. "classify" labels these samples. A label that rests
        on the samples that are judged selects among them: a pixel may be firefly-dominated because
        of one batch, and is easy to improve there. Labels of an independent render do not.
    cost
        Measure time and memory, by three more calls of every estimator on a part of the picture.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or does not take n samples; if there are too few
        samples; if labels do not fit the picture; if Open Image Denoise is wanted and missing; if
        a model is given that nobody asked for, or to be trained with several seeds; or if no pixel
        is left to judge by.

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
    checked(samples)
    n, training_seeds = whole("n", n, least=1), whole("training_seeds", training_seeds, least=1)
    if max_batches is not None:
        max_batches = whole("max_batches", max_batches, least=1)
    if model is not None and training_seeds > 1:
        message = f"training_seeds={training_seeds} trains anew; give no model with it"
        raise InputError(message)
    entries = resolve(estimators, [n])
    check_spp(samples, n)
    if denoise:
        check_denoiser(samples)  # before the training, not after
    totals = totals_of(samples)
    named = labels_of(labels, samples, progress=progress)
    contestants = Contestants.of(
        entries, samples, sizes=[n], seed=seed, model=model, progress=progress
    )
    contestants = contestants.with_denoised() if denoise else contestants
    functions = contestants.taking(n)
    test = contestants.test_pixels(samples.shape[:2])
    units = Units.of(test, None if named is None else named.codes)
    tally = judge(functions, samples, totals, units, n=n, limit=max_batches, progress=progress)
    if tally.by_unit.count.sum() == 0:
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    over_trainings = spread_over_trainings(
        contestants,
        tally,
        samples,
        totals,
        units,
        n=n,
        seeds=range(seed + 1, seed + training_seeds),
        limit=max_batches,
        progress=progress,
    )
    return _comparison(
        samples,
        contestants,
        totals=totals,
        test=test,
        tally=tally,
        over_trainings=over_trainings,
        breakdown=None if named is None else _breakdown(named, units, tally, contestants, seed),
        cost=_costs(contestants, samples, n) if cost else {},
        n=n,
        settings={"seed": seed, "max_batches": max_batches, "training_seeds": training_seeds},
    )


def _comparison(
    samples: Samples,
    contestants: Contestants,
    *,
    totals: Totals,
    test: npt.NDArray[np.bool_],
    tally: Tally,
    over_trainings: Mapping[str, npt.NDArray[np.float64]],
    breakdown: Breakdown | None,
    cost: Mapping[str, Cost],
    n: int,
    settings: Mapping[str, Any],
) -> Comparison:
    pictures = tally.pictures
    if pictures is None:
        message = "a comparison needs the pictures of its first batch"
        raise InputError(message)
    return Comparison(
        estimators=contestants.names,
        uses_neighbours=contestants.uses_neighbours,
        channels=samples.channels,
        measures=tally.by_block.measures(seed=settings["seed"]),
        over_batches=tally.by_batch.measures(seed=settings["seed"]),
        over_trainings=over_trainings,
        cost=cost,
        estimates=pictures.estimates,
        squared_error=pictures.squared_error,
        first_mean=pictures.mean,
        first_reference=pictures.reference,
        reference=totals.mean(),
        test_pixels=test,
        n=n,
        batches=int(tally.by_unit.count.sum()),
        excluded=tally.excluded,
        breakdown=breakdown,
        models=contestants.models,
        provenance={
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            **settings,
            "models": contestants.provenance,
        },
    )


def _breakdown(
    named: Labels, units: Units, tally: Tally, contestants: Contestants, seed: int
) -> Breakdown:
    """Measure the pixels of each label apart."""
    judged = tally.by_unit.count > 0
    codes = np.unique(units.label[judged])
    parts = [tally.by_unit[units.label == code].measures(seed=seed) for code in codes]
    return Breakdown(
        labels=tuple(named.names[code] for code in codes.tolist()),
        estimators=contestants.names,
        uses_neighbours=contestants.uses_neighbours,
        pixels=np.array([units.pixels[judged & (units.label == code)].sum() for code in codes]),
        measures={
            name: stack_intervals([part[name][:, -1] for part in parts]) for name in MEASURES
        },
    )


def _costs(contestants: Contestants, samples: Samples, n: int) -> dict[str, Cost]:
    """Measure time and memory on the first rows of the picture."""
    width: Any = samples.shape[1]
    ys = slice(0, -(-_COST_PIXELS // width))
    rows = samples.read(ys, ss=slice(0, n))
    functions = contestants.taking(n, ys=ys)
    direct = None
    if any(isinstance(function, Directed) for function in functions.values()):
        direct = direct_of(samples).read(ys, ss=slice(0, n))
    return {
        name: measure_cost(partial(asked, function, direct), rows)
        for name, function in functions.items()
    }
