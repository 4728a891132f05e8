"""Extents: the part of the plane that each panel shows.

Computed here and not in the browser: Bokeh's own data ranges answer each change of theirs to the
server, eighteen messages a click.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from chdstat.explorer.series import Panel

__all__ = ["LOG_X", "LOG_Y", "Extent", "extent"]

LOG_X = frozenset({"log", "qq", "running"})
LOG_Y = frozenset({"qq"})
"""Panels whose axes are logarithmic."""
_DENSITIES = frozenset({"linear", "log", "averages"})
"""Those that stand on the axis."""
_MARGIN = 0.04
_TINY = 1e-300

Extent = tuple[float, float]
Floats = npt.NDArray[np.float64]


def extent(name: str, panel: Panel) -> tuple[Extent, Extent] | None:
    """Return what a panel shows across and up: all that it draws, and a margin; None for nothing.

    Examples
    --------
    >>> from chdstat.explorer.series import Trace
    >>> line = Trace(np.array([0.0, 10.0]), np.array([1.0, 2.0]), "#ffffff")
    >>> extent("linear", Panel(lines=[line]))
    ((-0.4, 10.4), (0.0, 2.08))
    """
    traces = (*panel.areas, *panel.lines)
    marks = np.array([mark[0] for mark in panel.marks])
    across = _span([*(t.x for t in traces), marks], log=name in LOG_X)
    up = _span([t.y for t in traces], log=name in LOG_Y)
    if across is None or up is None:
        return None
    if name in _DENSITIES:
        return _padded(across, log=name in LOG_X), (0.0, up[1] * (1 + _MARGIN))
    return _padded(across, log=name in LOG_X), _padded(up, log=name in LOG_Y)


def _span(parts: Iterable[npt.ArrayLike], *, log: bool) -> Extent | None:
    whole = np.concatenate([np.empty(0), *(np.asarray(part, np.float64) for part in parts)])
    shown: Floats = whole[np.isfinite(whole) & ((whole > _TINY) if log else True)]
    return (float(shown.min()), float(shown.max())) if shown.size else None


def _padded(span: Extent, *, log: bool) -> Extent:
    """Return a span with a margin; one value alone gets a tenth, or a factor of two, around it."""
    low, high = np.log10(span) if log else span
    alone = np.log10(2) if log else 0.1 * abs(low) or 1.0
    margin = _MARGIN * (high - low) if high > low else alone
    ends = np.array([low - margin, high + margin])
    start, end = 10.0**ends if log else ends
    return float(start), float(end)
