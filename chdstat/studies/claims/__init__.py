"""Claims of the paper as numbers with intervals and verdicts, on any scene.

`SceneData` holds what is known of a scene, `find` tests all claims on it and returns a `Finding`
for each; `FINDINGS` lists the claims, each with the function that measures it.
"""

from __future__ import annotations

from chdstat.studies.claim import Claim
from chdstat.studies.claims.findings import FINDINGS, find
from chdstat.studies.outcomes import ClaimTest, Finding, PlotData
from chdstat.studies.scene_data import SceneData

__all__ = ["FINDINGS", "Claim", "ClaimTest", "Finding", "PlotData", "SceneData", "find"]
