"""Nulls: how many samples find no light, by region (finding 1)."""

from __future__ import annotations

import numpy as np

from chdstat._core.resampling import mean_of
from chdstat.studies.outcomes import Conclusion, Exhibit, Part
from chdstat.studies.scene_data import Evidence, Patch

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


def measure(evidence: Evidence) -> Conclusion:
    """Compare the share of nulls with what the paper reports of such a scene."""
    scene = EXPECTED.get(evidence.name)
    patch = evidence.patch("indirect") if scene is None else evidence.whole()
    if patch is None:
        return Conclusion(missing=("needs a region of indirect light",))
    least, most = NEAR if scene is None else scene
    share = evidence.summary["null_share"].to_numpy()
    found = mean_of(patch.take(share), patch.blocks)
    where = "the indirect regions" if scene is None else "the image"
    named = _by_region(evidence, share)
    known = share[np.isfinite(share)]
    return Conclusion(
        (Part.of(f"share of nulls in {where}", found, least=least, most=most),),
        details={"by_region": named, "image": float(known.mean()) if known.size else None},
        exhibit=Exhibit(
            "bars",
            {name: (np.zeros(1), np.array([value])) for name, value in named.items()},
            y_label="share of nulls",
        ),
    )


def _by_region(evidence: Evidence, share: np.ndarray) -> dict[str, float]:
    if not evidence.regions:
        return {}
    patch = Patch.of(evidence.regions, *evidence.samples.shape[:2])
    return patch.by_region(patch.take(share))
