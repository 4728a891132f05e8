"""Overview: a scene in a few numbers, from what `chdstat.analyze` finds of its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import plain
from chdstat._core.resampling import Blocks, Interval, mean_of, median_of, wilson
from chdstat.fit.selection import family_shares
from chdstat.inference.averages import MORE_THAN_TESTED, UNTESTED
from chdstat.patterns.table import PATTERNS

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Noise", "Overview", "Share", "key_intervals", "noise_of", "overview", "pooled_shares"]

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
    known = found["tail_index"].notnull()
    sizes = [found.isel(size=i) for i in range(found.sizes.get("size", 0))]
    families, held_out = (
        {name: pooled.share for name, pooled in pooled_shares(found, variable).items()}
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
        null_share=_share(found["null_count"], found["count"]),
        null_pixels=float((found["null_share"].values > 0.5).mean()),
        bad_samples=int(found["bad_count"].sum()),
        variation=_quartiles(found["coefficient_of_variation"]),
        families=families,
        families_held_out=held_out,
        decided=_share(found["margin"] > 10, found["margin"].notnull()),
        misfit=_quartiles(distance),
        log_rejected=_share(log["normality_rejected"] == 1, log["normality_p_value"].notnull()),
        log_skewness=_quartiles(log["normality_skewness"]),
        patterns={p.name: float(found[p.name].mean()) for p in PATTERNS},
        label_agreement=float(found["label_agreement"].attrs["kappa"]),
        doubtful_variance=_share(found["tail_variance_suspect"], known),
        unidentified_variance=_share(found["tail_variance_unidentified"], known),
        modes=_counted(found["modality_modes"].values, missing=0),
        n_needed=needed,
        averages={
            int(part["size"]): _share(
                part["averages_rejected"] == 1, part["averages_p_value"].notnull()
            )
            for part in sizes
        },
        skewness=np.array([_quartiles(part["averages_skewness"]) for part in sizes])
        .reshape(-1, 3)
        .T,
        predicted_skewness=np.array(
            [_quartiles(part["averages_predicted_skewness"])[1] for part in sizes]
        ),
    )


_NOISIEST = 0.1
"""Share of the pixels that are called the noisiest."""
_LIT = 0.01
"""Part of the squared mean radiance of the image that keeps relative variances finite, as in the
relative squared error of `chdstat.compare`."""


@dataclass(frozen=True)
class Noise:
    """Where the noise of an image is.

    Attributes
    ----------
    noisiest
        Share of the relative variance that the noisiest tenth of the pixels holds.
    label
        The primary pattern whose pixels hold most of it.
    share, pixels
        How much these hold, and what share of the image they are.
    """

    noisiest: float
    label: str
    share: float
    pixels: float


def noise_of(found: xr.Dataset) -> Noise:
    """Return where the relative variance of luminance is, as relMSE weighs it."""
    mean = found["luminance_mean"].values
    spread = found["coefficient_of_variation"].values * mean
    typical = float(mean[np.isfinite(mean)].mean()) if np.isfinite(mean).any() else np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = spread**2 / (mean**2 + _LIT * typical**2)
    variance = np.where(np.isfinite(variance), variance, 0.0)
    total = float(variance.sum()) or np.nan
    count = max(1, round(_NOISIEST * variance.size))
    labels, attrs = found["label"].values, found["label"].attrs
    names = dict(zip(attrs["flag_values"], attrs["flag_meanings"].split(), strict=True))
    held = {code: float(variance[labels == code].sum()) for code in names}
    most = max(held, key=lambda code: held[code])
    return Noise(
        noisiest=float(np.sort(variance, axis=None)[::-1][:count].sum()) / total,
        label=names[most],
        share=held[most] / total,
        pixels=float((labels == most).mean()),
    )


def key_intervals(found: xr.Dataset, blocks: Blocks) -> dict[str, Interval[float]]:
    """Return the mean null share and share of long tails, and the median variation, over pixels."""
    flat = {
        name: found[name].values.reshape(-1).astype(float)
        for name in ("null_share", "coefficient_of_variation", "long_tail")
    }
    averages = {"coefficient_of_variation": median_of}
    return {name: averages.get(name, mean_of)(values, blocks) for name, values in flat.items()}


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


def _counted(codes: npt.NDArray[np.integer], *, missing: int) -> dict[int, float]:
    """Return the share of each code among those that are not missing."""
    values, counts = np.unique(codes[codes != missing], return_counts=True)
    return {int(v): float(c / counts.sum()) for v, c in zip(values, counts, strict=True)}


def _share(part: Any, whole: Any) -> float:
    total = float(np.asarray(whole).sum())
    return float(np.asarray(part).sum()) / total if total else float("nan")


def _quartiles(of: xr.DataArray) -> tuple[float, float, float]:
    finite = of.values[np.isfinite(of.values)]
    if not finite.size:
        return (np.nan, np.nan, np.nan)
    low, middle, high = np.percentile(finite, (25, 50, 75))
    return float(low), float(middle), float(high)
