"""Analysis: everything that the library computes per pixel, in one dataset, and its overview.

`analyze` returns the dataset; `overview` summarises it as a scene in a few numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image, Seed, is_bad, seed_number, whole
from chdstat._core.files import release, unused, writing
from chdstat._core.moments import Moments
from chdstat._core.positive import Part, PositivePart
from chdstat._core.statistic import RADIANCE, Mapped, Result, Statistic, result, variable
from chdstat._core.work import checkpoints, in_order
from chdstat.errors import InputError
from chdstat.fit.goodness_of_fit import GoodnessOfFit
from chdstat.fit.mixtures import MixtureFit
from chdstat.fit.selection import FamilySelection
from chdstat.fit.tail import TailIndex
from chdstat.inference.averages import N_MEANS, NormalityOfMeans, sizes_of_means
from chdstat.inference.modes import ModalMixture, Modes
from chdstat.inference.normality import TESTS, Normality
from chdstat.patterns.classification import Classification
from chdstat.patterns.overview import Overview, Share, overview, pooled_shares
from chdstat.patterns.pixel_statistics import Thresholds
from chdstat.samples import ImageLike, checkpoint_key, samples_of
from chdstat.samples.tiles import Work, assemble, tiles
from chdstat.summary.histograms import Histogram
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from distributed import Client

    from chdstat.rendering import Rendering

__all__ = ["Overview", "Share", "analyze", "overview", "pooled_shares", "save", "to_dataframe"]

_PREFIXED = ("modality", "normality", "averages")
"""Stages whose variables carry their name."""
_AT_ONCE = 2**26
"""Bytes of maps that are written together."""
_COMMENT = (
    "where tail_variance_suspect, the moments behind this may be infinite: do not trust it; "
    "where tail_variance_unidentified, the samples do not identify them"
)


def analyze(
    samples: ImageLike | xr.Dataset | Rendering | npt.ArrayLike,
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
        The image: `Samples`, an array (y, x, channel, sample), or the path of a store. Of a
        rendering, as `chdstat.rendering.render_batches` makes it, no samples are kept; of it, and
        of the dataset that `summarize` returns, there are statistics, histograms, and what follows
        from these: families, their goodness, and mixtures.
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
        Folder that keeps every tile as soon as it is analysed, until all are; what else is in it
        stays. The same call, after it was stopped in whatever way, goes on from there.

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

    Raises
    ------
    InputError
        If an option is out of range, or a rendering or a summary is given with `thresholds` or
        without `held_out`.
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
    import xarray as xr

    resamples, seed = whole("resamples", resamples, least=0), seed_number(seed)
    given: Any = samples
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
            # What was drawn is kept until all that follows from it is there.
            folder = drawn_tiles.folder if drawn_tiles else None
            return _of_summary(summary, resamples, seed, progress, client, folder)
    if hasattr(given, "data_vars"):
        return _of_summary(given, resamples, seed, progress, client)
    samples, thresholds = samples_of(given), thresholds or Thresholds()
    statistics: dict[str, Statistic[Any]] = {
        "luminance": _LuminanceMoments(),
        "selection": FamilySelection(held_out=held_out),
        "goodness": GoodnessOfFit(resamples=resamples, seed=seed),
        "tail": TailIndex(),
        "mixture": ModalMixture(),
        "modality": Modes(),
        "normality": Normality(("log", "sqrt", "linear"), tuple(TESTS)),
        "patterns": Classification(thresholds),
    }
    if samples.spp >= N_MEANS:
        statistics["averages"] = NormalityOfMeans(tuple(sizes_of_means(samples.spp).tolist()))
    of_block = functools.partial(_of_block, statistics)
    known = functools.partial(checkpoint_key, samples)
    with checkpoints(checkpoint, known, thresholds, held_out, resamples, seed) as kept:
        work: Work = {"progress": progress, "client": client, "checkpoint": kept}
        summary = summarize(samples, **work)
        found = samples.map(of_block, logarithms=True, description="analysing", **work)
    # The parts count the same samples; the summary's word on nulls and bad samples stands.
    merged = xr.merge(
        [summary, *_finished(found, statistics)],
        compat="override",
        combine_attrs="drop_conflicts",
        join="override",
    )
    for name in ("skewness", "kurtosis"):
        if "averages" in statistics:
            merged[f"averages_predicted_{name}"].attrs["comment"] = _COMMENT
    return merged.assign_attrs(samples.attrs)


def _of_block(statistics: Mapping[str, Statistic[Any]], block: Image) -> Mapped:
    """Return the variables of all statistics of a tile, by their stages."""
    both = PositivePart.of_pixels(block, rows="both")
    for shared in (FamilySelection(), TailIndex(), ModalMixture()):
        both.measured(shared)
    channels, luminance = both.rows(slice(block.shape[-2])), both.rows(-1)
    return _variables(statistics, {"channels": channels, "luminance": luminance})


def _variables(statistics: Mapping[str, Statistic[Any]], rows: Mapping[str, Part]) -> Mapped:
    return {
        f"{stage}/{name}": variable
        for stage, statistic in statistics.items()
        for name, variable in statistic.variables(rows[statistic.rows].measured(statistic)).items()
    }


def _finished(found: xr.Dataset, statistics: Mapping[str, Statistic[Any]]) -> Iterator[xr.Dataset]:
    """Yield the variables of each stage, finished over the whole image, under their own names."""
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
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(moments.variance) / moments.mean
        return _Luminance(moments.mean, np.where(moments.mean > 0, ratio, np.nan))


def _of_summary(
    summary: xr.Dataset,
    resamples: int,
    seed: int,
    progress: bool | None,
    client: Client | None,
    folder: Path | None = None,
) -> xr.Dataset:
    """Return a summary with what follows from its log histograms, tile by tile, maybe in files."""
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
        "goodness": GoodnessOfFit(resamples=resamples, seed=seed),
        "mixture": MixtureFit(effort="fast"),
    }

    def task(counted: xr.Dataset) -> Mapped:
        part = Histogram.of_dataset(counted).positive
        return _variables(statistics, {"channels": part})

    counted = summary[[str(n) for n in summary if str(n).startswith("log_") or "count" in str(n)]]
    # Tiles are put together by their places, whatever their coordinates.
    counted = counted.drop_vars(["y", "x"], errors="ignore")
    places = [*tiles((height, width, 1, 1))]

    def placed() -> Iterator[tuple[slice, slice, Mapped]]:
        items = (counted.isel(y=ys, x=xs) for ys, xs in places)
        for place, variables in zip(places, in_order(task, items, client=client), strict=True):
            yield *place, variables
            if folder is not None:
                _released(counted)

    image: Any = SimpleNamespace(
        shape=(height, width), channels=tuple(counted["channel"].values), counts=None, attrs={}
    )
    about: Any = {"progress": progress, "folder": folder}
    whole_image = assemble(image, placed(), description="fitting", **about).drop_vars(["y", "x"])
    parts = [*_finished(whole_image, statistics)]
    if folder is not None:
        _released(whole_image)
    return xr.merge([summary, *parts], compat="override").assign_attrs(summary.attrs)


def _released(found: xr.Dataset) -> None:
    """Give back the memory of maps in files, which were read or written."""
    for name in found.data_vars:
        release(found[name].values)


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
        for names in _batches(found):
            found[names].to_zarr(partial, mode="a", consolidated=False)
            for name in names:
                release(found[name].values)
    return target


def _batches(found: xr.Dataset) -> Iterator[list[Hashable]]:
    """Yield names of maps that are written together.

    Every write lists the whole store; and all maps at once may not fit into memory.
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
