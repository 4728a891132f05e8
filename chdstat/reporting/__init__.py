"""Report: a PDF about a scene or its finished samples.

`report` runs the whole flow and typesets the results.
"""

from __future__ import annotations

from chdstat.reporting.scene_report import report

__all__ = ["report"]
