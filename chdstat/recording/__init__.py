"""Recording: samples of any renderer that draws one sample per pixel from a seed."""

from __future__ import annotations

from chdstat.recording.pass_sources import DrawnPass, PassSource
from chdstat.recording.recordings import record

__all__ = ["DrawnPass", "PassSource", "record"]


def __dir__() -> list[str]:
    return sorted(__all__)
