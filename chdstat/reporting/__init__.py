"""Report: a PDF about a scene or its finished samples.

`report` runs the whole flow and typesets the results. Studies, several renders and the paper's
experiment are typeset here, too.
"""

from __future__ import annotations

from chdstat.reporting import paper_report as _paper  # noqa: F401 - typesets its results
from chdstat.reporting import ranking_report as _ranking  # noqa: F401 - the same
from chdstat.reporting.scene_report import report

__all__ = ["report"]
