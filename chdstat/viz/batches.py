"""Batches: what a renderer sees of a pixel at a time, and what its averages make of it.

After the first figure of Elek et al. 2019: histograms of many batches superimposed, and below them
the histogram of their means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from chdstat.errors import InputError
from chdstat.viz.lettering import verbatim
from chdstat.viz.style import WIDTH, qualitative, style

__all__ = ["BatchPanel", "batch_histograms"]

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class BatchPanel:
    """Batches of samples of one pixel and channel.

    Parameters
    ----------
    name
        Title.
    edges
        Edges of the bins of radiance, shape (bin + 1,).
    counts
        Samples of each batch in each bin, shape (batch, bin).
    mean_edges, mean_counts
        The same of the means of the batches, shapes (bin + 1,) and (bin,).
    expected
        Mean of all samples, drawn as a dashed line.
    """

    name: str
    edges: Array
    counts: Array
    mean_edges: Array
    mean_counts: Array
    expected: float


def batch_histograms(panels: Sequence[BatchPanel], *, number: int, size: int) -> Figure:
    """Draw superimposed histograms of batches and, below, those of their means.

    Parameters
    ----------
    panels
        Pixels, side by side.
    number, size
        How many batches there are, and samples in each.

    Raises
    ------
    InputError
        If there is no panel.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(0).gamma(0.5, size=(64, 32))
    >>> edges = np.linspace(0, 5, 41)
    >>> counts = np.stack([np.histogram(batch, edges)[0] for batch in x])
    >>> means = np.histogram(x.mean(axis=1), 20)
    >>> panel = BatchPanel("wall", edges, counts, means[1], means[0], 0.5)
    >>> len(batch_histograms([panel], number=64, size=32).axes)
    2
    """
    if not panels:
        message = "batch_histograms needs at least one pixel, got none"
        raise InputError(message)
    colors = qualitative(len(panels))
    with style():
        width = WIDTH * min(1.0, 0.26 * len(panels))
        figure = Figure(figsize=(width, 2.1), layout="constrained")
        axes = figure.subplots(2, len(panels), squeeze=False)
        for (upper, lower), panel, color in zip(axes.T, panels, colors, strict=True):
            alpha = min(0.5, max(0.03, 2.5 / len(panel.counts)))
            outlines = [*_outlines(panel)]
            upper.add_collection(PolyCollection(outlines, facecolor=color, lw=0, alpha=alpha))
            upper.stairs(panel.counts.mean(axis=0), panel.edges, color="#222222", linewidth=0.6)
            lower.stairs(panel.mean_counts, panel.mean_edges, fill=True, color=color)
            for cell in (upper, lower):
                cell.axvline(panel.expected, color="black", linewidth=0.9, linestyle="--")
                cell.set(yticks=[])
                cell.set_xlim(left=min(0.0, float(np.min(panel.edges))))
                cell.locator_params(axis="x", nbins=3)
                cell.spines["left"].set_visible(False)
            top = float(np.max(panel.counts[:, 1:], initial=0))
            upper.set_ylim(0, 1.15 * top or 1.0)
            upper.set_title(verbatim(panel.name), fontsize=8)
        axes[0, 0].set_ylabel(f"{number} batches\nof {size} samples")
        axes[1, 0].set_ylabel(f"their {number}\nmeans")
        figure.supxlabel("radiance in W sr$^{-1}$ m$^{-2}$", fontsize=8)
    return figure


def _outlines(panel: BatchPanel) -> npt.NDArray[np.float64]:
    """Return the outline of each batch's histogram, shape (batch, corner, 2): drawn as one."""
    counts = np.asarray(panel.counts, dtype=np.float64)
    x = np.repeat(panel.edges, 2)
    y = np.pad(np.repeat(counts, 2, axis=1), ((0, 0), (1, 1)))
    return np.stack([np.broadcast_to(x, y.shape), y], axis=-1)
