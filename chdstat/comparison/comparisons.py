"""Comparisons: estimators side by side on the same batches, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and compares the estimate with all *other* samples of the pixel
(`chdstat.comparison.judging`). Its `Comparison` holds all measures with intervals, a `Breakdown`
holds them by pattern, and `PixelEstimates` holds a few pixels one by one. `error_curve` does so for
many n, and returns an `ErrorCurve`: use it to see up to how many samples an estimator pays, as with
a constant bias its error stops falling.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Seed, generator, plain, seed_number, whole
from chdstat._core.display import Card, Shown, Tabled, Width, png
from chdstat._core.doors import draw
from chdstat._core.image_scales import tonemap
from chdstat._core.resampling import Interval
from chdstat.comparison.estimator_choice import Entry, choose, curve_sizes, notes
from chdstat.comparison.judges import Judge, check_samples_for_judge
from chdstat.comparison.judging import (
    Models,
    judge,
    labels_of,
    trained_candidates,
)
from chdstat.comparison.metrics import (
    Columns,
    columns_of,
    described,
    legend,
    ranked,
    stacked,
    titled,
)
from chdstat.errors import InputError, check_option
from chdstat.estimators.estimates import check_denoiser
from chdstat.estimators.registry import Model
from chdstat.samples import ImageLike, Samples, is_store, samples_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from distributed import Client
    from matplotlib.figure import Figure

_ALL_CHANNELS = -1
"""Index of the average over channels on the channel axis of a measure."""


@dataclass(frozen=True, repr=False)
class PixelEstimates(Shown):
    """Estimates of a few pixels that trained no estimator, from one batch each.

    Attributes
    ----------
    pixels
        Rows (y, x), from dark to bright, shape (pixel, 2).
    estimators, channels
        Names of the estimators and of the channels.
    reference
        Mean of all other samples, radiance, shape (pixel, channel).
    mean
        Sample mean of the batch, radiance, shape (pixel, channel).
    estimates
        Radiance, shape (estimator, pixel, channel).
    n
        Samples per estimate.
    """

    pixels: npt.NDArray[np.int64]
    estimators: tuple[str, ...]
    channels: tuple[str, ...]
    reference: npt.NDArray[np.float64]
    mean: npt.NDArray[np.float32]
    estimates: npt.NDArray[np.float32]
    n: int

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw the pixels one by one, as `chdstat.viz.pixel_estimates` does."""
        return draw(self, channels=channels, width=width, fig=fig)


@dataclass(frozen=True, repr=False, kw_only=True)
class _Scores(Tabled):
    """Measures of estimators, with intervals.

    Attributes
    ----------
    estimators
        Names of the estimators, in the given order.
    uses_neighbours
        Whether an estimator uses the pixels around, shape (estimator,).
    measures
        By the names of `chdstat.comparison.MEASURES`; `_rows` says what their axes are.
    """

    _title: ClassVar[str]
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    measures: Mapping[str, Interval[Array]]

    def _rows(self) -> Iterator[tuple[dict[str, Any], Any]]:
        """Yield what rows of a table begin with, and the place of their measures (estimator,)."""
        raise NotImplementedError

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each estimator, with every measure, in the given order.

        `to_dataframe` has what one reads of it, ranked. ``estimator`` is the name that one types;
        the columns ``<measure>_se``, ``_low`` and ``_high`` are the standard error and the interval
        over blocks; NaN where the reference cannot tell.
        """
        columns = columns_of(self.measures)
        return [
            {**lead, "estimator": name, "uses_neighbours": bool(self.uses_neighbours[k])}
            | {column: float(values[place][k]) for column, (values, _) in columns.items()}
            for lead, place in self._rows()
            for k, name in enumerate(self.estimators)
        ]

    @property
    def marks(self) -> dict[str, str]:
        """What the signs in the table mean, by sign."""
        return legend(text for row in titled(self.table()) for text in row.values())

    def to_dataframe(self) -> pd.DataFrame:
        """Return what one reads as a `pandas.DataFrame`: the smallest error first.

        Rows are ranked by relMSE over that of the sample mean. ``estimator`` is the title of each,
        and ``name`` what one types. Ratios to the mean's errors have 95 % intervals, ``_low`` to
        ``_high``; `table` has every measure.
        """
        return super().to_dataframe()

    def _shown_rows(self) -> list[dict[str, Any]]:
        return ranked(self.table())

    def _card(self) -> Card:
        return Card(self._title, self.marks, titled(self.table()))

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw the measures, as `chdstat.viz` does."""
        return draw(self, width=width, fig=fig)


@dataclass(frozen=True, repr=False, kw_only=True)
class Breakdown(_Scores):
    """The measures by label, averaged over channels: which estimator suits which pattern.

    Attributes
    ----------
    estimators, uses_neighbours
        As in a `Comparison`.
    measures
        By the names of `MEASURES`: intervals over blocks, shape (label, estimator).
    labels
        Names of the labels that occur among the judging pixels.
    pixels
        Number of judging pixels with each label, shape (label,).
    """

    _title = "Breakdown by pattern"
    _drawn = "relMSE over that of the mean"
    labels: tuple[str, ...]
    pixels: npt.NDArray[np.int64]

    def _rows(self) -> Iterator[tuple[dict[str, Any], int]]:
        for row, label in enumerate(self.labels):
            yield {"label": label, "pixels": int(self.pixels[row])}, row

    def best(self, measure: str = "relmse", *, neighbours: bool = False) -> tuple[str, ...]:
        """Return the estimator with the smallest error for each label; '' if there is none.

        Parameters
        ----------
        measure
            "mse" or "relmse".
        neighbours
            Whether to include estimators that use the pixels around.

        Raises
        ------
        InputError
            If the measure is neither of these.
        """
        check_option("measure", measure, ("mse", "relmse"))
        value = self.measures[measure].value
        errors = np.where(np.isfinite(value) & (neighbours | ~self.uses_neighbours), value, np.inf)
        return tuple(
            self.estimators[row.argmin()] if np.isfinite(row).any() else "" for row in errors
        )


@dataclass(frozen=True, repr=False, kw_only=True)
class ErrorCurve(_Scores):
    """Result of `error_curve`.

    Attributes
    ----------
    estimators, uses_neighbours, models, provenance
        As in a `Comparison`.
    measures
        By the names of `MEASURES`: intervals over blocks, averaged over channels, shape (size,
        estimator); NaN where an estimator does not take so many samples.
    sizes
        Samples per estimate, ascending.
    batches
        Number of estimates that count, over all test pixels, shape (size,).
    test_pixels
        Number of test pixels.
    """

    _title = "Error curve"
    _drawn = "errors against the number of samples"
    sizes: tuple[int, ...]
    batches: npt.NDArray[np.int64]
    test_pixels: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def _rows(self) -> Iterator[tuple[dict[str, Any], int]]:
        for row, size in enumerate(self.sizes):
            yield {"n": size}, row

    def table(self) -> list[dict[str, Any]]:
        """Return one row per size and estimator that takes it, with every measure."""
        return [row for row in super().table() if np.isfinite(row["mse"])]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        names = "sizes", "batches", "test_pixels", "provenance"
        found: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return found | super().to_dict()


@dataclass(frozen=True, repr=False, kw_only=True)
class Comparison(_Scores):
    """Result of `compare`: all measures, estimates and trained models.

    Attributes
    ----------
    estimators
        Names of the estimators, in the given order.
    uses_neighbours
        Whether an estimator uses the pixels around, shape (estimator,). Such estimators see more
        than n samples, so they are a separate class.
    channels
        Names of the channels.
    measures
        By the names of `MEASURES`: intervals over 8 x 8 blocks of pixels, shape (estimator, channel
        + 1), with the average over channels last. They show how much the measure varies over the
        image.
    estimates
        One estimate of the whole image from its first n samples, radiance, float32, shape
        (estimator, y, x, channel).
    first_mean
        Mean of the first n samples, radiance, shape (y, x, channel).
    first_reference
        What all other samples tell of the true radiance: their ``mean``, shape (y, x, channel), NaN
        where the first n samples hold a bad one; and errors of `estimates` without its noise, by
        ``squared`` and ``relative``.
    reference
        Mean of all good samples, radiance, shape (y, x, channel).
    test_pixels
        True for the judging pixels, which trained no estimator, shape (y, x).
    n
        Samples per estimate.
    batches
        Number of estimates that count, over all test pixels.
    excluded
        Number of estimates of test pixels that were left out because of a bad sample.
    breakdown
        The measures by label; None without labels.
    models
        Trained estimators by name.
    provenance
        Scene, samples, seed and settings, ready for JSON.
    """

    _title = "Comparison of estimators"
    channels: tuple[str, ...]
    estimates: npt.NDArray[np.float32]
    first_mean: npt.NDArray[np.float32]
    first_reference: Judge
    reference: npt.NDArray[np.float64]
    test_pixels: npt.NDArray[np.bool_]
    n: int
    batches: int
    excluded: int
    breakdown: Breakdown | None
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    @property
    def notes(self) -> dict[str, str]:
        """Notes for a reader of the table.

        They say what the default estimate is, which estimators use neighbours, and which of
        `chdstat.comparison.DEFAULT_ESTIMATORS` were left out, and why.
        """
        left_out = self.provenance.get("left_out", {})
        found = notes(self.estimators, uses_neighbours=self.uses_neighbours, left_out=left_out)
        return found | self.marks

    @property
    def reusable_models(self) -> dict[str, Model]:
        """Models that take exactly n samples, which another comparison can reuse.

        Models that take any number of samples were trained for n; train them anew for other
        numbers.
        """
        return {
            name: model
            for name, model in self.models.items()
            if isinstance(getattr(model, "inputs", None), int)
        }

    def _rows(self) -> Iterator[tuple[dict[str, Any], Any]]:
        yield {}, (slice(None), _ALL_CHANNELS)

    def _card(self) -> Card:
        pixels = f"{self.test_pixels.sum()} test pixels"
        facts = {"estimates": f"{self.batches} from {self.n} samples each, of {pixels}"}
        images = {}
        if len(self.channels) in (1, 3):
            images["reference: the mean of all samples"] = png(tonemap(self.reference))
        facts |= {name: text for name, text in self.notes.items() if name != "use neighbours"}
        return replace(super()._card(), facts=facts, images=images)

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw all measures of all estimators, as `chdstat.viz.estimator_measures` does."""
        return draw(self, channels=channels, width=width, fig=fig)

    def draw_pixels(self, count: int = 25, *, seed: int = 0) -> PixelEstimates:
        """Choose judging pixels at random, with their estimates.

        Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte Carlo
        variance reduction", show 25 such pixels.

        Parameters
        ----------
        count
            Number of pixels; fewer if fewer have a reference.
        seed
            Seed of the random choice.

        Raises
        ------
        InputError
            If `count` is not an integer from 1.
        """
        whole("count", count, least=1)
        reference = self.first_reference.mean
        usable = self.test_pixels & np.isfinite(reference).all(axis=-1)
        pixels = np.argwhere(usable)
        drawn = pixels[generator(seed).permutation(len(pixels))[:count]]
        brightness = reference[tuple(drawn.T)].sum(axis=-1)
        drawn = drawn[np.argsort(brightness, kind="stable")]
        ys, xs = drawn.T
        return PixelEstimates(
            pixels=drawn,
            estimators=self.estimators,
            channels=self.channels,
            reference=reference[ys, xs],
            mean=self.first_mean[ys, xs],
            estimates=self.estimates[:, ys, xs],
            n=self.n,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return measures, also by channel and by label, and provenance, ready for JSON.

        NaN becomes None.
        """
        per_channel = {
            name: {
                measure: dict(zip(self.channels, values.value[index], strict=False))
                for measure, values in self.measures.items()
            }
            for index, name in enumerate(self.estimators)
        }
        found: dict[str, Any] = plain(
            {
                "n": self.n,
                "batches": self.batches,
                "excluded": self.excluded,
                "test_pixels": self.test_pixels.sum(),
                "table": self.table(),
                "per_channel": per_channel,
                "per_label": [] if self.breakdown is None else self.breakdown.table(),
                "provenance": self.provenance,
            }
        )
        return found

    def to_dataset(self) -> xr.Dataset:
        """Return measures and images with named dims.

        Measures have dims (estimator, part); a part is a channel or "mean". ``<measure>_se``,
        ``_low`` and ``_high`` are the standard error and the interval over blocks. Measures by
        label have dims (label, estimator) and the prefix ``label_``. Attributes that are neither
        text nor integers are JSON.
        """
        import xarray as xr

        height, width = self.test_pixels.shape
        part, image, radiance = ("estimator", "part"), ("y", "x", "channel"), "W sr-1 m-2"
        others = "mean of all but the first n"
        columns: dict[tuple[str, ...], Columns] = {
            part: columns_of(self.measures),
            ("estimator", *image): {"estimate": (self.estimates, described("estimate", radiance))},
            image: {
                "reference": (self.reference, described("reference", radiance)),
                "first_mean": (self.first_mean, described("mean of the first n", radiance)),
                "first_reference": (self.first_reference.mean, described(others, radiance)),
            },
            image[:2]: {"test_pixel": (self.test_pixels, described("pixel counts"))},
        }
        looks = described("whether it looks at the pixels around")
        columns["estimator",] = {"uses_neighbours": (self.uses_neighbours, looks)}
        names = {"estimator": self.estimators, "part": [*self.channels, "mean"]}
        names["channel"] = self.channels
        if (found := self.breakdown) is not None:
            names["label"] = found.labels
            about = described("pixels with the label that judge")
            columns["label",] = {"label_pixels": (found.pixels, about)}
            columns["label", "estimator"] = {
                f"label_{name}": column for name, column in columns_of(found.measures).items()
            }
        variables = {
            name: (dims, *column)
            for dims, group in columns.items()
            for name, column in group.items()
        }
        # Objects: zarr v3 has no stable type for text of fixed length.
        coordinates = {name: np.array(values, object) for name, values in names.items()}
        coordinates |= {"y": np.arange(height), "x": np.arange(width)}
        attrs = {
            name: value if isinstance(value, str | int) else json.dumps(value, default=str)
            for name, value in {"n": self.n, **self.provenance}.items()
        }
        return xr.Dataset(variables, coordinates, attrs)


def compare(
    samples: ImageLike | npt.ArrayLike,
    estimators: Sequence[str | Entry] | None = None,
    *,
    n: int = 32,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Models = None,
    denoise: bool = False,
    labels: npt.ArrayLike | xr.DataArray | xr.Dataset | str | None = None,
    progress: bool = True,
    client: Client | None = None,
) -> Comparison:
    r"""Measure estimators on the same batches of n samples, against held-out references.

    Let p be an estimate, y its reference, :math:`\bar x` the mean of its samples, and m the mean
    reference of the scene. For each channel, the measures are

    - ``mse``: :math:`\overline{(p - y)^2}`, and ``mse_ratio``, its ratio to that of the sample
      mean;
    - ``relmse``: :math:`\overline{(p - y)^2 / (y^2 + 0.01\, m^2)}`, and ``relmse_ratio``;
    - ``improved``: the share with :math:`|p - y| < |\bar x - y|`; ``unchanged``: the share with
      :math:`p = \bar x` to six digits; all others got worse;
    - ``bias``: :math:`\overline{p - y} / \bar y`;
    - ``fireflies``: the share that surely has :math:`p - y > 3 \sqrt{y^2 + 0.01\, m^2}`, at least
      two stops too bright (our own threshold), and ``fireflies_left``, its ratio to that of the
      sample mean.

    The truth y is known from the other samples of the pixel. Their noise is in no measure:
    :doc:`/understand/judging` says how errors are estimated without it. What they cannot tell
    is NaN, "cannot tell" in words: a ratio where the error of the mean may be 0, a relative error
    that depends on how noisy its denominators are, and the share of improved estimates where more
    than a tenth are about as near as the mean; its interval then still holds the share.

    Parameters
    ----------
    samples
        The image, as `Samples`, an array (y, x, channel, sample) or the path of a store, with at
        least 2 n samples per pixel.
    estimators
        Names of registered estimators, or entries of your own. " + OIDN" or " + OIDN features"
        after a name adds Open Image Denoise. None takes those of
        `chdstat.comparison.DEFAULT_ESTIMATORS` that apply to the image and to n: the default
        estimate first, then the sample mean. An estimator that uses neighbours gets the whole image
        of each batch with its first-hit features. It is marked, as it sees more than n samples.
    n
        Samples per estimate.
    seed
        Seed of training and bootstrap.
    max_batches
        Number of batches per pixel to estimate from, in stored order; None takes all. All samples
        are used for the reference.
    model
        A trained estimator, used instead of training one of that name; or several by name. If it
        was trained on an image of the same size, its training pixels do not judge.
    denoise
        Also judge every estimator followed by Open Image Denoise: with the image alone, and with
        first-hit features if there are any.
    labels
        Labels for the breakdown: ``label`` of `chdstat.classify` or the dataset itself, codes of
        `chdstat.patterns.Label`, shape (y, x), or any map with the attributes ``flag_values`` and
        ``flag_meanings``. "classify" labels these samples. Labels that are computed from the judged
        samples bias the breakdown: a pixel may be firefly-dominated because of one batch, which is
        then easy to improve. Labels of an independent render do not.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    client
        A Dask client whose workers estimate, one batch per task, with the same result to the bit.
        Training stays in this process.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or does not take n samples; if there are too few
        samples; if labels do not fit the image; if Open Image Denoise is needed but missing; if a
        model belongs to no compared estimator; or if no judging pixel is left.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(8, 8, 3, 128)))
    >>> found = chd.compare(samples, ["mean", "median_of_means"])
    >>> print(found.to_dataframe()[["estimator", "mse_ratio"]].round(1))
             estimator  mse_ratio
    0      sample mean        1.0
    1  median of means        1.7
    """
    _check_not_renders(samples, estimators)
    samples, seed = samples_of(samples), seed_number(seed)
    n = whole("n", n, least=1)
    chosen = choose(estimators, [n], samples=samples)
    check_samples_for_judge(samples, n)
    if denoise:
        check_denoiser(samples.shape[2])  # before the training, not after
    codes, names = (None, {}) if labels is None else labels_of(labels, samples, progress=progress)
    how: Any = {"seed": seed, "max_batches": max_batches, "model": model, "progress": progress}
    found = trained_candidates(chosen, samples, sizes=[n], denoise=denoise, **how)
    units = found.test_units(codes)
    errors = judge(found, units, n=n, progress=progress, client=client)
    common: Any = {"estimators": tuple(found.entries), "uses_neighbours": found.uses_neighbours}
    breakdown = None
    if codes is not None:
        seen = errors.of_labels()
        breakdown = Breakdown(
            labels=tuple(names[code] for code in seen),
            pixels=np.array([part.pixels for part in seen.values()]),
            measures=stacked([part.measures(seed=seed) for part in seen.values()]),
            **common,
        )
    return Comparison(
        channels=samples.channels,
        measures=errors.measures(seed=seed),
        estimates=errors.estimates,
        first_mean=errors.mean,
        first_reference=errors.reference,
        reference=found.totals.mean,
        test_pixels=units.image(samples.shape[:2]),
        n=n,
        batches=errors.batches,
        excluded=errors.excluded,
        breakdown=breakdown,
        models=found.models,
        provenance=found.provenance,
        **common,
    )


def _check_not_renders(samples: Any, estimators: Any) -> None:
    """Refuse renders to be compared, a list of them or a second one in place of estimators."""
    given = samples if isinstance(samples, list | tuple) else [samples]
    second = estimators if isinstance(estimators, list | tuple) else [estimators]
    renders = [one for one in (*given, *second) if isinstance(one, Samples) or is_store(one)]
    if len(renders) > 1:
        message = (
            f"expected one image and names of estimators, got {len(renders)} renders: estimators "
            "are compared, renders are contrasted, by chdstat.contrast([a, b])"
        )
        raise InputError(message)


def error_curve(
    samples: ImageLike | npt.ArrayLike,
    estimators: Sequence[str | Entry] | None = None,
    *,
    sizes: Sequence[int] | None = None,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Models = None,
    progress: bool = True,
    client: Client | None = None,
) -> ErrorCurve:
    """Measure the error of estimators at many numbers of samples, N.

    For every N, estimates from batches of N samples are compared with the other samples of the
    pixel, as in `chdstat.compare`: errors are without the noise of the reference.

    Parameters
    ----------
    samples
        The image, as `compare` takes it, with at least twice as many samples per pixel as the
        largest N.
    estimators
        As `compare` takes them. An estimator that does not take N samples has NaN there.
    sizes
        N, in any order; None doubles from 4 to an eighth of the samples. An estimator that takes
        none of these numbers adds the fewest samples that it takes.
    seed, max_batches, model, progress, client
        As for `chdstat.compare`. Pixels that trained a model count for no N. Small batches are read
        one by one, so `Samples.load` a store first.

    Returns
    -------
    ErrorCurve

    Raises
    ------
    InputError
        If `sizes` are not different integers from 1, there are too few samples for them, an
        estimator takes none of them, or no judging pixel is left.

    Examples
    --------
    The bias of a median remains, so its error stops falling:

    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(16, 16, 1, 1024)))
    >>> curve = error_curve(samples, ["mean", "median"], sizes=[16, 128])
    >>> curve.measures["mse_ratio"].value.round()
    array([[ 1.,  2.],
           [ 1., 13.]])
    """
    samples, seed = samples_of(samples), seed_number(seed)
    numbers = curve_sizes(samples, estimators, sizes=sizes)
    chosen = choose(estimators, numbers, samples=samples)
    how: Any = {"seed": seed, "max_batches": max_batches, "model": model, "progress": progress}
    found = trained_candidates(chosen, samples, sizes=numbers, **how)
    units = found.test_units()
    parts, judged = [], []
    for n in numbers:
        errors = judge(found, units, n=n, progress=progress, client=client)
        parts.append(errors.measures(seed=seed))
        judged.append(errors.batches)
    return ErrorCurve(
        estimators=tuple(found.entries),
        uses_neighbours=found.uses_neighbours,
        sizes=numbers,
        measures=stacked(parts),
        batches=np.array(judged),
        test_pixels=len(units.ys),
        models=found.models,
        provenance=found.provenance,
    )
