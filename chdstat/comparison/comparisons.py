"""Comparisons: estimators side by side on the same batches, against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel
(`chdstat.comparison.judging`). Its `Comparison` holds every measure with its interval, the
`Breakdown` those of each pattern, and `PixelEstimates` are a few pixels one by one; they become
tables, data frames, datasets, LaTeX and JSON.

`error_curve` does the same for many n, and returns an `ErrorCurve`: use it to see up to which size
an estimator is worth it. The error of an estimator with a constant bias stops falling.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Seed, generator, plain, seed_number, whole
from chdstat._core.display import Card, Shown, Width, png, written
from chdstat._core.image_scales import tonemap
from chdstat._core.resampling import Interval
from chdstat.comparison.entries import Entry, choose, curve_sizes, notes
from chdstat.comparison.judging import (
    Candidates,
    Models,
    judge,
    labels_of,
    trained_candidates,
)
from chdstat.comparison.metrics import MEASURES, counts, in_words, measures_of, stacked
from chdstat.errors import InputError
from chdstat.estimators.estimates import check_denoiser
from chdstat.estimators.registry import Model
from chdstat.estimators.validation import check_spp
from chdstat.samples import ImageLike, check_equal_counts, samples_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from distributed import Client
    from matplotlib.figure import Figure

__all__ = ["Breakdown", "Comparison", "ErrorCurve", "PixelEstimates", "compare", "error_curve"]

Measures = Mapping[str, Interval[Array]]
Columns = dict[str, tuple[Array, dict[str, str]]]

_ALL_CHANNELS = -1
"""Last place of the channel axis of a measure: the average over channels."""
_SUFFIXES = {
    "": ("value", ""),
    "_se": ("standard_error", ", standard error"),
    "_low": ("low", ", lower end of the 95 % interval"),
    "_high": ("high", ", upper end of the 95 % interval"),
}


# --- measures as columns --------------------------------------------------------------------------


def _columns(measures: Measures, *, over_batches: bool = False) -> Columns:
    """Return the arrays of all intervals with what they are; over batches, without the measures."""
    end, where = ("_over_batches", " over batches") if over_batches else ("", "")
    return {
        measure + suffix + end: (
            getattr(interval, part),
            _described(MEASURES[measure][0] + what + where, MEASURES[measure][1]),
        )
        for measure, interval in measures.items()
        for suffix, (part, what) in _SUFFIXES.items()
        if suffix or not over_batches
    }


def _described(long_name: str, units: str = "1") -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}


def _rows(
    columns: Columns, found: Breakdown | Comparison | ErrorCurve, *before: int
) -> list[dict[str, Any]]:
    """Return a flat row for each estimator: what all columns hold of it at a place."""
    return [
        {"estimator": name, "uses_neighbours": bool(found.uses_neighbours[k])}
        | {column: float(values[before][k]) for column, (values, _) in columns.items()}
        for k, name in enumerate(found.estimators)
    ]


def _data_frame(measures: Measures, where: Any = ..., **index: Sequence[Any]) -> pd.DataFrame:
    """Return measures with their intervals as a data frame, a row for each place of the index."""
    import pandas as pd

    columns = {
        (measure, part): getattr(interval, part)[where].reshape(-1)
        for measure, interval in measures.items()
        for part in ("value", "low", "high")
    }
    if len(index) == 1:
        ((name, values),) = index.items()
        return pd.DataFrame(columns, pd.Index(values, name=name))
    return pd.DataFrame(columns, pd.MultiIndex.from_product([*index.values()], names=[*index]))


# --- measures as words ----------------------------------------------------------------------------

_TITLES = {
    "label": "pattern",
    "pixels": "pixels",
    "n": "N",
    "name": "estimator",
    "mse_ratio": "MSE / mean's",
    "relmse_ratio": "relMSE / mean's",
    "improved": "improved",
    "bias": "bias",
    "fireflies": "fireflies left",
}


def _titled(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows of measures in words, under titles."""
    texts = ({**row, **in_words(row)} for row in rows)
    return [
        {title: written(row[key]) for key, title in _TITLES.items() if key in row} for row in texts
    ]


# --- results --------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class PixelEstimates(Shown):
    """A few pixels that no estimator was trained on, one batch each.

    Attributes
    ----------
    pixels
        Rows (y, x), from dark to bright, shape (pixel, 2).
    estimators, channels
        Names.
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
        """Draw them one by one, as `chdstat.viz.pixel_estimates`."""
        from chdstat import viz

        look: dict[str, Any] = {"channels": channels, "width": width}
        ax = viz.pixel_estimates(self, ax=None if fig is None else fig.subplots(), **look)
        return cast("Figure", ax.figure)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per pixel and channel: where, reference, mean, every estimate."""
        return [
            {
                "y": int(y),
                "x": int(x),
                "channel": channel,
                "reference": float(self.reference[k, c]),
                "sample_mean": float(self.mean[k, c]),
                **{name: float(self.estimates[e, k, c]) for e, name in enumerate(self.estimators)},
            }
            for k, (y, x) in enumerate(self.pixels)
            for c, channel in enumerate(self.channels)
        ]


@dataclass(frozen=True, repr=False)
class Breakdown(Shown):
    """The measures by label, averaged over channels: which estimator suits which pattern.

    Attributes
    ----------
    labels
        Names of the labels that occur among the pixels that judge.
    estimators, uses_neighbours
        As of a `Comparison`.
    pixels
        Pixels with each label that judge, shape (label,).
    measures
        By the names of `MEASURES`: intervals over blocks, shape (label, estimator).
    """

    _drawn: ClassVar[str] = "relMSE over that of the mean"
    labels: tuple[str, ...]
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    pixels: npt.NDArray[np.int64]
    measures: Mapping[str, Interval[Array]]

    def best(self, measure: str = "relmse", *, neighbours: bool = False) -> tuple[str, ...]:
        """Return the estimator with the smallest error for each label; '' where none has one.

        Parameters
        ----------
        measure
            "mse" or "relmse".
        neighbours
            Whether estimators that look at the pixels around take part.

        Raises
        ------
        InputError
            If the measure is another.
        """
        if measure not in {"mse", "relmse"}:
            message = f"measure must be 'mse' or 'relmse', got {measure!r}"
            raise InputError(message)
        value = self.measures[measure].value
        errors = np.where(np.isfinite(value) & (neighbours | ~self.uses_neighbours), value, np.inf)
        return tuple(
            self.estimators[row.argmin()] if np.isfinite(row).any() else "" for row in errors
        )

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw the errors of each pattern, as `chdstat.viz.pattern_breakdown`."""
        from chdstat import viz

        ax = None if fig is None else fig.subplots()
        return cast("Figure", viz.pattern_breakdown(self, width=width, ax=ax).figure)

    def _card(self) -> Card:
        return Card("Breakdown by pattern", table=_titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by label and estimator."""
        return _data_frame(self.measures, label=self.labels, estimator=self.estimators)

    def table(self) -> list[dict[str, Any]]:
        """Return one row per label and estimator: names, pixels and every measure."""
        columns = _columns(self.measures)
        return [
            {"label": label, "pixels": int(self.pixels[row]), **one}
            for row, label in enumerate(self.labels)
            for one in _rows(columns, self, row)
        ]


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """What `compare` has found; `plot` draws it, `to_latex` is its table for a paper.

    Attributes
    ----------
    estimators
        Names, in the order given.
    uses_neighbours
        Which of them look at the pixels around, shape (estimator,): a class of their own, as they
        see more than n samples.
    channels
        Names of the channels.
    measures
        By the names of `MEASURES`: intervals over 8 x 8 blocks of pixels, shape (estimator,
        channel + 1), the last place being the average over channels. They say how the measure would
        vary with other parts of such an image.
    over_batches
        The same measures with intervals over batches: how they would vary with other random
        numbers, in the same pixels. The batches of a pixel share most of their reference.
        NaN for a single batch.
    estimates
        One estimate of the whole image from its first n samples, radiance, float32, shape
        (estimator, y, x, channel).
    squared_error
        Squared error of `estimates` against the mean of all other samples, same shape; NaN where
        the first n samples hold a bad one.
    first_mean, first_reference
        Mean of the first n samples and mean of all others, radiance, shape (y, x, channel).
    reference
        Mean of all good samples, radiance, shape (y, x, channel).
    test_pixels
        True where no estimator was trained: only these pixels count; shape (y, x).
    n
        Samples per estimate.
    batches
        Estimates that count, over all test pixels.
    excluded
        Estimates of test pixels left out for a bad sample.
    breakdown
        The measures by label; None where no labels were given.
    models
        Trained estimators by name.
    provenance
        Scene, samples, seed and settings, ready for JSON.
    """

    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    channels: tuple[str, ...]
    measures: Mapping[str, Interval[Array]]
    over_batches: Mapping[str, Interval[Array]]
    estimates: npt.NDArray[np.float32]
    squared_error: npt.NDArray[np.float32]
    first_mean: npt.NDArray[np.float32]
    first_reference: npt.NDArray[np.float64]
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

        What the default estimate is; which estimators use neighbours; which were left out of
        `chdstat.comparison.DEFAULT_ESTIMATORS`, and why.
        """
        left_out = self.provenance.get("left_out", {})
        return notes(self.estimators, uses_neighbours=self.uses_neighbours, left_out=left_out)

    @property
    def reusable_models(self) -> dict[str, Model]:
        """Those of `models` that take exactly n samples, and so can be used again.

        Models that take any number of samples were trained for n; train them anew for others.
        """
        return {
            name: model
            for name, model in self.models.items()
            if isinstance(getattr(model, "inputs", None), int)
        }

    def table(self) -> list[dict[str, Any]]:
        """Return one row per estimator: its name and every measure, averaged over channels.

        Each measure also has ``_se``, ``_low`` and ``_high``, the standard error and the interval
        over blocks, and the same with ``_over_batches``.
        """
        over_blocks, over_batches = (
            {name: measure[:, _ALL_CHANNELS] for name, measure in measures.items()}
            for measures in (self.measures, self.over_batches)
        )
        return _rows(_columns(over_blocks) | _columns(over_batches, over_batches=True), self)

    def _card(self) -> Card:
        pixels = f"{self.test_pixels.sum()} test pixels"
        facts = {"estimates": f"{self.batches} from {self.n} samples each, of {pixels}"}
        images = {}
        if len(self.channels) in (1, 3):
            images["reference: the mean of all samples"] = png(tonemap(self.reference))
        facts |= {name: text for name, text in self.notes.items() if name != "use neighbours"}
        return Card("Comparison of estimators", facts, _titled(self.table()), images)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the measures as a `pandas.DataFrame`, averaged over channels.

        Rows are estimators; columns have two levels: the measure, and its ``value`` with the
        ``low`` and ``high`` end of the 95 % interval over blocks of pixels.

        Examples
        --------
        >>> import chdstat as chd
        >>> rng = np.random.default_rng(0)
        >>> found = chd.compare(rng.exponential(size=(8, 8, 3, 128)), ["mean", "median"])
        >>> float(found.to_dataframe().loc["mean", ("mse_ratio", "value")])
        1.0
        """
        return _data_frame(self.measures, (slice(None), _ALL_CHANNELS), estimator=self.estimators)

    def plot(
        self,
        *,
        channels: str | Sequence[str] | None = None,
        width: Width = "page",
        fig: Figure | None = None,
    ) -> Figure:
        """Draw all measures of all estimators, as `chdstat.viz.estimator_measures`."""
        from chdstat import viz

        return viz.estimator_measures(self, channels=channels, width=width, fig=fig)

    def draw_pixels(self, count: int = 25, *, seed: int = 0) -> PixelEstimates:
        """Draw pixels at random from those that judge, with the estimates of each.

        Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte Carlo
        variance reduction", show 25 of them.

        Parameters
        ----------
        count
            How many; fewer where fewer have a reference.
        seed
            Where the draw starts.

        Raises
        ------
        InputError
            If `count` is no whole number from 1.
        """
        whole("count", count, least=1)
        usable = self.test_pixels & np.isfinite(self.first_reference).all(axis=-1)
        pixels = np.argwhere(usable)
        drawn = pixels[generator(seed).permutation(len(pixels))[:count]]
        brightness = self.first_reference[tuple(drawn.T)].sum(axis=-1)
        drawn = drawn[np.argsort(brightness, kind="stable")]
        ys, xs = drawn.T
        return PixelEstimates(
            pixels=drawn,
            estimators=self.estimators,
            channels=self.channels,
            reference=self.first_reference[ys, xs],
            mean=self.first_mean[ys, xs],
            estimates=self.estimates[:, ys, xs],
            n=self.n,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return measures, per channel and per label too, and provenance, ready for JSON.

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

        Measures have dims (estimator, part), a part being a channel or "mean"; beside each stand
        ``<measure>_se``, ``_low``, ``_high``, and the same with ``_over_batches``. Those by label
        have dims (label, estimator) and the prefix ``label_``. Attributes that are neither text nor
        whole numbers are JSON, as files hold them.
        """
        import xarray as xr

        height, width = self.test_pixels.shape
        part, image, radiance = ("estimator", "part"), ("y", "x", "channel"), "W sr-1 m-2"
        others = "mean of all but the first n"
        columns: dict[tuple[str, ...], Columns] = {
            part: _columns(self.measures) | _columns(self.over_batches, over_batches=True),
            ("estimator", *image): {
                "estimate": (self.estimates, _described("estimate", radiance)),
                "squared_error": (
                    self.squared_error,
                    _described("squared error", f"({radiance})^2"),
                ),
            },
            image: {
                "reference": (self.reference, _described("reference", radiance)),
                "first_mean": (self.first_mean, _described("mean of the first n", radiance)),
                "first_reference": (self.first_reference, _described(others, radiance)),
            },
            image[:2]: {"test_pixel": (self.test_pixels, _described("pixel counts"))},
        }
        looks = _described("whether it looks at the pixels around")
        columns["estimator",] = {"uses_neighbours": (self.uses_neighbours, looks)}
        names = {"estimator": self.estimators, "part": [*self.channels, "mean"]}
        names["channel"] = self.channels
        if (found := self.breakdown) is not None:
            names["label"] = found.labels
            about = _described("pixels with the label that judge")
            columns["label",] = {"label_pixels": (found.pixels, about)}
            columns["label", "estimator"] = {
                f"label_{name}": column for name, column in _columns(found.measures).items()
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


@dataclass(frozen=True, repr=False)
class ErrorCurve(Shown):
    """What `error_curve` has found.

    Attributes
    ----------
    estimators, uses_neighbours, models, provenance
        As of a `Comparison`.
    sizes
        Samples per estimate, ascending.
    measures
        By the names of `chdstat.comparison.MEASURES`: intervals over blocks, averaged over
        channels, shape (size, estimator); NaN where an estimator does not take so many samples.
    reference_noise
        For "mse" and "relmse": the error that even a perfect estimator would show, since the
        reference is noisy; the same unit, shape (size,).
    batches
        Estimates that count, over all test pixels, shape (size,).
    test_pixels
        How many pixels count.
    """

    _drawn: ClassVar[str] = "errors against the number of samples"
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    sizes: tuple[int, ...]
    measures: Mapping[str, Interval[Array]]
    reference_noise: Mapping[str, npt.NDArray[np.float64]]
    batches: npt.NDArray[np.int64]
    test_pixels: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per size and estimator that takes it, with every measure."""
        columns = _columns(self.measures)
        return [
            {"n": size, **one}
            for row, size in enumerate(self.sizes)
            for one in _rows(columns, self, row)
            if np.isfinite(one["mse"])
        ]

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw errors against the number of samples, as `chdstat.viz.error_curves`."""
        from chdstat import viz

        return viz.error_curves(self, width=width, fig=fig)

    def _card(self) -> Card:
        return Card("Error curve", table=_titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` as that of a `Comparison`, by n and estimator."""
        return _data_frame(self.measures, n=self.sizes, estimator=self.estimators)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        names = "sizes", "batches", "test_pixels", "reference_noise", "provenance"
        found: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return found | {"table": plain(self.table())}


# --- what makes them ---------------------------------------------------------------------------


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
    found, left_out = trained_candidates(
        chosen, samples, sizes=[n], seed=seed, model=model, progress=progress
    )
    found = found.with_denoised() if denoise else found
    units = found.test_units(seed, codes)
    errors = judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
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
    model: Models = None,
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
    check_equal_counts(samples, "errors are drawn over the samples of a pixel")
    max_batches = _limit(max_batches)
    numbers = curve_sizes(samples, estimators, sizes=sizes)
    chosen = choose(estimators, numbers, samples=samples)
    found, left_out = trained_candidates(
        chosen, samples, sizes=numbers, seed=seed, model=model, progress=progress
    )
    units = found.test_units(seed)
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
