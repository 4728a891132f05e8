"""Studies: several scenes rendered, analysed, and tested for all claims of the paper.

`study` returns a `Study`, with a table of verdicts, JSON and a PDF.
"""

from __future__ import annotations

from chdstat.studies.studies import SceneStudy, Study, study

__all__ = ["SceneStudy", "Study", "study"]


def __dir__() -> list[str]:
    return sorted(__all__)
