"""Families: whether the most frequent elementary distribution is gamma-like (finding 14)."""

from __future__ import annotations

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import Interval, least_of
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, require
from chdstat.studies.scene_data import SceneData, ratio_of

__all__ = ["measure"]


def measure(data: SceneData) -> Outcome:
    """Compare the share of gamma among the best families with that of the next frequent one.

    The details have other readings of "gamma-like": gamma and Weibull together are the generalised
    gamma distributions of one shape (Stacy 1962, doi:10.1214/aoms/1177704481).
    """
    analysis, blocks = data.analysis, data.whole().blocks
    about = analysis["best_family"].attrs
    codes = np.atleast_1d(about["flag_values"]).tolist()
    flags = dict(zip(str(about["flag_meanings"]).split(), codes, strict=True))
    names = [name for name, code in flags.items() if code >= 0]
    require("gamma" in names, "fits of gamma distributions")

    def counts_of(variable: str) -> Floats:
        """Return in how many channels of each pixel each family is best, (pixel, family)."""
        best = analysis[variable].to_numpy()[..., np.newaxis] == [flags[name] for name in names]
        return np.asarray(best.sum(axis=2).reshape(-1, len(names)), dtype=np.float64)

    def share_of(families: list[str], counts: Floats) -> Interval[float]:
        chosen = counts[:, [names.index(family) for family in families]].sum(axis=1)
        return ratio_of(chosen, counts.sum(axis=1), blocks, bounds=(0.0, 1.0))

    def lead(weights: Floats) -> Floats:
        """Return the lead of gamma over each other family."""
        total = weights @ sums
        shares = total / total.sum(axis=1, keepdims=True)
        gamma = names.index("gamma")
        return np.asarray(shares[:, [gamma]] - np.delete(shares, gamma, axis=1))

    counts = counts_of("best_family")
    require(counts.sum(), "pixels with enough positive samples to fit")
    sums = blocks.sums(counts)
    least = least_of(lead, blocks, bounds=(-1.0, 1.0))
    shares = {name: share_of([name], counts) for name in names}
    kin = [name for name in names if name in ("gamma", "weibull")]
    others = {"gamma_or_weibull": share_of(kin, counts)}
    if "held_out_best_family" in analysis:
        held_out = counts_of("held_out_best_family")
        others["gamma_by_held_out_likelihood"] = share_of(["gamma"], held_out)
    return Outcome(
        (ClaimTest("share of gamma less that of the next family", least, least=0.0),),
        details={
            "shares": {name: _ends(share) for name, share in shares.items()},
            **{name: _ends(share) for name, share in others.items()},
            "pixels_that_gamma_describes": float(analysis["gamma_like"].mean()),
        },
        plot_data=PlotData.bars(
            {name: share.value for name, share in shares.items()}, "share of pixel channels"
        ),
    )


def _ends(share: Interval[float]) -> dict[str, float]:
    return {name: getattr(share, name) for name in ("value", "low", "high", "level")}
