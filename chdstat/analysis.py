"""Analysis: everything that the library says about the pixels of an image, in one dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import is_bad, whole
from chdstat._core.files import replacing, unused
from chdstat._fitted import Fitted
from chdstat._moments import Moments
from chdstat._positive import PositivePart
from chdstat._rows import Result
from chdstat.errors import StoreError
from chdstat.fit.goodness_of_fit import goodness_of_part
from chdstat.fit.goodness_results import Goodness, finish_goodness, goodness_variables
from chdstat.fit.mixture_results import finish_mixture, mixture_variables
from chdstat.fit.selection import SELECTED, finish_selection, selection_variables
from chdstat.fit.tail_results import finish_tail, tail_variables
from chdstat.modes import finish_modality, modality_variables
from chdstat.normality import (
    N_MEANS,
    finish_gaussianity,
    finish_means,
    gaussianity_of_part,
    gaussianity_variables,
    means_of_block,
    means_variables,
    sizes_of_means,
)
from chdstat.normality._tests import TESTS, TestName, Transform
from chdstat.patterns import Thresholds, finish_patterns, patterns_variables
from chdstat.samples import Mapped, Samples
from chdstat.summary import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["analyze", "save"]

_TRANSFORMS: tuple[Transform, ...] = ("log", "sqrt", "linear")
_TESTS: tuple[TestName, ...] = tuple(TESTS)
_TEST_OF_MEANS: TestName = "shapiro-wilk"
_COMMENT = (
    "where tail_variance_suspect, the moments behind this may be infinite: do not trust it; "
    "where tail_variance_unidentified, the samples cannot tell"
)


def analyze(
    samples: Samples,
    *,
    thresholds: Thresholds | None = None,
    held_out: bool = True,
    resamples: int = 0,
    seed: int = 0,
    progress: bool | None = None,
) -> xr.Dataset:
    """Return everything per pixel: statistics, fits, tails, modes, normality, patterns.

    Every tile is read, split, sorted and turned into logarithms once for all of it. Fits, tails,
    modes and normality are of each channel, patterns of the luminance.

    Parameters
    ----------
    samples
        The image.
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

    Returns
    -------
    xarray.Dataset
        The variables of `summarize`, `fit.select`, `fit.tail_index` and `classify`; with prefixes,
        those of `modality` (``modality_``), of `gaussianity` (``normality_``), of
        `gaussianity_of_means` (``averages_``), of `fit.mixture` with log-normal components,
        searched as for modes (``lognormal_mixture_``), and of `fit.goodness` for the family that is
        best at each pixel (``best_goodness_``); and, of luminance, ``luminance_mean`` and
        ``coefficient_of_variation`` (y, x). Where there are too few samples for averages, their
        variables are absent. `atlas`, which looks at the image as a whole, is apart.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.gamma(2.0, size=(2, 2, 3, 256)))
    >>> found = chd.analyze(samples)
    >>> found["null_share"].shape, found["mean"].dims
    ((2, 2), ('y', 'x', 'channel'))
    """
    import xarray as xr

    resamples = whole("resamples", resamples, least=0)
    seed = whole("seed", seed, least=0)
    summary = summarize(samples, progress=progress)
    stages = _stages(samples.spp, thresholds or Thresholds(), resamples, seed)

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        tile = _Tile(block, held_out=held_out)
        return {
            f"{i}/{name}": variable
            for i, stage in enumerate(stages)
            for name, variable in stage.measure(tile).items()
        }

    found = samples.map(of_block, logarithms=True, description="analysing", progress=progress)
    parts = [stage.finished(found, f"{i}/") for i, stage in enumerate(stages)]
    # The parts count the same samples; the summary's word on nulls and bad samples stands.
    merged = xr.merge(
        [summary, *parts], compat="override", combine_attrs="drop_conflicts", join="override"
    )
    if "averages_predicted_kurtosis" in merged:
        for name in ("skewness", "kurtosis"):
            merged[f"averages_predicted_{name}"].attrs["comment"] = _COMMENT
    return merged.assign_attrs(samples.attrs)


def save(found: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of maps to a new zarr store, which is there when it is complete.

    Raises
    ------
    StoreError
        If something is there already, or it cannot be written.
    """
    target = unused(path)
    try:
        with replacing(target, folder=True) as partial:
            found.to_zarr(partial, mode="w-", consolidated=False)
    except OSError as error:
        message = f"cannot write {target}: {error.strerror or error}"
        raise StoreError(message) from error
    return target


class _Tile(Fitted):
    """A tile of samples, with its luminance as one more channel, and what several stages need."""

    def __init__(self, block: npt.NDArray[np.float32], *, held_out: bool) -> None:
        super().__init__(PositivePart.of_pixels(block, rows="both"), held_out=held_out)
        self.block = block
        self._channels = block.shape[-2]

    def of_channels(self, result: Result) -> Result:
        return self.of_first(result, self._channels)

    def goodness(self, resamples: int, seed: int) -> Goodness:
        part, selection = self.of_channels(self.part), self.of_channels(self.selection)
        return goodness_of_part(part, selection, resamples=resamples, seed=seed)


@dataclass(frozen=True)
class _Stage:
    """One part of the analysis: measured tile by tile, finished over the whole image."""

    measure: Callable[[_Tile], Mapped]
    finish: Callable[[xr.Dataset], xr.Dataset]
    prefix: str = ""

    def finished(self, found: xr.Dataset, key: str) -> xr.Dataset:
        own = {str(n): str(n).removeprefix(key) for n in found.data_vars if str(n).startswith(key)}
        dataset = self.finish(found[list(own)].rename(own))
        return dataset.rename({str(n): f"{self.prefix}{n}" for n in dataset.data_vars})


def _stages(spp: int, thresholds: Thresholds, resamples: int, seed: int) -> list[_Stage]:
    stages = [
        _Stage(_luminance, _label_luminance),
        _Stage(
            lambda t: selection_variables(t.of_channels(t.selection)),
            lambda d: finish_selection(d, list(SELECTED), "bic"),
        ),
        _Stage(
            lambda t: goodness_variables(t.goodness(resamples, seed)),
            lambda d: finish_goodness(d, "best", resamples=resamples),
        ),
        _Stage(lambda t: tail_variables(t.of_channels(t.tail)), finish_tail),
        _Stage(
            lambda t: mixture_variables(t.of_channels(t.mixture)),
            lambda d: finish_mixture(d, "lognormal"),
        ),
        _Stage(lambda t: modality_variables(t.of_channels(t.modes)), finish_modality, "modality_"),
        _Stage(
            lambda t: gaussianity_variables(
                gaussianity_of_part(t.of_channels(t.part), _TRANSFORMS, _TESTS)
            ),
            lambda d: finish_gaussianity(d, transform=_TRANSFORMS, test=_TESTS),
            "normality_",
        ),
        _Stage(
            lambda t: patterns_variables(t.patterns(thresholds)),
            lambda d: finish_patterns(d, thresholds),
        ),
    ]
    if spp >= N_MEANS:
        sizes = sizes_of_means(spp, test=_TEST_OF_MEANS)
        stages.append(
            _Stage(
                lambda t: means_variables(
                    means_of_block(t.block, sizes, test=_TEST_OF_MEANS, tail=t.of_channels(t.tail))
                ),
                lambda d: finish_means(d, sizes, n_means=N_MEANS, test=_TEST_OF_MEANS),
                "averages_",
            )
        )
    return stages


def _luminance(tile: _Tile) -> Mapped:
    """Return mean and coefficient of variation of the luminance of every pixel."""
    good = ~np.asarray(is_bad(tile.block).any(axis=-2))
    luminance = tile.part.x[..., -1, :]
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
