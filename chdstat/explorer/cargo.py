"""Cargo: panels and colour bars as what travels to the page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.explorer.extents import extent
from chdstat.explorer.maps import Map
from chdstat.explorer.palette import ramp
from chdstat.explorer.series import Panel, Trace
from chdstat.reporting.text import NAMES

__all__ = ["cargo", "colorbar"]


def cargo(panels: Mapping[str, Panel]) -> dict[str, Any]:
    """Return panels as one piece of text: a hundred small arrays would be as many messages.

    All numbers are one array of float64 in base64; traces say how many of them are theirs, x before
    y.
    """
    numbers: list[npt.NDArray[np.float64]] = []

    def packed(traces: Sequence[Trace]) -> list[dict[str, Any]]:
        for trace in traces:
            numbers.extend((np.asarray(trace.x, np.float64), np.asarray(trace.y, np.float64)))
        return [{"n": len(t.x), "color": t.color, "dash": t.dash, "width": t.width} for t in traces]

    found = {
        name: {
            "areas": packed(panel.areas),
            "lines": packed(panel.lines),
            "marks": {"x": [m[0] for m in panel.marks], "color": [m[1] for m in panel.marks]},
            "extent": extent(name, panel),
        }
        for name, panel in panels.items()
    }
    whole = np.concatenate(numbers) if numbers else np.empty(0)
    return {"panels": found, "numbers": base64.b64encode(whole.tobytes()).decode("ascii")}


def colorbar(shown: Map | None) -> dict[str, Any] | None:
    """Return what the shell needs to draw the scale of a map."""
    if shown is None:
        return None
    kind = shown.kind
    bar: dict[str, Any] = {"title": kind.title, "unit": kind.unit}
    if kind.names:
        codes, counts = np.unique(shown.values[np.isfinite(shown.values)], return_counts=True)
        share = dict(zip(codes.astype(int).tolist(), counts / max(1, counts.sum()), strict=True))
        colors = dict(zip(sorted(kind.names), shown.colors, strict=True))
        texts = {code: NAMES.get(name.replace(" ", "_"), name) for code, name in kind.names.items()}
        bar["names"] = {str(code): text for code, text in texts.items()}
        bar["codes"] = [
            (f"{texts[code]} {100 * share[code]:.0f} %", colors[code])
            for code in (sorted(share) if kind.ordered else sorted(share, key=lambda c: -share[c]))
            if code in texts
        ]
        return bar
    low, high = shown.limits
    bar["ramp"] = ramp()[::16]
    bar["ticks"] = [f"{low + (high - low) * i / 4:.3g}" for i in range(5)]
    return bar
