"""Analysis: everything that the library computes per pixel, in one dataset, and its overview.

`analyze` returns the dataset; `overview` summarises it in a few numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import (
    Floats,
    Image,
    Mapped,
    Seed,
    flag_names,
    is_bad,
    plain,
    seed_number,
    whole,
)
from chdstat._core.files import checkpoints, release, unused, writing
from chdstat._core.image_scales import relative_scale
from chdstat._core.moments import Moments
from chdstat._core.positive import Part, PositivePart
from chdstat._core.progress import portion, track
from chdstat._core.resampling import Blocks, Interval, interval_of, mean_of, quantile_of, wilson
from chdstat._core.statistic import (
    RADIANCE,
    Result,
    Statistic,
    result,
    shown_statistics,
    variable,
)
from chdstat._core.work import in_order
from chdstat.errors import InputError
from chdstat.fit.goodness_of_fit import GoodnessOfFit
from chdstat.fit.mixtures import MixtureFit
from chdstat.fit.selection import FamilySelection
from chdstat.fit.tail import TailIndex
from chdstat.inference.averages import (
    MORE_THAN_TESTED,
    UNTESTED,
    NormalityOfMeans,
)
from chdstat.inference.modes import ModalMixture, Modes
from chdstat.inference.normality import TESTS, Normality
from chdstat.patterns.classification import Classification
from chdstat.patterns.definitions import BODIES, PATTERNS, Thresholds
from chdstat.patterns.film_splits import VarianceByPlace, film_statistic
from chdstat.samples import ImageLike, checkpoint_key, samples_of
from chdstat.samples.assembly import assemble
from chdstat.samples.samples import SampleStream
from chdstat.samples.tiles import Work, tiles
from chdstat.summary.histograms import Histogram
from chdstat.summary.runner import measured
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

    from chdstat.samples import Samples

_PREFIXED = (
    *("modality", "normality", "averages", "film"),
    *("luminance_logarithms", "luminance_averages"),
)
"""Stages whose variables begin with the stage's name."""
_AT_ONCE = 2**26
"""Bytes of maps that are written together."""
_COMMENT = (
    "where tail_variance_suspect, the samples miss what the moments behind this depend on: do not "
    "trust it; where tail_variance_unidentified, they do not tell"
)


def analyze(
    samples: ImageLike | xr.Dataset | SampleStream | npt.ArrayLike,
    *,
    thresholds: Thresholds | None = None,
    held_out: bool = True,
    resamples: int = 0,
    seed: Seed = 0,
    progress: bool = True,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
) -> xr.Dataset:
    """Return everything per pixel: statistics, fits, tails, modes, normality, patterns.

    Every tile is read, split, sorted and turned into logarithms only once. Fits, tails, modes and
    normality are computed for each channel, patterns for the luminance.

    Parameters
    ----------
    samples
        The image: `Samples`, an array (y, x, channel, sample), or the path of a store. It may also
        be a rendering, as `chdstat.rendering.render_batches` makes it, whose samples are not kept,
        or the dataset of `summarize`. These two give statistics, histograms, and what follows from
        histograms: families, their goodness, and mixtures.
    thresholds
        Thresholds of the patterns; None for the defaults.
    held_out
        Also compare the families by held-out likelihood, which nearly doubles the cost of fits.
    resamples, seed
        Number of bootstrap replicates for the goodness of the best family, and their seed. Each
        costs about as much as the fits. With 0, there are statistics and effect sizes, but no
        p-values and no ``best_goodness_rejected``.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.
    client
        A Dask client, whose workers analyse one tile per task. The results are the same to the bit.
    checkpoint
        Folder that keeps every tile as soon as it is analysed, until all are done; other files
        there stay. After an interruption of any kind, the same call continues from there.

    Returns
    -------
    xarray.Dataset
        The variables of `summarize`, `fit.select`, `fit.tail_index` and `classify`, and, with a
        prefix, those of other functions:

        ======================  ==========================================================
        Prefix                  Function
        ======================  ==========================================================
        ``modality_``           `modality`
        ``normality_``          `gaussianity`
        ``averages_``           `gaussianity_of_means`; absent if there are too few samples
        ``film_``               `patterns.film_split`; absent without places of samples
        ``lognormal_mixture_``  `fit.mixture` with log-normal components, searched as for modes
        ``best_goodness_``      `fit.goodness` for the best family of each pixel
        ======================  ==========================================================

        All other statistics that maps or the tables of a pixel show follow, under their own names.
        ``luminance_mean`` and ``coefficient_of_variation`` (y, x) describe luminance,
        ``sample_seconds`` and ``sample_seconds_error`` what a sample takes, if known. `atlas`,
        which looks at the image as a whole, is not included.

    Raises
    ------
    InputError
        If an option is out of range, or `thresholds` or ``held_out=False`` is given with a
        rendering or a summary.
    StoreError
        If the samples or the checkpoint cannot be read or written.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> found = chd.analyze(rng.gamma(2.0, size=(2, 2, 3, 256)))
    >>> found["null_share"].shape, found["mean"].dims
    ((2, 2), ('y', 'x', 'channel'))
    """
    resamples, seed = whole("resamples", resamples, least=0), seed_number(seed)
    given: Any = samples
    goodness = GoodnessOfFit(resamples=resamples, seed=seed)
    summarised = hasattr(given, "on_demand") or hasattr(given, "data_vars")
    if summarised and (thresholds is not None or not held_out):
        message = (
            "thresholds and held_out are for patterns and held-out likelihoods, which need all "
            "samples at once; leave them out, or give samples"
        )
        raise InputError(message)
    if hasattr(given, "on_demand"):  # a rendering; to test for its class would load Mitsuba here
        with (
            given.on_demand() as (drawn, threads),
            checkpoints(checkpoint, functools.partial(checkpoint_key, drawn)) as drawn_tiles,
        ):
            at: Work = {"progress": progress, "client": client, "workers": threads}
            at["checkpoint"] = drawn_tiles
            summary = summarize(drawn, **at)
            # Drawn tiles are kept until everything that follows from them is done.
            folder = drawn_tiles.folder if drawn_tiles else None
            return _of_summary(summary, goodness, progress, client, folder)
    if hasattr(given, "data_vars"):
        return _of_summary(given, goodness, progress, client)
    samples, thresholds = samples_of(given), thresholds or Thresholds()
    statistics: dict[str, Statistic[Any] | None] = {
        "luminance": _LuminanceMoments(),
        "selection": FamilySelection(held_out=held_out),
        "goodness": goodness,
        "tail": TailIndex(),
        "mixture": ModalMixture(),
        "modality": Modes(),
        "normality": Normality(("log", "sqrt", "linear"), tuple(TESTS)),
        "patterns": Classification(thresholds),
        "averages": NormalityOfMeans.of_pixel(samples.spp),
        "film": film_statistic(samples),
    }
    own = {VarianceByPlace, *(type(statistic) for statistic in statistics.values())}
    others = {k.__name__: k.of_pixel(samples.spp) for k in shown_statistics() if k not in own}
    statistics |= others
    some = filter(None, (statistics["film"], *others.values()))
    known = thresholds, held_out, resamples, seed, *some
    return _measured(samples, statistics, known, checkpoint, progress=progress, client=client)


def patterns_of(
    samples: Samples,
    *,
    families: bool = False,
    progress: bool = True,
    checkpoint: str | Path | None = None,
) -> xr.Dataset:
    """Return the part of an analysis that says where the noise is, in a tenth of the time.

    That is `summarize`, `classify`, and of luminance mean and variation, and the normality of
    logarithms and of averages, whose variables have a prefix. With `families`, it takes
    half of the time of `analyze` and has everything in `overview` except modes. That adds, for each
    channel, families and their distance from the samples, tails, and the normality of logarithms
    and averages. The numbers are those of `analyze`.
    """
    statistics: dict[str, Statistic[Any] | None] = {
        "luminance": _LuminanceMoments(),
        "patterns": Classification(),
        "luminance_logarithms": _LuminanceNormality(),
        "luminance_averages": _LuminanceAverages.of_pixel(samples.spp),
        "film": film_statistic(samples),
    }
    if families:
        statistics |= {
            "selection": FamilySelection(held_out=True),
            "goodness": GoodnessOfFit(tests=("kolmogorov-smirnov",)),
            "tail": TailIndex(),
            "normality": Normality(),
            "averages": NormalityOfMeans.of_pixel(samples.spp),
        }
    known = "patterns", families, statistics["film"]
    return _measured(samples, statistics, known, checkpoint, progress=progress)


def _measured(
    samples: Samples,
    asked: Mapping[str, Statistic[Any] | None],
    known: tuple[Any, ...],
    folder: str | Path | None,
    **work: Unpack[Work],
) -> xr.Dataset:
    """Return the summary of samples with the variables of all statistics, by stage.

    None stands for a statistic that has too few samples.
    """
    import xarray as xr

    statistics = {stage: statistic for stage, statistic in asked.items() if statistic is not None}
    key = functools.partial(checkpoint_key, samples)
    with checkpoints(folder, key, *known) as kept:
        work["checkpoint"] = kept
        summary = summarize(samples, **work)
        of_block = functools.partial(_of_block, statistics)
        film = any(statistic.film for statistic in statistics.values())
        found = samples.map(of_block, logarithms=True, film=film, description="analysing", **work)
    # Parts count the same samples; the summary decides about nulls and bad samples.
    merged = xr.merge(
        [summary, *_finished(found, statistics)],
        compat="override",
        combine_attrs="drop_conflicts",
        join="override",
    )
    if samples.costs is not None:
        merged = merged.assign(samples.costs.variables())
    for name in ("skewness", "kurtosis") if "averages" in statistics else ():
        merged[f"averages_predicted_{name}"].attrs["comment"] = _COMMENT
    return merged.assign_attrs(summary.attrs)


def _of_block(
    statistics: Mapping[str, Statistic[Any]], block: Image, places: Image | None = None
) -> Mapped:
    """Return the variables of all statistics for a tile, by stage."""
    if all(statistic.rows == "luminance" for statistic in statistics.values()):
        part = PositivePart.of_pixels(block, rows="luminance", places=places)
        rows: dict[str, Part] = {"luminance": part}
        return _variables(statistics, rows)
    both = PositivePart.of_pixels(block, rows="both", places=places)
    # Statistics of channels and of luminance share their work.
    shared = {"selection": FamilySelection(), "tail": TailIndex(), "mixture": ModalMixture()}
    for stage, statistic in shared.items():
        with portion(1 / (len(shared) + 1)):  # about as long as all others together
            if stage in statistics:
                measured(both, statistic)
    channels, luminance = both.rows(slice(block.shape[-2])), both.rows(-1)
    return _variables(statistics, {"channels": channels, "luminance": luminance})


def _variables(statistics: Mapping[str, Statistic[Any]], rows: Mapping[str, Part]) -> Mapped:
    return {
        f"{stage}/{name}": variable
        for stage, statistic in statistics.items()
        for name, variable in statistic.variables(measured(rows[statistic.rows], statistic)).items()
    }


def _finished(found: xr.Dataset, statistics: Mapping[str, Statistic[Any]]) -> Iterator[xr.Dataset]:
    """Yield the variables of each stage, finished over the whole image and renamed."""
    for stage, statistic in statistics.items():
        own = {str(n): str(n).partition("/")[2] for n in found if str(n).startswith(f"{stage}/")}
        dataset = statistic.finish(found[list(own)].rename(own))
        prefix = f"{stage}_" if stage in _PREFIXED else ""
        yield dataset.rename({str(name): f"{prefix}{name}" for name in dataset.data_vars})


@result
class _Luminance(Result):
    luminance_mean: Floats = variable("mean luminance", unit=RADIANCE)
    coefficient_of_variation: Floats = variable("standard deviation over mean of luminance")


@dataclass(frozen=True)
class _LuminanceMoments(Statistic[_Luminance]):
    """Mean and coefficient of variation of the luminance of every pixel."""

    result: ClassVar = _Luminance
    rows: ClassVar = "luminance"

    def measure(self, part: PositivePart) -> _Luminance:
        good = ~is_bad(part.x)
        moments = Moments.of(np.where(good, part.x, 0), good)
        ratio = np.sqrt(moments.variance) / moments.mean
        return _Luminance(moments.mean, np.where(moments.mean > 0, ratio, np.nan))


class _LuminanceNormality(Normality):
    """Whether the logarithms of luminance are Gaussian."""

    rows: ClassVar = "luminance"


class _LuminanceAverages(NormalityOfMeans):
    """Whether averages of luminance are Gaussian."""

    rows: ClassVar = "luminance"


def _of_summary(
    summary: xr.Dataset,
    goodness: GoodnessOfFit,
    progress: bool,
    client: Client | None,
    folder: Path | None = None,
) -> xr.Dataset:
    """Return a summary with everything that follows from its log histograms, tile by tile."""
    import xarray as xr

    height, width = (summary.sizes.get(dim, 0) for dim in ("y", "x"))
    if not height or not width or "channel" not in summary.dims:
        message = (
            "expected the dataset of an image, over y, x and channel, as chdstat.summarize returns "
            f"it, got one over {dict(summary.sizes)}"
        )
        raise InputError(message)
    Histogram.of_dataset(summary.isel(y=[0], x=[0]))  # refused before the work
    summary = summary.transpose("y", "x", "channel", ...)
    statistics: dict[str, Statistic[Any]] = {
        "selection": FamilySelection(),
        "goodness": goodness,
        "mixture": MixtureFit(effort="fast"),
    }

    def task(counted: xr.Dataset) -> Mapped:
        part = Histogram.of_dataset(counted).positive
        return _variables(statistics, {"channels": part})

    counted = summary[[str(n) for n in summary if str(n).startswith("log_") or "count" in str(n)]]
    # Tiles are placed by their position, whatever their coordinates.
    counted = counted.drop_vars(["y", "x"], errors="ignore")
    places = [*tiles((height, width, 1, 1))]

    def placed(advance: Callable[[float], None]) -> Iterator[tuple[slice, slice, Mapped]]:
        items = (counted.isel(y=ys, x=xs) for ys, xs in places)
        how: Any = {"client": client, "advance": advance, "size": _pixels}
        for place, variables in zip(places, in_order(task, items, **how), strict=True):
            yield *place, variables
            if folder is not None:
                _released(counted)

    image: Any = SimpleNamespace(
        shape=(height, width),
        channels=tuple(counted["channel"].values),
        counts=None,
        unequal=False,
        attrs={},
    )
    with track("fitting", height * width, unit="px", show=progress) as advance:
        whole_image = assemble(image, placed(advance), folder=folder).drop_vars(["y", "x"])
    parts = [*_finished(whole_image, statistics)]
    if folder is not None:
        _released(whole_image)
    return xr.merge([summary, *parts], compat="override").assign_attrs(summary.attrs)


def _pixels(of: xr.Dataset) -> int:
    return of.sizes["y"] * of.sizes["x"]


def _released(found: xr.Dataset) -> None:
    """Release the memory of maps in files, which were read or written."""
    for name in found.data_vars:
        release(found[name].values)


def save(found: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of maps to a new zarr store, which appears when it is complete.

    Raises
    ------
    StoreError
        If something is already there, or it cannot be written.
    """
    target = unused(path)
    with writing(target, folder=True) as partial:
        for names in _batches(found):
            found[names].to_zarr(partial, mode="a", consolidated=False)
            for name in names:
                release(found[name].values)
    return target


def _batches(found: xr.Dataset) -> Iterator[list[Hashable]]:
    """Yield names of maps that are written together.

    Every write lists the whole store, and all maps at once may not fit into memory.
    """
    batch: list[Hashable] = []
    size = 0
    for name, maps in found.data_vars.items():
        if batch and size + maps.nbytes > _AT_ONCE:
            yield batch
            batch, size = [], 0
        batch.append(name)
        size += maps.nbytes
    yield batch


@dataclass(frozen=True)
class Overview:
    """A scene in a few numbers, from the results of `analyze`.

    Attributes
    ----------
    pixels, spp
        Number of pixels, and samples per pixel.
    null_share
        Share of null samples in the image.
    null_pixels
        Share of pixels with more than half of their samples null.
    bad_samples
        Number of bad samples in the image.
    variation
        Coefficient of variation of luminance: quartiles over the pixels.
    families, families_held_out
        Share of the pixel channels that each family describes best, by name: by BIC, and by
        held-out likelihood. The latter is empty if it was not asked for.
    decided
        Share of the choices by BIC that are very strong, with a margin above 10.
    misfit
        Largest distance between the distribution functions of the samples and of their best family:
        quartiles over the pixel channels.
    log_rejected, log_skewness
        Share of the pixel channels in which normality of log samples is rejected, and quartiles of
        the skewness of log samples.
    patterns
        Share of the pixels that show each pattern, by name.
    label_agreement
        Kappa of the labels of neighbouring pixels: 0 as by chance, 1 for complete agreement.
    doubtful_variance
        Share of the pixel channels whose error bar of so many samples is said to fail.
    unidentified_variance
        Share of the pixel channels whose samples do not tell whether their error bar holds.
    modes
        Share of the pixel channels with 1, 2, 3 modes of log radiance, by number.
    n_needed
        Share of the pixel channels whose averages pass for Gaussian from N samples on, by N; 'more'
        for those whose averages do not pass at any N that was tested.
    averages
        Share of the pixel channels in which normality of averages of N samples is rejected, by N.
    skewness, predicted_skewness
        Skewness of these averages: quartiles (3, size), and the median of its prediction for
        independent samples.
    """

    pixels: int
    spp: int
    null_share: float
    null_pixels: float
    bad_samples: int
    variation: tuple[float, float, float]
    families: dict[str, float]
    families_held_out: dict[str, float]
    decided: float
    misfit: tuple[float, float, float]
    log_rejected: float
    log_skewness: tuple[float, float, float]
    patterns: dict[str, float]
    label_agreement: float
    doubtful_variance: float
    unidentified_variance: float
    modes: dict[int, float]
    n_needed: dict[int | str, float]
    averages: dict[int, float]
    skewness: npt.NDArray[np.float64]
    predicted_skewness: npt.NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers ready for JSON; missing ones are None."""
        return {name: plain(value) for name, value in vars(self).items()}


def overview(found: xr.Dataset) -> Overview:
    """Return the numbers of the whole scene from the dataset of `analyze`.

    Numbers that need variables that the dataset lacks are NaN, or empty.
    """
    p_value, rejected, skewness = (
        _values(found, f"normality_{name}", transform="log", test="anderson-darling")
        for name in ("p_value", "rejected", "skewness")
    )
    distance = _values(found, "best_goodness_effect", fit_test="kolmogorov-smirnov")
    margin, known = _values(found, "margin"), np.isfinite(_values(found, "tail_coverage"))
    tested = "averages_rejected" in found  # of luminance alone, other variables have the sizes
    sizes = [found.isel(size=i) for i in range(found.sizes.get("size", 0) * tested)]
    families, held_out = (
        {name: pooled.value for name, pooled in pooled_shares(found, variable).items()}
        if variable in found
        else {}
        for variable in ("best_family", "held_out_best_family")
    )
    needed: dict[int | str, float] = {}
    if "averages_n_needed" in found:
        counted = _counted(found["averages_n_needed"].values, missing=UNTESTED)
        named = {"more" if n == MORE_THAN_TESTED else n: share for n, share in counted.items()}
        needed = dict(sorted(named.items(), key=lambda item: item[0] == "more"))
    return Overview(
        pixels=int(found.sizes["y"] * found.sizes["x"]),
        spp=int((found["count"] + found["bad_count"]).max()),
        null_share=float(found["null_share"].mean()),
        null_pixels=float((found["null_share"].values > 0.5).mean()),
        bad_samples=int(found["bad_count"].sum()),
        variation=_quartiles(found["coefficient_of_variation"].values),
        families=families,
        families_held_out=held_out,
        decided=_share(margin > 10, np.isfinite(margin)),
        misfit=_quartiles(distance),
        log_rejected=_share(rejected == 1, np.isfinite(p_value)),
        log_skewness=_quartiles(skewness),
        patterns={p.name: float(found[p.name].mean()) for p in PATTERNS},
        label_agreement=float(found["label_agreement"].attrs["kappa"]),
        doubtful_variance=_share(_values(found, "tail_variance_suspect"), known),
        unidentified_variance=_share(_values(found, "tail_variance_unidentified"), known),
        modes=_counted(_values(found, "modality_modes"), missing=0),
        n_needed=needed,
        averages={
            int(part["size"]): _share(
                part["averages_rejected"] == 1, part["averages_p_value"].notnull()
            )
            for part in sizes
        },
        skewness=np.array([_quartiles(part["averages_skewness"].values) for part in sizes])
        .reshape(-1, 3)
        .T,
        predicted_skewness=np.array(
            [_quartiles(part["averages_predicted_skewness"].values)[1] for part in sizes]
        ),
    )


_NOISIEST = 0.1
"""Share of the pixels that count as the noisiest."""


@dataclass(frozen=True)
class NoiseShares:
    """Where the noise of an image is.

    Attributes
    ----------
    noisiest
        Share of the relative variance in the noisiest tenth of the pixels; NaN if there is no
        variance.
    pixels, share
        Share of the image with each primary pattern that occurs, and share of the relative variance
        in these pixels; by name, the largest variance first.
    """

    noisiest: float
    pixels: dict[str, float]
    share: dict[str, float]

    @property
    def label(self) -> str:
        """The primary pattern whose pixels hold most of the variance."""
        return next(iter(self.share))

    def __bool__(self) -> bool:
        """Return whether the samples of any pixel vary."""
        return math.isfinite(self.noisiest)


def noise_of(found: xr.Dataset) -> NoiseShares:
    """Return where the relative variance of luminance is, weighted as in relMSE."""
    variance, shown = _relative_variance(found), _labelled(found)
    total = float(variance.sum()) or np.nan
    count = max(1, round(_NOISIEST * variance.size))
    held = {name: float(variance[here].sum()) / total for name, here in shown.items()}
    held = dict(sorted(held.items(), key=lambda item: -item[1]))
    return NoiseShares(
        noisiest=float(np.sort(variance, axis=None)[::-1][:count].sum()) / total,
        pixels={name: float(shown[name].mean()) for name in held},
        share=held,
    )


def _relative_variance(found: xr.Dataset) -> Floats:
    mean = found["luminance_mean"].values
    spread = found["coefficient_of_variation"].values * mean
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = spread**2 / relative_scale(mean)
    return np.where(np.isfinite(variance), variance, 0.0)


def _labelled(found: xr.Dataset) -> dict[str, npt.NDArray[np.bool_]]:
    """Return where each primary label that occurs is."""
    shown = {
        name: found["label"].values == code
        for code, name in flag_names(found["label"].attrs).items()
    }
    return {name: here for name, here in shown.items() if here.any()}


@dataclass(frozen=True)
class NoiseIntervals:
    """How sure it is where the noise of an image is: intervals over blocks of pixels.

    Attributes
    ----------
    share
        Share of the relative variance in the pixels of each primary pattern, by name.
    lead
        How much more the first of these patterns holds than any other.
    """

    share: dict[str, Interval[float]]
    lead: Interval[float]


def noise_intervals(found: xr.Dataset, noise: NoiseShares, blocks: Blocks) -> NoiseIntervals:
    """Return intervals of the shares of the noise."""
    shown, variance = _labelled(found), _relative_variance(found).ravel()
    held = blocks.sums(np.stack([variance * shown[n].ravel() for n in noise.share], axis=-1))

    def shares(weights: Floats) -> Floats:
        sums = weights @ held
        return np.asarray(sums / sums.sum(axis=1, keepdims=True))

    def lead(weights: Floats) -> Floats:
        first, *others = shares(weights).T
        return np.asarray(first - np.max([np.zeros_like(first), *others], axis=0))

    def of_label(place: int) -> Interval[float]:
        return interval_of(lambda w: shares(w)[:, place], blocks, bounds=(0.0, 1.0))

    each = {name: of_label(i) for i, name in enumerate(noise.share)}
    return NoiseIntervals(each, interval_of(lead, blocks))


@dataclass(frozen=True)
class Bodies:
    """What describes the samples of luminance, as shares of the pixels with 95 % intervals.

    Attributes
    ----------
    bodies
        Share of each of `chdstat.patterns.definitions.BODIES` among the pixels where one is known.
    gaussian_logarithms
        Share of the pixels in which normality of the logarithms is not rejected.
    gaussian_averages
        Share of the pixels whose averages pass for Gaussian from N samples on, or from fewer, by N.
    level
        False discovery rate of the rejections over the image.
    n_means
        Number of averages that are tested at each N.
    """

    bodies: dict[str, Interval[float]]
    gaussian_logarithms: Interval[float]
    gaussian_averages: dict[int, Interval[float]]
    level: float
    n_means: int


def bodies_of(found: xr.Dataset, blocks: Blocks) -> Bodies | None:
    """Return what describes the samples of an image, from `patterns_of`; None if nothing does."""
    body = found["body"].values.ravel()
    if not (body >= 0).any():
        return None
    among = {n: np.where(body < 0, np.nan, body == code) for code, n in enumerate(BODIES)}
    rejected = found["luminance_logarithms_rejected"].values.ravel()
    gaussian: dict[int, Interval[float]] = {}
    if "luminance_averages_n_needed" in found:
        needed = found["luminance_averages_n_needed"].values.ravel()
        tested = needed != UNTESTED
        for n in found["size"].values.tolist():
            passed = tested & (needed != MORE_THAN_TESTED) & (needed <= n)
            gaussian[n] = mean_of(np.where(tested, passed, np.nan), blocks)
    return Bodies(
        {name: mean_of(here, blocks) for name, here in among.items()},
        mean_of(1 - rejected.astype(np.float64), blocks),
        gaussian,
        level=float(found.attrs["false_discovery_rate"]),
        n_means=int(found.attrs.get("n_means", 0)),
    )


def key_intervals(found: xr.Dataset, blocks: Blocks) -> dict[str, Interval[float]]:
    """Return null share, share of long tails (both means) and median variation over the pixels."""
    flat = {
        name: found[name].values.reshape(-1).astype(float)
        for name in ("null_share", "coefficient_of_variation", "long_tail")
    }
    averages = {"coefficient_of_variation": quantile_of}
    return {name: averages.get(name, mean_of)(values, blocks) for name, values in flat.items()}


def pooled_shares(found: xr.Dataset, variable: str = "best_family") -> dict[str, Interval[float]]:
    """Return the share of pixel channels that each family describes best, with Wilson intervals."""
    _, *names = flag_names(found[variable].attrs).values()
    counts = np.bincount(1 + found[variable].values.ravel(), minlength=1 + len(names))[1:]
    ends = wilson(counts, counts.sum())
    return {
        name: Interval(_share(count, counts), float(low), float(high))
        for name, count, (low, high) in zip(names, counts, ends, strict=True)
    }


def _counted(codes: npt.NDArray[np.integer], *, missing: int) -> dict[int, float]:
    """Return the share of each code among those that are not missing."""
    values, counts = np.unique(codes[codes != missing], return_counts=True)
    return {int(v): float(c / counts.sum()) for v, c in zip(values, counts, strict=True)}


def _share(part: Any, whole: Any) -> float:
    total = float(np.asarray(whole).sum())
    return float(np.asarray(part).sum()) / total if total else float("nan")


def _values(found: xr.Dataset, name: str, **where: str) -> npt.NDArray[Any]:
    """Return the values of a variable; empty if it was not measured."""
    if name not in found:
        return np.zeros(0)
    there = {dim: value for dim, value in where.items() if dim in found[name].dims}
    return np.asarray(found[name].sel(there))


def _quartiles(of: npt.NDArray[np.floating[Any]]) -> tuple[float, float, float]:
    finite = of[np.isfinite(of)]
    if not finite.size:
        return (np.nan, np.nan, np.nan)
    low, middle, high = np.percentile(finite, (25, 50, 75))
    return float(low), float(middle), float(high)
