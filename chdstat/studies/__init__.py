"""Studies: several scenes rendered, analysed, and tested for all claims of the paper.

`study` returns a `Study`, with a table of verdicts, JSON and a PDF. `bench` compares estimators on
several scenes against converged references, and returns a `Bench` with a `Case` for each scene and
number of samples.
"""

from __future__ import annotations

from chdstat.studies.benchmark import Bench, Case, bench
from chdstat.studies.studies import SceneStudy, Study, study

__all__ = ["Bench", "Case", "SceneStudy", "Study", "bench", "study"]


def __dir__() -> list[str]:
    return sorted(__all__)
