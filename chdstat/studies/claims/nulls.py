"""Nulls: how many samples find no light, by region (finding 1)."""

from __future__ import annotations

import numpy as np

from chdstat._core.resampling import mean_of
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData
from chdstat.studies.scene_data import PixelSet, SceneData

__all__ = ["EXPECTED", "NEAR", "measure"]

NEAR = (0.45, 0.75)
"""Indirect light: "around 60 %" (Elek et al. 2019, section 5.1), give or take 15 points."""
EXPECTED = {
    "night-room": (0.5, 1.0),
    "day-room": (0.0, 0.2),
    "white-room": (0.0, 0.2),
    "gallery": (0.0, 0.2),
}
"""Share over the image by scene: "often exceeding 50 %" by night, "typically under 20 %" in the
gallery, "low numbers" in the white room by day, for which the paper gives no figure."""


def measure(data: SceneData) -> Outcome:
    """Compare the share of nulls with what the paper reports of such a scene."""
    scene = EXPECTED.get(data.name)
    patch = data.patch("indirect") if scene is None else data.whole()
    if patch is None:
        return Outcome(missing=("needs a region of indirect light",))
    least, most = NEAR if scene is None else scene
    share = data.summary["null_share"].to_numpy()
    found = mean_of(patch.take(share), patch.blocks)
    where = "the indirect regions" if scene is None else "the image"
    named = _by_region(data, share)
    known = share[np.isfinite(share)]
    return Outcome(
        (ClaimTest.of(f"share of nulls in {where}", found, least=least, most=most),),
        details={"by_region": named, "image": float(known.mean()) if known.size else None},
        plot_data=PlotData(
            "bars",
            {name: (np.zeros(1), np.array([value])) for name, value in named.items()},
            y_label="share of nulls",
        ),
    )


def _by_region(data: SceneData, share: np.ndarray) -> dict[str, float]:
    if not data.regions:
        return {}
    patch = PixelSet.of(data.regions, *data.samples.shape[:2])
    return patch.by_region(patch.take(share))
