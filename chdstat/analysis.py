"""Analysis: everything that the library says about the pixels of an image, in one dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import is_bad, luminance
from chdstat._moments import Moments
from chdstat.errors import StoreError
from chdstat.fit import select
from chdstat.normality import gaussianity, gaussianity_of_means
from chdstat.patterns import classify
from chdstat.samples import Mapped, Samples
from chdstat.summary import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Overview", "analyze", "overview", "save", "unused"]

_MEANS = 16
"""Averages of each size that are tested: so few, so that N reaches spp / 16."""


def analyze(samples: Samples, *, progress: bool | None = None) -> xr.Dataset:
    """Return everything per pixel: statistics, fits, normality, patterns.

    Parameters
    ----------
    samples
        The image.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    xarray.Dataset
        The variables of `summarize`, `fit.select` and `classify`; those of `gaussianity` of log
        samples with the prefix ``log_normality_``, those of `gaussianity_of_means` with
        ``averages_``; and ``luminance_mean``, ``coefficient_of_variation`` (y, x). Where there are
        too few samples for averages, their variables are absent.

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

    stages: list[Callable[[], xr.Dataset]] = [
        lambda: summarize(samples, progress=progress),
        lambda: _luminance(samples, progress),
        lambda: select(samples, progress=progress),
        lambda: _prefixed(gaussianity(samples, progress=progress), "log_normality"),
        lambda: classify(samples, progress=progress),
    ]
    if samples.spp >= _MEANS:
        stages.append(
            lambda: _prefixed(
                gaussianity_of_means(samples, n_means=_MEANS, progress=progress), "averages"
            )
        )
    parts = [stage() for stage in stages]
    # The parts count the same samples; the summary's word on nulls and bad samples stands.
    merged = xr.merge(parts, compat="override", combine_attrs="drop_conflicts", join="override")
    return merged.assign_attrs(samples.attrs)


def save(found: xr.Dataset, path: str | Path) -> Path:
    """Write a dataset of maps to a new zarr store.

    Raises
    ------
    StoreError
        If something is there already, or it cannot be written.
    """
    target = unused(path)
    try:
        found.to_zarr(target, mode="w-", consolidated=False)
    except OSError as error:
        message = f"cannot write {target}: {error.strerror or error}"
        raise StoreError(message) from error
    return target


def unused(path: str | Path) -> Path:
    """Return a path to write to, or raise StoreError if something is there already."""
    target = Path(path)
    if target.exists():
        message = f"{target} exists; nothing was overwritten. Give another path or move it away"
        raise StoreError(message)
    return target


@dataclass(frozen=True)
class Overview:
    """A scene in a few numbers, from what `analyze` says of its pixels.

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
    families
        Share of the pixel channels that each family describes best, by name.
    decided
        Share of those choices that are very strong: a BIC margin above 10.
    log_rejected, log_skewness
        Share of the pixel channels whose log samples are told from Gaussian, and quartiles of
        their skewness.
    long_tails
        Share of the pixels with a long tail.
    doubtful_variance
        Share of the pixels with an estimated tail index of at least 1/2, beyond which the
        variance of a generalised Pareto tail is infinite.
    bimodal
        Share of the pixels with two modes.
    averages
        By N, the share of pixel channels whose averages of N samples are told from Gaussian.
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
    decided: float
    log_rejected: float
    log_skewness: tuple[float, float, float]
    long_tails: float
    doubtful_variance: float
    bimodal: float
    averages: dict[int, float]
    skewness: npt.NDArray[np.float64]
    predicted_skewness: npt.NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers ready for JSON; what could not be computed is None."""
        return {name: _plain(value) for name, value in vars(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list, np.ndarray)):
        return [_plain(item) for item in value]
    number = float(value)
    if not np.isfinite(number):
        return None
    return int(value) if isinstance(value, (int, np.integer)) else number


def overview(found: xr.Dataset) -> Overview:
    """Return the numbers of the whole scene from the dataset of `analyze`."""
    tested = found["log_normality_p_value"].notnull()
    null = found["null_share"].values
    tail = found["long_tail_statistic"].values
    averages, skewness, predicted = _averages(found)
    return Overview(
        pixels=int(found.sizes["y"] * found.sizes["x"]),
        spp=int((found["count"] + found["bad_count"]).max()),
        null_share=_share(found["null_count"], found["count"]),
        null_pixels=float((null > 0.5).mean()),
        bad_samples=int(found["bad_count"].sum()),
        variation=_quartiles(found["coefficient_of_variation"].values),
        families=_family_shares(found),
        decided=float((found["margin"] > 10).sum() / max(1, int(found["margin"].notnull().sum()))),
        log_rejected=_share(found["log_normality_rejected"], tested),
        log_skewness=_quartiles(found["log_normality_skewness"].values),
        long_tails=float(found["long_tail"].mean()),
        doubtful_variance=_share(tail >= 0.5, np.isfinite(tail)),
        bimodal=float(found["bimodal"].mean()),
        averages=averages,
        skewness=skewness,
        predicted_skewness=predicted,
    )


def _averages(
    found: xr.Dataset,
) -> tuple[dict[int, float], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return shares told from Gaussian by N, quartiles of skewness, and its median prediction."""
    if "averages_rejected" not in found:
        return {}, np.empty((3, 0)), np.empty(0)
    sizes = found["size"].values
    shares = {
        int(n): _share(
            found["averages_rejected"].isel(size=i),
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


def _family_shares(found: xr.Dataset) -> dict[str, float]:
    best = found["best_family"]
    names = dict(
        zip(best.attrs["flag_values"], str(best.attrs["flag_meanings"]).split(), strict=True)
    )
    fitted = best.values[best.values >= 0]
    return {
        n: float((fitted == c).mean()) if fitted.size else np.nan
        for c, n in names.items()
        if c >= 0
    }


def _share(part: Any, whole: Any) -> float:
    total = float(np.asarray(whole).sum())
    return float(np.asarray(part).sum()) / total if total else float("nan")


def _quartiles(values: npt.NDArray[Any]) -> tuple[float, float, float]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return (np.nan, np.nan, np.nan)
    low, middle, high = np.percentile(finite, (25, 50, 75))
    return float(low), float(middle), float(high)


def _prefixed(dataset: xr.Dataset, prefix: str) -> xr.Dataset:
    return dataset.rename({str(name): f"{prefix}_{name}" for name in dataset.data_vars})


def _luminance(samples: Samples, progress: bool | None) -> xr.Dataset:
    """Return mean and coefficient of variation of the luminance of every pixel."""

    def of_block(block: npt.NDArray[np.float32]) -> Mapped:
        good = np.asarray(~is_bad(block).any(axis=-2))
        moments = Moments.of(np.where(good, luminance(block), 0), good)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio: npt.NDArray[Any] = np.sqrt(moments.variance) / moments.mean
        variation = np.where(moments.mean > 0, ratio, np.nan)
        return {"luminance_mean": ((), moments.mean), "coefficient_of_variation": ((), variation)}

    dataset = samples.map(of_block, description="measuring luminance", progress=progress)
    dataset["luminance_mean"].attrs.update(long_name="mean luminance", units="W sr-1 m-2")
    dataset["coefficient_of_variation"].attrs.update(
        long_name="standard deviation over mean of luminance", units="1"
    )
    return dataset
