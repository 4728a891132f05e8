"""Report: a scene, or its finished samples, to a PDF of paper quality.

`report` runs the whole flow and typesets it; it computes nothing of its own.
"""

from __future__ import annotations

from chdstat.reporting.scene_report import report

__all__ = ["report"]
