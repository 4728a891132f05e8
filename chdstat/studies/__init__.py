"""Studies: several scenes rendered, analysed, and tested for all claims of the paper.

`study` returns a `Study`, with a table of verdicts, JSON and a PDF. `bench` compares estimators on
several scenes against converged references, and returns a `Bench` with a `Case` for each scene and
number of samples. `paper` repeats the experiment of Elek, Thomas and Forbes 2019, and returns a
`PaperStudy` with all of its figures.
"""

from __future__ import annotations

from chdstat.studies.benchmark import Bench, Case, bench
from chdstat.studies.paper_study import PaperStudy, paper
from chdstat.studies.studies import SceneStudy, Study, study

__all__ = ["Bench", "Case", "PaperStudy", "SceneStudy", "Study", "bench", "paper", "study"]


def __dir__() -> list[str]:
    return sorted(__all__)
