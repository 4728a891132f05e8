"""Tables of reports: rows of regions, families, patterns and estimators as they are shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat._core.display import between, number, percent, with_interval
from chdstat.analysis import Overview, pooled_shares
from chdstat.comparison import Comparison
from chdstat.comparison.presentation import in_words
from chdstat.comparison.side_by_side import LEVELS, SelfTraining
from chdstat.estimators import MLP
from chdstat.patterns import PATTERNS, Atlas
from chdstat.studies.claims import SceneData
from chdstat.viz.estimators import NAMES
from chdstat.viz.maps import names_of
from chdstat.viz.styling import qualitative

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "atlas_content",
    "estimator_table",
    "family_table",
    "fit_content",
    "label_of",
    "pattern_table",
    "region_table",
    "self_training_content",
]


def label_of(name: str) -> str:
    """Return what text calls an estimator, a family or a pattern."""
    return NAMES.get(name, name)


def fit_content(scene: Overview) -> dict[str, str]:
    """Return how well the families and the log-normal describe the pixels, in numbers."""
    misfit, skewness = scene.misfit, scene.log_skewness
    return {
        "decided": percent(scene.decided),
        "misfit": percent(misfit[1]),
        "misfit_quartiles": f"{percent(misfit[0])} and {percent(misfit[2])}",
        "log_rejected": percent(scene.log_rejected),
        "log_skewness": number(skewness[1]),
        "log_skewness_quartiles": f"{number(skewness[0])} and {number(skewness[2])}",
        "doubtful": percent(scene.doubtful_variance),
        "unidentified": percent(scene.unidentified_variance),
    }


def region_table(data: SceneData) -> list[dict[str, Any]]:
    """Return a row for each region, with the numbers of the pixel in its middle."""
    rows = []
    colors = qualitative(len(data.regions))
    for region, color in zip(data.regions, colors, strict=True):
        y, x = region.center(*data.samples.shape[:2])
        found = data.analysis.isel(y=y, x=x)
        family = names_of(found["luminance_family"])[int(found["luminance_family"])]
        rows.append(
            {
                "name": region.name,
                "pixel": f"({x}, {y})",
                "note": region.note,
                "color": color,
                "radiance": [number(v) for v in np.atleast_1d(found["mean"].values)],
                "nulls": percent(float(found["null_share"])),
                "variation": number(float(found["coefficient_of_variation"])),
                "tail": between(
                    float(found["long_tail_statistic"]), 2 * float(found["long_tail_se"])
                ),
                "family": family,
            }
        )
    return rows


def family_table(found: xr.Dataset) -> list[dict[str, str]]:
    """Return the share of each family by both criteria, over all channels."""
    criteria = {"bic": "best_family", "held_out": "held_out_best_family"}
    columns = {key: pooled_shares(found, name) for key, name in criteria.items() if name in found}
    return [
        {"name": label_of(name)}
        | {
            key: with_interval(shares[name].share, shares[name].low, shares[name].high, percent)
            for key, shares in columns.items()
        }
        for name in columns["bic"]
    ]


def pattern_table(scene: Overview) -> list[dict[str, str]]:
    """Return the rows of the table of patterns, the most frequent first."""
    return [
        {
            "name": label_of(p.name),
            "share": percent(scene.patterns[p.name]),
            "meaning": p.meaning,
            "statistic": p.statistic,
            "rule": p.rule,
        }
        for p in sorted(PATTERNS, key=lambda p: -scene.patterns[p.name])
    ]


def atlas_content(found: Atlas) -> dict[str, str]:
    """Return how many shapes recur, and how far these can be trusted."""
    return {
        "count": str(len(found.share)),
        "repeatable": percent(found.repeatable),
        "stability": number(found.stability),
    }


def estimator_table(comparison: Comparison) -> dict[str, Any]:
    """Return the measures of each estimator, and the settings of the comparison."""
    trained = [m for m in comparison.models.values() if isinstance(m, MLP)]
    return {
        "rows": [in_words(row) for row in comparison.table()],
        "n": comparison.n,
        "batches": comparison.batches,
        "excluded": comparison.excluded,
        "test_pixels": int(comparison.test_pixels.sum()),
        "iterations": int(trained[0].history.iteration[-1]) if trained else 0,
        "train_pixels": len(trained[0].train_pixels) if trained else 0,
        "fewer_pixels": bool(trained) and len(trained[0].train_pixels) < trained[0].config.pixels,
    }


def self_training_content(trained: SelfTraining) -> dict[str, Any]:
    """Return the errors of an estimate without a reference, and the coverage of its intervals."""
    _, row = trained.comparison.table()
    shares = [percent(measured[LEVELS.index(0.9)]) for measured in trained.coverage.values()]
    return {
        "n": trained.comparison.n,
        "iterations": trained.iterations,
        "mse_ratio": number(row["mse_ratio"]),
        "relmse_ratio": number(row["relmse_ratio"]),
        "improved": percent(row["improved"]),
        "bias": percent(row["bias"], sign=True),
        "at_90": shares[0],
        "at_90_supervised": shares[1],
    }
