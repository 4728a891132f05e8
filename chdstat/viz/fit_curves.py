"""Curves of fits, tails and modes, drawn from the results alone, without samples.

`fit_curve` draws the density of fits and mixtures, `tail_curve` how a tail falls, `mode_stems`
where modes are. A result of a few pixels or channels has a curve for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from chdstat._core.arrays import Array
from chdstat._core.display import Width, number, percent
from chdstat.errors import InputError
from chdstat.fit import Fit, Mixture, Tail
from chdstat.inference.modes import Modality
from chdstat.viz.chd import DASHES, LINES
from chdstat.viz.estimators import called
from chdstat.viz.styling import UNIT, axes_in, name_ticks, style

__all__ = ["fit_curve", "mode_stems", "tail_curve"]

_HEIGHT = 1.7
_MOST = 6
"""Rows of a result that have room in one panel."""
_POINTS = 300
_SEEN = 1e-3
"""Share of a fit beyond either end of its curve, and of the positive samples below a tail's."""


def _rows(count: int) -> list[dict[str, Any]]:
    """Return how the curve of each row looks, with its label where there are several.

    Raises
    ------
    InputError
        If there are too many.
    """
    if count > _MOST:
        message = f"expected a result of at most {_MOST} rows to draw, got {count}; take some"
        raise InputError(message)
    return [
        {
            "color": LINES[i],
            "linestyle": DASHES[i],
            "label": f"row {i}" if count > 1 else None,
        }
        for i in range(count)
    ]


def _finished(ax: Axes, looks: Sequence[Any]) -> Axes:
    """Name the rows; say so where nothing could be drawn."""
    if not ax.has_data():
        ax.annotate("not fitted", (0.5, 0.5), xycoords="axes fraction", ha="center")
        ax.set_axis_off()
    elif len(looks) > 1:
        ax.legend(handlelength=1.8)
    return ax


@style()
def fit_curve(found: Fit, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw the density of a fit or a mixture per decade of radiance, and the share of zeros.

    The area below the curve is 1 minus that share. Components of a single mixture are dotted; its
    atoms are stems, as high as their share.

    Parameters
    ----------
    found
        A fit of one or a few rows.
    width
        Of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If the fit has more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).gamma(2.0, size=500)
    >>> fit_curve(chd.fit.gamma(x)).get_xlabel().startswith("radiance")
    True
    """
    zero = np.atleast_1d(found.zero_share).ravel()
    looks = _rows(zero.size)
    ax = axes_in(ax, _HEIGHT, width)
    share, rows = (1 - zero)[:, np.newaxis], np.arange(zero.size)
    inside = zero[:, np.newaxis] + share * np.array([_SEEN, 1 - _SEEN])
    ends = found.ppf(inside.ravel()).reshape(zero.size, zero.size, 2)[rows, rows]
    known = np.isfinite(ends).all(axis=1) & (ends > 0).all(axis=1)
    ax.set_xscale("log")
    if known.any():
        x = np.geomspace(ends[known].min(), ends[known].max(), _POINTS)
        scale = x * np.log(10)
        density = share * found.pdf(x).reshape(zero.size, -1) * scale
        for i in np.flatnonzero(known):
            ax.plot(x, density[i], **looks[i])
        if isinstance(found, Mixture) and zero.size == 1:
            _draw_parts(ax, found, x, scale * share[0])
        ax.set_ylim(bottom=0)
    note = f"{percent(float(zero[0]))} at 0" if zero.size == 1 and known.any() else ""
    ax.set_title(note, loc="right", color="#444444")
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="density per decade", title=called(found.name))
    return _finished(ax, looks)


def _draw_parts(ax: Axes, found: Mixture, x: Array, scale: Array) -> None:
    """Draw the components and the atoms of a mixture of one row."""
    for part in found.component_pdf(x):
        ax.plot(x, part * scale, color="#777777", linewidth=0.8, linestyle=":")
    atoms, shares = (np.ravel(v) for v in (found.atoms, found.atom_weights))
    at = np.isfinite(atoms) & (atoms > 0)
    if at.any():
        other = ax.twinx()
        other.vlines(atoms[at], 0, shares[at], color="#444444", linewidth=1.4)
        other.set(ylim=(0, None), ylabel="share of atoms")


@style()
def tail_curve(found: Tail, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw the share of the positive samples above each radiance of a tail, on log scales.

    A power law is a straight line. Thin lines are exponential tails that begin alike.

    Parameters
    ----------
    found
        Tails of one or a few rows.
    width
        Of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).pareto(1.5, size=2000)
    >>> tail_curve(chd.fit.tail_index(x)).get_yscale()
    'log'
    """
    rows = (found.xi, found.scale, found.threshold, found.share)
    xis, scales, thresholds, shares = (np.atleast_1d(v).ravel() for v in rows)
    looks = _rows(xis.size)
    ax = axes_in(ax, _HEIGHT, width)
    ax.set(xscale="log", yscale="log")
    for xi, scale, start, share, look in zip(xis, scales, thresholds, shares, looks, strict=True):
        if not (np.isfinite(xi) and scale > 0 and start > 0):
            continue
        left = np.geomspace(1, _SEEN, _POINTS)  # of the samples in the tail
        excess = -np.log(left) if abs(xi) < 1e-9 else (left**-xi - 1) / xi
        ax.plot(start + scale * excess, share * left, **look)
        faint: dict[str, Any] = {"color": look["color"], "linewidth": 0.6, "linestyle": ":"}
        ax.plot(start - scale * np.log(left), share * left, **faint)
    name_ticks(ax.xaxis)
    one = f"tail index {number(xis[0])}" if xis.size == 1 else "tails"
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="share above it", title=one)
    return _finished(ax, looks)


@style()
def mode_stems(found: Modality, *, width: Width = "column", ax: Axes | None = None) -> Axes:
    """Draw where the modes are, each as high as the share of the samples that belongs to it.

    Parameters
    ----------
    found
        Modes of one or a few rows.
    width
        Of the figure: "column", "page" or inches.
    ax
        Where to draw; None makes a figure.

    Raises
    ------
    InputError
        If there are more than six rows.

    Examples
    --------
    >>> import chdstat as chd
    >>> x = np.random.default_rng(0).lognormal(np.repeat([0, 5], 200))
    >>> len(mode_stems(chd.modality(x)).collections)
    1
    """
    places, weights = (v.reshape(-1, v.shape[-1]) for v in (found.places, found.weights))
    looks = _rows(len(places))
    ax = axes_in(ax, _HEIGHT, width)
    ax.set_xscale("log")
    for place, weight, look in zip(places, weights, looks, strict=True):
        at = np.isfinite(place)
        if at.any():
            ax.vlines(10 ** place[at], 0, weight[at], linewidth=1.6, **look)
            ax.plot(10 ** place[at], weight[at], "o", color=look["color"], markersize=3.5)
    if ax.has_data():
        low, high = ax.get_xlim()
        ax.set(xlim=(low / 3, 3 * high), ylim=(0, 1.05))
    modes = int(np.ravel(found.modes)[0]) if len(places) == 1 else 0
    title = f"{modes} mode{'s' * (modes != 1)}" if modes else "modes"
    ax.set(xlabel=f"radiance ({UNIT})", ylabel="share", title=title)
    return _finished(ax, looks)
