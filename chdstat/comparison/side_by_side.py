"""Comparison of estimators on the same samples, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel. Estimators that learn are
trained first, each on as many pixels as it wants of those that do not judge. Which pixels judge
depends on the image and the seed alone, so that no row of the table depends on the other
estimators; only where none was trained on an image of this size, all pixels judge.

`error_curve` does the same for many n: use it to see up to which size an estimator pays. Where it
has a bias that does not fall, its error does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Seed, seed_number, whole
from chdstat.comparison.accumulate import Units, counts, judge, labels_of, measures_of, stacked
from chdstat.comparison.candidates import Candidates, Entry, Given, choose, curve_sizes
from chdstat.comparison.tables import Breakdown, Comparison, ErrorCurve
from chdstat.estimators.estimates import check_denoiser
from chdstat.estimators.validation import check_spp
from chdstat.samples import ImageLike, check_equal_counts, samples_of

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

__all__ = ["compare", "error_curve"]


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
        Open ImageLike Denoise after them; or entries of your own. None takes those of
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
        Judge every estimator with Open ImageLike Denoise after it, too: with the image alone, with
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
        samples; if labels do not fit the image; if Open ImageLike Denoise is wanted and missing; if
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
    n, max_batches = whole("n", n, least=1), _limit(max_batches)
    chosen = choose(estimators, [n], samples=samples)
    check_spp(samples, n)
    if denoise:
        check_denoiser(samples.shape[2])  # before the training, not after
    codes, names = (None, {}) if labels is None else labels_of(labels, samples, progress=progress)
    found = Candidates.of(chosen, samples, sizes=[n], seed=seed, model=model, progress=progress)
    found = found.with_denoised() if denoise else found
    test = found.test_pixels()
    units = Units.of(test, codes)
    errors = judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
    # float32 is what an image holds, and 1e30 squared is beyond it.
    with np.errstate(over="ignore"):
        squared = [np.square(p - errors.reference).astype(np.float32) for p in errors.estimates]
    return Comparison(
        estimators=tuple(found.entries),
        uses_neighbours=found.uses_neighbours,
        channels=samples.channels,
        measures=measures_of(errors.by_block, seed=seed),
        over_batches=measures_of(errors.by_batch, seed=seed),
        estimates=errors.estimates,
        squared_error=np.stack(squared),
        first_mean=errors.mean,
        first_reference=errors.reference,
        reference=found.totals.mean(),
        test_pixels=test,
        n=n,
        batches=int(counts(errors.by_unit).sum()),
        excluded=errors.excluded,
        breakdown=None if codes is None else _breakdown(names, units, errors.by_unit, found, seed),
        models=found.models,
        provenance=found.provenance(seed=seed, max_batches=max_batches),
    )


def _breakdown(
    names: Mapping[int, str], units: Units, sums: Array, candidates: Candidates, seed: int
) -> Breakdown:
    """Measure the pixels of each label separately."""
    judged = counts(sums) > 0
    codes = np.unique(units.label[judged])
    parts = [measures_of(sums[units.label == code], seed=seed) for code in codes]
    pixels = np.where(judged, units.sum(np.ones(len(units.ys), np.int64)), 0)
    return Breakdown(
        labels=tuple(names[code] for code in codes.tolist()),
        estimators=tuple(candidates.entries),
        uses_neighbours=candidates.uses_neighbours,
        pixels=np.array([pixels[units.label == code].sum() for code in codes]),
        measures=stacked(parts),
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
    found = Candidates.of(chosen, samples, sizes=numbers, seed=seed, model=model, progress=progress)
    units = Units.of(found.test_pixels())
    parts, noise, judged = [], [], []
    for n in numbers:
        errors = judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
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
        provenance=found.provenance(seed=seed, max_batches=max_batches),
    )


def _limit(max_batches: int | None) -> int | None:
    return None if max_batches is None else whole("max_batches", max_batches, least=1)
