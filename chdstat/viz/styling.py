"""Style: one look for all figures, as a context or decorator that keeps the user's settings.

`page`, `axes_in` and `grid` make figures and axes, as wide as a column, a page or a number of
inches. In a `narrow` figure, panels are placed below each other. Names from users are drawn as
written, in fonts that have their letters: wrap every such name in `verbatim`, and saving in
`spelt`; `families` returns the fonts. `called` says what the names of estimators, families and
patterns are in words.
"""

from __future__ import annotations

import contextlib
import functools
import io
import logging
import math
import re
import warnings
from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib import colormaps, font_manager
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, to_hex, to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from chdstat._core.display import Width
from chdstat.comparison.estimator_choice import DEFAULT_ESTIMATE
from chdstat.errors import InputError, check_option
from chdstat.estimators.registry import LABELS
from chdstat.fit.families import FAMILIES

_WIDTHS = {"column": 3.4, "page": 6.7}
"""Inches of a column of a paper in two columns, and of the text of an A4 page."""

_NARROW = 5.0
"""Width, in inches, below which panels are placed below each other."""

_UPRIGHT = 1.5
"""Largest ratio of height to width of the room for an image."""

_LETTERS = 15
"""Letters of a title per inch."""

HEIGHT = 8.0
"""Largest height of a figure, in inches; it leaves room for a heading and a caption on a page."""

UNIT = r"W$\,$sr$^{-1}\,$m$^{-2}$"
"""Unit of radiance."""

PALETTE = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#0072B2", "#D55E00", "#F0E442", "#4D4D4D")
"""Eight colours that colour-blind readers can distinguish: Okabe and Ito 2008, with dark grey
instead of black."""

MISSING = "#DDDDDD"
"""Colour of pixels without a number."""

MAGNITUDES = ("viridis", "cividis", "magma", "inferno", "gray")
"""Colour maps of numbers without a sign, each even to the eye; the first is taken by default."""

SIGNED = ("PuOr", "RdBu_r", "BrBG_r")
"""Colour maps of numbers to both sides of a middle, for colour-blind readers, too."""

_FEWEST, _TICKS = 2, 7
"""Ticks of a colour bar."""
_LOG_TICKS = (
    *(((1,), 1, 3), ((1, 3), 1, 3), ((1, 2, 5), 1, 2)),
    *(((1,), every, _FEWEST) for every in (2, 3, 5, 10, 20, 50)),
)
"""What a logarithmic one marks: numbers of a decade, every how many decades, at least so many."""

CHANNELS = {"R": "#C8423B", "G": "#45B37A", "B": "#2C4F9E"}
"""Colours of the radiance channels; they also differ in lightness, for prints in grey."""

_SETTINGS: dict[Any, Any] = {
    "axes.edgecolor": "#444444",
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8.5,
    "figure.dpi": 110,
    "figure.facecolor": "white",
    "figure.labelsize": 8,
    "font.size": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "mathtext.fontset": "stix",
    "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
    "ps.fonttype": 42,
    "savefig.dpi": 200,
    "svg.fonttype": "path",
    "svg.hashsalt": "chdstat",
}
for _axis in ("xtick", "ytick"):
    _SETTINGS |= {f"{_axis}.color": "#444444", f"{_axis}.labelsize": 8}
    _SETTINGS |= {f"{_axis}.major.width": 0.6, f"{_axis}.minor.width": 0.4}


@contextlib.contextmanager
def style() -> Iterator[None]:
    """Apply the style of chdstat's figures in a ``with`` block, or in a function it decorates.

    Examples
    --------
    >>> import matplotlib as mpl
    >>> from chdstat.viz import style
    >>> before = mpl.rcParams["font.size"]
    >>> with style():
    ...     mpl.rcParams["font.size"]
    8.0
    >>> mpl.rcParams["font.size"] == before
    True
    """
    with mpl.rc_context(_SETTINGS | {"font.family": list(families())}):
        yield


class StyledFigure(Figure):
    """A figure that keeps the style when it is saved, and that a notebook shows.

    Matplotlib reads settings, such as the kind of fonts, when a figure is saved.
    """

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure, as `matplotlib.figure.Figure.savefig` does, with embedded fonts."""
        with style(), spelt():
            super().savefig(fname, **options)

    def _repr_png_(self) -> bytes:
        return _png_of(self)


def _png_of(figure: Figure) -> bytes:
    """Return a figure as the PNG file that a notebook shows."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi="figure")
    return stream.getvalue()


def inches(width: Width, within: Figure | SubFigure | None = None) -> float:
    """Return the width of a figure in inches: `width`, or that of the figure to draw into.

    Raises
    ------
    InputError
        If the width is neither a name of `_WIDTHS` nor a positive number.

    Examples
    --------
    >>> inches("column"), inches(5)
    (3.4, 5.0)
    """
    if within is not None:
        return float(within.bbox.width / within.dpi)
    if isinstance(width, str):
        check_option("width", width, _WIDTHS)
        return _WIDTHS[width]
    if not 0 < width < math.inf:
        message = f"width must be 'column', 'page' or a number of inches, got {width}"
        raise InputError(message)
    return float(width)


def upright(height: float, width: float) -> float:
    """Return the ratio of height to width of the room for an image: tall images are drawn narrower.

    Examples
    --------
    >>> upright(90, 160), upright(400, 13)
    (0.5625, 1.5)
    """
    return min(height / width, _UPRIGHT)


def narrow(across: float) -> bool:
    """Return whether a figure of so many inches is too narrow for panels side by side."""
    return across < _NARROW


def fitting(across: float, most: int, least: float) -> int:
    """Return how many panels of at least so many inches fit side by side, from 1 to `most`."""
    return max(1, min(most, int(across / least + 1e-6)))


def page(
    fig: Figure | None,
    height: float,
    width: Width = "page",
    *,
    wspace: float | None = None,
    hspace: float | None = None,
) -> Figure:
    """Return the figure to draw into: the given one, or a new one of a size in inches.

    Parameters
    ----------
    fig
        The user's figure; None makes one.
    height, width
        Size of a new figure; no higher than `HEIGHT` inches.
    wspace, hspace
        Space between axes, as a share of their width and height; None for Matplotlib's own.
    """
    if fig is not None:
        return fig
    layout = ConstrainedLayoutEngine(wspace=wspace, hspace=hspace)
    return StyledFigure(figsize=(inches(width), min(height, HEIGHT)), layout=layout)


def two_parts(
    fig: Figure | None, width: Width, height: float, share: float, below: Sequence[float]
) -> tuple[Figure, SubFigure, SubFigure]:
    """Return the figure to draw into and its two parts, one below the other if it is narrow.

    Parameters
    ----------
    fig, width
        As for `page`.
    height, share
        Height of a new figure in inches, and the share of its width for the first part.
    below
        Heights of the parts if one is below the other.
    """
    if narrow(inches(width, fig)):
        figure = page(fig, sum(below), width)
        parts: Any = figure.subfigures(2, 1, height_ratios=below)
    else:
        figure = page(fig, height, width)
        parts = figure.subfigures(1, 2, width_ratios=(share, 1 - share))
    return figure, parts[0], parts[1]


def axes_in(ax: Axes | None, height: float, width: Width) -> Axes:
    """Return the axes to draw into: the given ones, or those of a new figure."""
    return page(None, height, width).subplots() if ax is None else ax


def grow(figure: Figure | SubFigure | None, inches: float) -> None:
    """Make a new figure higher, for a legend; the user's figure is not changed."""
    if isinstance(figure, StyledFigure) and inches > 0:
        figure.set_figheight(min(HEIGHT, figure.get_figheight() + inches))


def grid(
    figure: Figure | SubFigure,
    number: int,
    columns: int,
    *,
    sharey: bool = False,
    width_ratios: Sequence[float] | None = None,
) -> list[Axes]:
    """Return axes in rows of `columns`; the rest of the last row stays empty.

    Raises
    ------
    InputError
        If there is nothing to draw.
    """
    if not number:
        message = "expected at least one panel to draw, got none"
        raise InputError(message)
    rows = -(-number // columns)
    cells = figure.subplots(rows, columns, squeeze=False, sharey=sharey, width_ratios=width_ratios)
    axes = list(cells.flat)
    for empty in axes[number:]:
        empty.remove()
    return axes[:number]


def panels_in(
    fig: Figure | None,
    number: int,
    columns: int,
    height: float,
    width: Width = "page",
    *,
    sharey: bool = False,
    width_ratios: Sequence[float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return the figure to draw into and its axes; see `page` and `grid`."""
    figure = page(fig, height, width)
    return figure, grid(figure, number, columns, sharey=sharey, width_ratios=width_ratios)


def per_cent(share: float, _tick: float = 0) -> str:
    """Return a share in whole per cent; also a formatter for ticks."""
    return f"{100 * share:.0f} %"


def plain_log(axis: Axis, numbers: Sequence[int] = (1, 2, 5)) -> None:
    """Give a logarithmic axis plain tick labels at these numbers times powers of ten."""
    axis.set_major_locator(LogLocator(subs=numbers))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def name_ticks(axis: Axis) -> None:
    """Give a logarithmic axis of few decades labels between powers of ten, too."""
    low, high = axis.get_view_interval()
    if high < 20 * low:
        plain_log(axis)


def swatches(colors: Mapping[str, str], **look: Any) -> list[Artist]:
    """Return coloured lines for a legend."""
    return [Line2D([], [], color=c, label=verbatim(name), **look) for name, c in colors.items()]


def bare(ax: Axes, title: str = "") -> None:
    """Remove ticks and frame from axes that show an image."""
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    ax.set_title(title)


def qualitative(number: int) -> list[str]:
    """Return colours for labels: `PALETTE`, then darker versions, then all of them again.

    Examples
    --------
    >>> len(set(qualitative(16)))
    16
    """
    colors = [*PALETTE, *(_darker(color) for color in PALETTE)]
    return [colors[i % len(colors)] for i in range(number)]


def _darker(color: str) -> str:
    red, green, blue = (0.55 * part for part in to_rgb(color))
    return to_hex((red, green, blue))


def ink_on(color: str) -> str:
    """Return black or white, whichever is more legible on a colour.

    Examples
    --------
    >>> ink_on("#F0E442"), ink_on("#4D4D4D")
    ('black', 'white')
    """
    return "black" if float(np.dot((0.299, 0.587, 0.114), to_rgb(color))) > 0.42 else "white"


def color_map(chosen: str | Colormap | None = None, *, diverging: bool = False) -> Colormap:
    """Return a colour map, whose pixels without a number are light grey.

    Parameters
    ----------
    chosen
        One of Matplotlib's, or its name; None for the first of `MAGNITUDES` or `SIGNED`.
    diverging
        Whether there are numbers to both sides of a middle.

    Raises
    ------
    InputError
        If Matplotlib has no such colour map.
    """
    name = (SIGNED if diverging else MAGNITUDES)[0] if chosen is None else chosen
    if isinstance(name, str) and name not in colormaps:
        message = (
            f"cmap must be the name of one of Matplotlib's colour maps, such as "
            f"{', '.join((*MAGNITUDES, *SIGNED))}; got {name!r}"
        )
        raise InputError(message)
    return (colormaps[name] if isinstance(name, str) else name).with_extremes(bad=MISSING)


def color_limits(
    values: npt.ArrayLike, *, diverging: bool = False, log: bool = False
) -> tuple[float, float]:
    """Return the ends of a colour scale: the 1st and 99th percentile of what is finite.

    Where the scale is diverging, both ends are as far from its middle, which is 0, or 1 where it is
    logarithmic.

    Examples
    --------
    >>> color_limits([0.0, 2.0, np.nan]), color_limits([-1.0, -1.0, 0.5], diverging=True)
    ((0.02, 1.98), (-1.0, 1.0))
    >>> color_limits([0.25, 0.25, 2.0], diverging=True, log=True)
    (0.25, 4.0)
    >>> color_limits([0.0, 0.0]), color_limits([2.0, 2.0])
    ((0.0, 1.0), (1.5, 2.5))
    """
    x = np.asarray(values, float)
    x = x[np.isfinite(x) & (x > 0)] if log else x[np.isfinite(x)]
    x = np.log2(x) if log else x
    if not x.size:
        low, high = -float(diverging), 1.0
    elif diverging:
        high = float(np.percentile(np.abs(x), 99)) or 1.0
        low = -high
    else:
        low, high = (float(v) for v in np.percentile(x, (1, 99)))
    if low == high == 0 and not log and not diverging:
        high = 1.0  # counts and shares are not negative
    elif low == high:
        low, high = low - 0.5, high + 0.5
    return (2.0**low, 2.0**high) if log else (low, high)


def bar_ticks(low: float, high: float, *, log: bool = False) -> list[tuple[float, str]]:
    """Return where a colour bar has ticks, and what they say: values, where it is logarithmic, too.

    Around 1, powers of two are fractions, since ratios are thought of so.

    Examples
    --------
    >>> [text for _, text in bar_ticks(1e-3, 1, log=True)]
    ['0.001', '0.01', '0.1', '1']
    >>> [text for _, text in bar_ticks(1 / 4, 4, log=True)]
    ['1/4', '1/2', '1', '2', '4']
    >>> [text for _, text in bar_ticks(-0.31, 0.3)]
    ['−0.2', '0', '0.2']
    """
    ticks = _log_ticks(low, high) if log else []
    if len(ticks) < _FEWEST:
        steps = MaxNLocator(_TICKS - 1, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        edge = 1e-6 * (high - low)
        digits = 2 + math.ceil(math.log10(max(abs(low), abs(high)) / (steps[1] - steps[0])))
        inside = [float(v) for v in steps if low - edge <= v <= high + edge]
        ticks = [(v, _tick(v, digits)) for v in inside]
    return ticks


def _log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    edge = 1 + 1e-6
    start, end = (math.floor(math.log10(v)) for v in (low, high * edge))
    if abs(math.log(low * high)) < edge - 1 and high <= 2.0**_TICKS:
        most = int(math.log2(high * edge))
        powers = range(-most, most + 1, -(-(2 * most + 1) // _TICKS))
        powers = range(-(most // powers.step) * powers.step, most + 1, powers.step)
        return [(2.0**k, f"1/{2**-k}" if k < 0 else str(2**k)) for k in powers]
    for factors, every, least in _LOG_TICKS:
        decades = [k for k in range(start, end + 1) if k % every == 0]
        found = [factor * 10.0**k for k in decades for factor in factors]
        found = [v for v in found if low / edge <= v <= high * edge]
        if least <= len(found) <= _TICKS:
            return [(v, _tick(v)) for v in found]
    return []


def _tick(value: float, digits: int = 2) -> str:
    value = float(f"{value:.{digits}g}")
    plain = value == 0 or 1e-3 <= abs(value) < 1e6
    text = f"{value:.{digits}g}" if not plain else f"{value:.{max(digits, 6)}g}"
    return text.replace("e-0", "e-").replace("e+0", "e").replace("-", "−")


NAMES: Mapping[str, str] = ChainMap(
    LABELS,
    {
        **{name: family.label for name, family in FAMILIES.items()},
        "null_heavy": "null-heavy",
        "long_tail": "long tail",
        "firefly_dominated": "firefly-dominated",
        "gamma_like": "gamma-like",
        "lognormal_like": "log-normal-like",
        "long-tail": "long tail",  # as regions are called
        "lognormal-like": "log-normal-like",
    },
)
"""What text and figures call estimators, families and patterns."""


def called(name: str) -> str:
    """Return what to write for a name: what `NAMES` has for it, or itself in words."""
    return NAMES.get(name, name.replace("_", " "))


def estimator_name(estimator: str) -> str:
    """Return what to write for an estimator, where readers meet the default one."""
    name = called(estimator)
    return f"default estimate ({name})" if estimator == DEFAULT_ESTIMATE else name


_log = logging.getLogger("chdstat")

_LATIN = ("STIXGeneral", "DejaVu Serif")
"""Fonts that come with Matplotlib."""
_EAST_ASIAN = (
    "Noto Serif CJK SC",
    "Noto Serif CJK JP",
    "Noto Sans CJK SC",
    "Noto Sans CJK JP",
    "Source Han Serif SC",
    "Source Han Sans SC",
    "IPAexMincho",
    "IPAMincho",
    "AR PL UMing CN",
    "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei",
    "NanumMyeongjo",
    "Droid Sans Fallback",
    "Songti SC",
    "Hiragino Mincho ProN",
    "Apple SD Gothic Neo",
    "Arial Unicode MS",
    "SimSun",
    "Yu Mincho",
    "MS Gothic",
    "Malgun Gothic",
)
"""Fonts of Linux, macOS and Windows for Chinese, Japanese and Korean."""
_SHOWN = 10
_MISSING = re.compile(r"Glyph (\d+) .*missing from")


def verbatim(text: str) -> str:
    r"""Escape a text so that Matplotlib draws it as written: a dollar sign begins no formula.

    Examples
    --------
    >>> print(verbatim("a $x^$ b"))
    a \$x^\$ b
    """
    return text.replace("$", r"\$")


def within(text: str, room: float) -> str:
    """Return a text for Matplotlib, cut to the length of a line of so many inches.

    Examples
    --------
    >>> within("wall", 1.0), within("the wall beside the window", 1.0)
    ('wall', 'the wall besid…')
    """
    most = max(4, int(_LETTERS * room))
    return verbatim(text if len(text) <= most else f"{text[: most - 1]}…")


@functools.cache
def families() -> tuple[str, ...]:
    """Return the font families of this machine; later ones have letters that earlier ones lack."""
    known = set(font_manager.get_font_names())
    return (*_LATIN, *(name for name in _EAST_ASIAN if name in known))


_spelling = ContextVar("spelling", default=False)
"""Whether an outer `spelt` is active, which logs the letters of all figures at once."""


@contextlib.contextmanager
def spelt() -> Iterator[None]:
    """Log letters that no font has in one line; Matplotlib warns for each letter and figure."""
    if _spelling.get():
        yield
        return
    outside = _spelling.set(True)
    fonts = logging.getLogger(font_manager.__name__)
    level = fonts.level
    fonts.setLevel(logging.ERROR)  # one line for each font that has no bold letters
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        fonts.setLevel(level)
        _spelling.reset(outside)
    letters: dict[str, None] = {}
    for warning in caught:
        if found := _MISSING.match(str(warning.message)):
            letters[chr(int(found[1]))] = None
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    if letters:
        _log.warning(
            "no font has the letters %s: boxes stand in their place. Install one that has, such as "
            "Noto Serif CJK for Chinese, Japanese and Korean, and delete Matplotlib's list of "
            "fonts in %s",
            " ".join([*letters][:_SHOWN]) + " …" * (len(letters) > _SHOWN),
            mpl.get_cachedir(),
        )
