"""Claims: those of the paper as numbers with intervals and verdicts, on any scene.

`Evidence` holds what is known of a scene, `find` looks for all claims in it and returns a `Finding`
for each; `FINDINGS` lists the claims, each with the function that looks for it.
"""

from __future__ import annotations

from chdstat.studies.claims.registry import FINDINGS, Claim, find
from chdstat.studies.outcomes import Exhibit, Finding, Part, Statistic
from chdstat.studies.scene_data import Evidence

__all__ = ["FINDINGS", "Claim", "Evidence", "Exhibit", "Finding", "Part", "Statistic", "find"]
