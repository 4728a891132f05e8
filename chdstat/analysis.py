"""Analysis: everything that the library computes per pixel, in one dataset, and its overview.

`analyze` returns the dataset; `overview` summarises it as a scene in a few numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, is_bad, plain, seed_number, whole
from chdstat._core.cache import checkpoints
from chdstat._core.files import release, unused, writing
from chdstat._core.moments import Moments
from chdstat._core.positive import Counts, PositivePart
from chdstat._core.resampling import wilson
from chdstat.fit.families import SELECTED, fit_variables, label_fit
from chdstat.fit.goodness_of_fit import finish_goodness, goodness_of_part, goodness_variables
from chdstat.fit.mixtures import Mixture
from chdstat.fit.selection import family_shares, finish_selection, selection_variables
from chdstat.fit.tail_fits import finish_tail, tail_variables
from chdstat.inference import modes, normality
from chdstat.inference import normality_of_means as means
from chdstat.inference.normality import TESTS, TestName, Transform
from chdstat.inference.normality_of_means import MORE_THAN_TESTED, N_MEANS, UNTESTED
from chdstat.patterns import classification
from chdstat.patterns.pixel_statistics import PixelFits, Thresholds
from chdstat.patterns.table import PATTERNS
from chdstat.samples import Image, Mapped, checkpoint_key, samples_of
from chdstat.samples.tiles import Work
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from distributed import Client

__all__ = ["Overview", "Share", "analyze", "overview", "pooled_shares", "save", "to_dataframe"]

_TRANSFORMS: tuple[Transform, ...] = ("log", "sqrt", "linear")
_TESTS: tuple[TestName, ...] = tuple(TESTS)
_TEST_OF_MEANS: TestName = "shapiro-wilk"
_PREFIXED = ("modality", "normality", "averages")
"""Stages whose variables carry their name."""
_COMMENT = (
    "where tail_variance_suspect, the moments behind this may be infinite: do not trust it; "
    "where tail_variance_unidentified, the samples do not identify them"
)


def analyze(
    samples: Image | npt.ArrayLike,
    *,
    thresholds: Thresholds | None = None,
    held_out: bool = True,
    resamples: int = 0,
    seed: Seed = 0,
    progress: bool | None = None,
    client: Client | None = None,
    checkpoint: str | Path | None = None,
) -> xr.Dataset:
    """Return everything per pixel: statistics, fits, tails, modes, normality, patterns.

    Every tile is read, split, sorted and turned into logarithms once for all of it. Fits, tails,
    modes and normality are of each channel, patterns of the luminance.

    Parameters
    ----------
    samples
        The image: `Samples`, an array (y, x, channel, sample), or the path of a store.
    thresholds
        When a pattern counts; None for the defaults.
    held_out
        Compare the families by held-out likelihood, too, which nearly doubles the cost of fits.
    resamples, seed
        Bootstrap replicates of the goodness of the best family, and their seed. Without any, there
        are statistics and effect sizes, but neither p-values nor ``best_goodness_rejected``. Each
        costs about as much as the fits.
    progress
        Show progress bars; None shows them on a terminal.
    client
        A Dask client, whose workers analyse, one tile a task, to the same bits.
    checkpoint
        Folder that keeps every tile as soon as it is analysed, until all are: the same call, after
        it was stopped in whatever way, goes on from there.

    Returns
    -------
    xarray.Dataset
        The variables of `summarize`, `fit.select`, `fit.tail_index` and `classify`; with prefixes,
        those of `modality` (``modality_``), of `gaussianity` (``normality_``), of
        `gaussianity_of_means` (``averages_``), of `fit.mixture` with log-normal components,
        searched as for modes (``lognormal_mixture_``), and of `fit.goodness` for the family that is
        best at each pixel (``best_goodness_``); and, of luminance, ``luminance_mean`` and
        ``coefficient_of_variation`` (y, x). Where there are too few samples for averages, their
        variables are absent. `atlas`, which looks at the image as a whole, is not part of it.
        `chdstat.analysis.to_dataframe` makes a table of it.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> found = chd.analyze(rng.gamma(2.0, size=(2, 2, 3, 256)))
    >>> found["null_share"].shape, found["mean"].dims
    ((2, 2), ('y', 'x', 'channel'))
    """
    import xarray as xr

    resamples, seed = whole("resamples", resamples, least=0), seed_number(seed)
    samples, thresholds = samples_of(samples), thresholds or Thresholds()
    enough = samples.spp >= N_MEANS
    sizes = means.sizes_of_means(samples.spp, test=_TEST_OF_MEANS) if enough else None

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        fits = PixelFits(PositivePart.of_pixels(block, rows="both"), held_out=held_out)
        channels = fits.rows(slice(block.shape[-2]))
        part, tail, selection = channels.part, channels.tail, channels.selection
        goodness = goodness_of_part(part, selection, resamples=resamples, seed=seed)
        tested = normality.gaussianity_of_part(part, _TRANSFORMS, _TESTS)
        patterns = classification.patterns_of(fits.rows(-1), thresholds)
        measured = {
            "luminance": _luminance(block, fits.part.x[..., -1, :]),
            "selection": selection_variables(selection),
            "goodness": goodness_variables(goodness),
            "tail": tail_variables(tail),
            "mixture": fit_variables(channels.mixture),
            "modality": modes.modality_variables(channels.modes),
            "normality": normality.gaussianity_variables(tested),
            "patterns": classification.patterns_variables(patterns),
        }
        if sizes is not None:
            averages = means.means_of_block(block, sizes, test=_TEST_OF_MEANS, tail=tail)
            measured["averages"] = means.means_variables(averages)
        return {
            f"{stage}/{name}": variable
            for stage, variables in measured.items()
            for name, variable in variables.items()
        }

    known = functools.partial(checkpoint_key, samples)
    with checkpoints(checkpoint, known, thresholds, held_out, resamples, seed) as kept:
        work: Work = {"progress": progress, "client": client, "checkpoint": kept}
        summary = summarize(samples, **work)
        found = samples.map(of_block, logarithms=True, description="analysing", **work)
    finishes = _finishes(thresholds, resamples, sizes)
    parts = [_finished(found, stage, finish) for stage, finish in finishes.items()]
    # The parts count the same samples; the summary's word on nulls and bad samples stands.
    merged = xr.merge(
        [summary, *parts], compat="override", combine_attrs="drop_conflicts", join="override"
    )
    if sizes is not None:
        for name in ("skewness", "kurtosis"):
            merged[f"averages_predicted_{name}"].attrs["comment"] = _COMMENT
    return merged.assign_attrs(samples.attrs)


def to_dataframe(found: xr.Dataset) -> pd.DataFrame:
    """Return what an analysis says in one number, or one word, as a row per pixel and channel.

    Variables with further dims, such as histograms, stay in the dataset; those of a pixel are
    repeated for its channels. Codes become words.

    Parameters
    ----------
    found
        What `analyze`, `summarize` or another function returns for an image.

    Returns
    -------
    pandas.DataFrame
        Rows (y, x, channel), or (y, x) where nothing depends on the channel.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> frame = to_dataframe(chd.analyze(rng.gamma(2.0, size=(2, 2, 3, 256)), progress=False))
    >>> len(frame), list(frame.index.names), frame.loc[(1, 0, "R"), "best_family"]
    (12, ['y', 'x', 'channel'], 'gamma')
    """
    dims = [dim for dim in ("y", "x", "channel") if dim in found.dims]
    kept = [name for name, variable in found.items() if {*variable.dims} <= {*dims}]
    frame = found[kept].reset_coords(drop=True).to_dataframe(dim_order=dims)
    for name in kept:
        attrs = found[name].attrs
        if "flag_meanings" in attrs:
            words = zip(
                np.atleast_1d(attrs["flag_values"]), attrs["flag_meanings"].split(), strict=True
            )
            frame[name] = frame[name].map(dict(words)).astype("category")
    return frame


def save(found: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of maps to a new zarr store, which is there when it is complete.

    Raises
    ------
    StoreError
        If something is there already, or it cannot be written.
    """
    target = unused(path)
    with writing(target, folder=True) as partial:
        for name in found.data_vars:  # one at a time: together they may not fit into memory
            found[[name]].to_zarr(partial, mode="a", consolidated=False)
            release(found[name].values)
    return target


def _finishes(
    thresholds: Thresholds, resamples: int, sizes: Counts | None
) -> dict[str, Callable[[xr.Dataset], xr.Dataset]]:
    """Return what is done with each stage once the image is whole, by name."""
    finish: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
        "luminance": _label_luminance,
        "selection": lambda d: finish_selection(d, list(SELECTED), "bic"),
        "goodness": lambda d: finish_goodness(d, "best", resamples=resamples),
        "tail": finish_tail,
        "mixture": lambda d: label_fit(d, "lognormal", Mixture),
        "modality": modes.finish_modality,
        "normality": lambda d: normality.finish_gaussianity(d, transform=_TRANSFORMS, test=_TESTS),
        "patterns": lambda d: classification.finish_patterns(d, thresholds),
    }
    if sizes is not None:
        finish["averages"] = lambda d: means.finish_means(
            d, sizes, n_means=N_MEANS, test=_TEST_OF_MEANS
        )
    return finish


def _finished(
    found: xr.Dataset, stage: str, finish: Callable[[xr.Dataset], xr.Dataset]
) -> xr.Dataset:
    """Return the variables of a stage, finished over the whole image, under their own names."""
    own = {str(n): str(n).partition("/")[2] for n in found if str(n).startswith(f"{stage}/")}
    dataset = finish(found[list(own)].rename(own))
    prefix = f"{stage}_" if stage in _PREFIXED else ""
    return dataset.rename({str(n): f"{prefix}{n}" for n in dataset.data_vars})


def _luminance(block: npt.NDArray[np.float32], luminance: npt.NDArray[Any]) -> Mapped:
    """Return mean and coefficient of variation of the luminance of every pixel."""
    good = ~np.asarray(is_bad(block).any(axis=-2))
    moments = Moments.of(np.where(good, luminance, 0), good)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: npt.NDArray[Any] = np.sqrt(moments.variance) / moments.mean
    variation = np.where(moments.mean > 0, ratio, np.nan)
    return {"luminance_mean": ((), moments.mean), "coefficient_of_variation": ((), variation)}


def _label_luminance(dataset: xr.Dataset) -> xr.Dataset:
    dataset["luminance_mean"].attrs.update(long_name="mean luminance", units="W sr-1 m-2")
    dataset["coefficient_of_variation"].attrs.update(
        long_name="standard deviation over mean of luminance", units="1"
    )
    return dataset


_TEST = {"transform": "log", "test": "anderson-darling"}
"""Which of the tests of normality is in the overview."""


@dataclass(frozen=True)
class Overview:
    """A scene in a few numbers, from what `analyze` finds of its pixels.

    Attributes
    ----------
    pixels, spp
        What was analysed.
    null_share
        Share of null samples over the image.
    null_pixels
        Share of the pixels of which more than half the samples are null.
    bad_samples
        Bad samples over the image.
    variation
        Quartiles over the pixels of the coefficient of variation of luminance.
    families, families_held_out
        Share of the pixel channels that each family describes best, by name: by BIC, and by
        held-out likelihood; the latter is empty where it was not asked for.
    decided
        Share of the choices by BIC that are very strong: a margin above 10.
    misfit
        Quartiles over the pixel channels of the largest distance between the distribution functions
        of the samples and of their best family.
    log_rejected, log_skewness
        Share of the pixel channels in which normality of log samples is rejected, and quartiles of
        their skewness.
    patterns
        Share of the pixels that show each pattern, by name.
    label_agreement
        Kappa of the primary labels of neighbours: 0 as by chance, 1 for complete agreement.
    doubtful_variance
        Share of the pixel channels with an estimated tail index of at least 1/2, beyond which the
        variance of a generalised Pareto tail is infinite.
    unidentified_variance
        Share of those whose samples do not identify whether their variance is finite.
    modes
        Share of the pixel channels with 1, 2, 3 modes of log radiance, by their number.
    n_needed
        By N, the share of pixel channels whose averages pass for Gaussian from N samples on; 'more'
        for those whose averages do not at any N that was tested.
    averages
        By N, the share of pixel channels in which normality of averages of N samples is rejected.
    skewness, predicted_skewness
        Of these averages: quartiles (3, size), and the median of what independence predicts.
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
        """Return the numbers ready for JSON; what could not be computed is None."""
        return {name: plain(value) for name, value in vars(self).items()}


def overview(found: xr.Dataset) -> Overview:
    """Return the numbers of the whole scene from the dataset of `analyze`."""
    log = found[["normality_p_value", "normality_rejected", "normality_skewness"]].sel(_TEST)
    distance = found["best_goodness_effect"].sel(fit_test="kolmogorov-smirnov")
    null = found["null_share"].values
    known = found["tail_index"].notnull()
    averages, skewness, predicted = _averages(found)
    return Overview(
        pixels=int(found.sizes["y"] * found.sizes["x"]),
        spp=int((found["count"] + found["bad_count"]).max()),
        null_share=_share(found["null_count"], found["count"]),
        null_pixels=float((null > 0.5).mean()),
        bad_samples=int(found["bad_count"].sum()),
        variation=_quartiles(found["coefficient_of_variation"].values),
        families=_family_shares(found, "best_family"),
        families_held_out=_family_shares(found, "held_out_best_family"),
        decided=_share(found["margin"] > 10, found["margin"].notnull()),
        misfit=_quartiles(distance.values),
        log_rejected=_share(log["normality_rejected"] == 1, log["normality_p_value"].notnull()),
        log_skewness=_quartiles(log["normality_skewness"].values),
        patterns={p.name: float(found[p.name].mean()) for p in PATTERNS},
        label_agreement=float(found["label_agreement"].attrs["kappa"]),
        doubtful_variance=_share(found["tail_variance_suspect"], known),
        unidentified_variance=_share(found["tail_variance_unidentified"], known),
        modes=_counted(found["modality_modes"].values, missing=0),
        n_needed=_n_needed(found),
        averages=averages,
        skewness=skewness,
        predicted_skewness=predicted,
    )


def _averages(
    found: xr.Dataset,
) -> tuple[dict[int, float], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return rejected shares by N, quartiles of skewness, and its median prediction."""
    if "averages_rejected" not in found:
        return {}, np.empty((3, 0)), np.empty(0)
    sizes = found["size"].values
    shares = {
        int(n): _share(
            found["averages_rejected"].isel(size=i) == 1,
            found["averages_p_value"].isel(size=i).notnull(),
        )
        for i, n in enumerate(sizes)
    }
    measured = [
        _quartiles(found["averages_skewness"].isel(size=i).values) for i in range(len(sizes))
    ]
    predicted = found["averages_predicted_skewness"]
    medians = [_quartiles(predicted.isel(size=i).values)[1] for i in range(len(sizes))]
    return shares, np.array(measured).T, np.array(medians)


class Share(NamedTuple):
    """A share with its Wilson interval."""

    share: float
    low: float
    high: float


def pooled_shares(found: xr.Dataset, variable: str = "best_family") -> dict[str, Share]:
    """Return how often each family describes a pixel channel best, all channels together."""
    shares = family_shares(found, variable=variable)
    total = int(shares["n_pixels"].sum())
    counts = (shares["family_share"].fillna(0) * shares["n_pixels"]).sum("channel").round()
    interval = wilson(counts.values, np.full(counts.shape, total))
    return {
        str(name): Share(float(count) / total if total else np.nan, float(low), float(high))
        for name, count, (low, high) in zip(
            counts["family"].values, counts.values, interval, strict=True
        )
    }


def _family_shares(found: xr.Dataset, variable: str) -> dict[str, float]:
    if variable not in found:
        return {}
    return {name: pooled.share for name, pooled in pooled_shares(found, variable).items()}


def _n_needed(found: xr.Dataset) -> dict[int | str, float]:
    if "averages_n_needed" not in found:
        return {}
    counted = _counted(found["averages_n_needed"].values, missing=UNTESTED)
    named = {"more" if n == MORE_THAN_TESTED else n: share for n, share in counted.items()}
    return dict(sorted(named.items(), key=lambda item: item[0] == "more"))


def _counted(codes: npt.NDArray[np.integer], *, missing: int) -> dict[int, float]:
    """Return the share of each code among those that are not missing."""
    values, counts = np.unique(codes[codes != missing], return_counts=True)
    return {int(v): float(c / counts.sum()) for v, c in zip(values, counts, strict=True)}


def _share(part: Any, whole: Any) -> float:
    total = float(np.asarray(whole).sum())
    return float(np.asarray(part).sum()) / total if total else float("nan")


def _quartiles(values: npt.NDArray[Any]) -> tuple[float, float, float]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return (np.nan, np.nan, np.nan)
    low, middle, high = np.percentile(finite, (25, 50, 75))
    return float(low), float(middle), float(high)
