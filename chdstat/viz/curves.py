"""Curves: how averages become Gaussian, and how training goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from chdstat.viz.lettering import verbatim
from chdstat.viz.style import CHANNELS, PALETTE, WIDTH, style

__all__ = ["averages", "training"]

Array = npt.NDArray[Any]


def averages(
    sizes: npt.ArrayLike,
    rejected: Mapping[str, npt.ArrayLike],
    skewness: npt.ArrayLike,
    predicted: npt.ArrayLike,
    *,
    alpha: float,
    scale: Literal["linear", "log"] = "linear",
) -> Figure:
    """Draw how far averages of N samples are from Gaussian.

    What the central limit theorem promises of skewness falls as 1 / sqrt(N): on a logarithmic scale
    it is a straight line of slope -1/2, and samples that depend on each other depart from it.

    Parameters
    ----------
    sizes
        N, shape (size,).
    rejected
        By name of the subject, the share of pixels whose averages are told from Gaussian,
        shape (size,).
    skewness
        Quartiles over the pixels of the skewness of averages, shape (3, size).
    predicted
        Median over the pixels of the skewness that the central limit theorem promises, (size,).
    alpha
        The false-discovery rate, drawn as a line.
    scale
        Of skewness. "log" leaves out what is not positive.
    """
    n = np.asarray(sizes)
    low, middle, high = np.asarray(skewness, dtype=float)
    with style():
        figure = Figure(figsize=(WIDTH, 2.3), layout="constrained")
        left, right = figure.subplots(1, 2)
        for i, (name, share) in enumerate(rejected.items()):
            color, marker = CHANNELS.get(name, PALETTE[4 + i % 4]), "os^D"[i % 4]
            label = verbatim(name)
            left.plot(n, np.asarray(share), marker=marker, markersize=3.5, color=color, label=label)
        left.axhline(alpha, color="#888888", linewidth=0.8, linestyle=":")
        left.set(ylim=(0, 1.02), ylabel="share told from Gaussian")
        left.legend(loc="best")
        right.fill_between(n, low, high, color=PALETTE[1], alpha=0.35, linewidth=0)
        right.plot(n, middle, marker="o", markersize=3.5, color=PALETTE[4], label="measured")
        right.plot(
            n, np.asarray(predicted), color=PALETTE[5], linestyle="--", label=r"CLT: $1/\sqrt{N}$"
        )
        right.set(ylabel="skewness of averages")
        right.legend(loc="lower left" if scale == "log" else "upper right")
        if scale == "log":
            right.set_yscale("log", nonpositive="mask")
            right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            right.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        for axes in (left, right):
            axes.set_xscale("log", base=2)
            axes.set_xticks(n, [str(v) for v in n])
            axes.minorticks_off()
            axes.set_xlabel("samples in an average, N")
    return figure


def training(
    iterations: npt.ArrayLike,
    losses: Mapping[str, npt.ArrayLike],
    baseline: Mapping[str, float],
) -> Figure:
    """Draw a model's loss over its training against the error of the sample mean.

    Parameters
    ----------
    iterations
        Shape (record,).
    losses
        Squared error by name ("training", "validation"), shape (record,).
    baseline
        Squared error of the sample mean on the same batches, by the same names.
    """
    with style():
        figure = Figure(figsize=(WIDTH * 0.49, 2.3), layout="constrained")
        axes = figure.subplots()
        for i, (name, values) in enumerate(losses.items()):
            color = (PALETTE[1], PALETTE[4])[i % 2]
            axes.plot(np.asarray(iterations), np.asarray(values), color=color, label=name)
            if name in baseline:
                label = f"sample mean, {name}"
                axes.axhline(baseline[name], color=color, linewidth=0.9, ls="--", label=label)
        axes.set(xlabel="iteration", ylabel="squared error", yscale="log")
        axes.set_xlim(left=0)
        if baseline:  # a few spikes of the optimiser must not squeeze the rest
            axes.set_ylim(top=3 * max(baseline.values()))
        figure.legend(loc="outside upper center", ncols=2)
    return figure
