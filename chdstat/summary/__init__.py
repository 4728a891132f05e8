"""Summary: what the samples of each pixel look like, in memory that does not grow with spp.

`summarize` returns moments, shares and batch means of each pixel. `histogram` returns linear and
log10 histograms.
"""

from __future__ import annotations

from chdstat.summary.histograms import (
    Histogram,
    StreamingHistogram,
    Support,
    histogram,
    label_histogram,
    linear_support,
)
from chdstat.summary.statistics import Statistics, Summary, summarize

__all__ = [
    "Histogram",
    "Statistics",
    "StreamingHistogram",
    "Summary",
    "Support",
    "histogram",
    "label_histogram",
    "linear_support",
    "summarize",
]
