"""Families: whether the most frequent elementary distribution is gamma-like (finding 14)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.resampling import Blocks, Interval, interval_of, least_of
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData
from chdstat.studies.scene_data import SceneData

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["measure"]

Floats = npt.NDArray[np.float64]


def measure(data: SceneData) -> Outcome:
    """Compare the share of gamma among the best families with that of the next frequent one."""
    analysis, blocks = data.analysis, data.whole().blocks
    names = _names(analysis)
    if "gamma" not in names:
        return Outcome(missing=("needs fits of gamma distributions",))
    counts = _counts(analysis, "best_family", names)
    if not counts.sum():
        return Outcome(missing=("needs pixels with enough positive samples to fit",))
    lead = _lead(counts, blocks, list(names).index("gamma"))
    shares = {name: _share(counts[:, [i]], counts, blocks) for i, name in enumerate(names)}
    return Outcome(
        (ClaimTest.of("share of gamma less that of the next family", lead, least=0.0),),
        details={
            "shares": {name: vars(share) for name, share in shares.items()},
            **_more(analysis, names, counts, blocks),
        },
        plot_data=PlotData(
            "bars",
            {name: (np.zeros(1), np.array([s.value])) for name, s in shares.items()},
            y_label="share of pixel channels",
        ),
    )


def _more(
    analysis: xr.Dataset, names: dict[str, int], counts: Floats, blocks: Blocks
) -> dict[str, Any]:
    """Return other readings of "gamma-like", for whoever prefers one.

    Gamma and Weibull together are the generalised gamma distributions of one shape (Stacy 1962,
    doi:10.1214/aoms/1177704481).
    """
    kin = [i for i, name in enumerate(names) if name in ("gamma", "weibull")]
    found: dict[str, Any] = {
        "gamma_or_weibull": vars(_share(counts[:, kin], counts, blocks)),
        "pixels_that_gamma_describes": float(analysis["gamma_like"].mean()),
    }
    if "held_out_best_family" in analysis:
        held_out = _counts(analysis, "held_out_best_family", names)
        gamma = held_out[:, [list(names).index("gamma")]]
        found["gamma_by_held_out_likelihood"] = vars(_share(gamma, held_out, blocks))
    return found


def _counts(analysis: xr.Dataset, variable: str, names: dict[str, int]) -> Floats:
    """Return in how many channels of each pixel each family is best, shape (pixel, family)."""
    best = analysis[variable].to_numpy()
    member = (best[..., np.newaxis] == list(names.values())).sum(axis=2)
    return np.asarray(member.reshape(-1, len(names)), dtype=np.float64)


def _names(analysis: xr.Dataset) -> dict[str, int]:
    """Return the code of each family by its name."""
    about = analysis["best_family"].attrs
    codes = np.atleast_1d(about["flag_values"]).tolist()
    names = dict(zip(str(about["flag_meanings"]).split(), codes, strict=True))
    return {name: code for name, code in names.items() if code >= 0}


def _lead(counts: Floats, blocks: Blocks, gamma: int) -> Interval[float]:
    """Return the least lead of gamma over another family."""
    sums = blocks.sums(counts)

    def lead(weights: Floats) -> Floats:
        total = weights @ sums
        shares = total / total.sum(axis=1, keepdims=True)
        return np.asarray(shares[:, [gamma]] - np.delete(shares, gamma, axis=1))

    return least_of(lead, blocks, bounds=(-1.0, 1.0))


def _share(some: Floats, counts: Floats, blocks: Blocks) -> Interval[float]:
    part, whole = blocks.sums(some.sum(axis=1)), blocks.sums(counts.sum(axis=1))
    return interval_of(lambda w: (w @ part) / (w @ whole), blocks, bounds=(0.0, 1.0))
