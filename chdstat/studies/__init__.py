"""Studies: several scenes rendered, analysed, and asked for all claims of the paper.

`study` runs the whole of it and returns a `Study`, with a table of verdicts, JSON and a PDF.
"""

from __future__ import annotations

from chdstat.studies.results import SceneStudy, Study
from chdstat.studies.run import study

__all__ = ["SceneStudy", "Study", "study"]
