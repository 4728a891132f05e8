"""Display: numbers as a reader wants them, and results that show themselves.

A result says once, in a `Card`, what is worth seeing of it: facts, rows of a table, images. `Shown`
makes of that a notebook's HTML, text that fits a terminal, and LaTeX. A `Tabled` result has rows
of numbers, too, as a data frame or as a file.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import html
import io
import itertools
import json
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, cast

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import plain
from chdstat._core.files import checked_target, replacing
from chdstat.errors import InputError, Reason

if TYPE_CHECKING:
    import pandas as pd

Width = Literal["column", "page"] | float
"""Width of a figure: that of a column or a page of a paper, or in inches."""

_LINES, _WIDTH = 24, 80
"""Lines and letters of a terminal, which a representation as text fits."""
_INDENT = 2
_LONG = 400
"""Most letters of a value."""
_PERCENT = 0.01
_IN_FULL = 12
"""Arrays up to this size are written number by number."""


class NumberWriter(Protocol):
    """Writes a number; of the digits that it has, those below `step` are left out."""

    def __call__(self, value: float, /, *, step: float = 0.0) -> str:
        """Return the number as text."""


def number(value: float, digits: int = 3, *, step: float = 0.0) -> str:
    """Return a number with three digits, or so many, and a real minus sign.

    Fewer if the last ones are below `step`, but at least one.

    Examples
    --------
    >>> number(0.012345), number(1234.5), number(-2.0), number(float("nan")), number(0.5, 2)
    ('0.0123', '1230', '−2.00', '—', '0.50')
    >>> number(0.8412, step=0.01), number(0.0106, step=0.1), number(321.0, step=100.0)
    ('0.84', '0.01', '300')
    """
    if not math.isfinite(value):
        return "—"
    if value == 0:
        return "0"
    kept = _digits(value, step, digits)
    rounded = float(f"{value:.{kept}g}")
    places = max(0, kept - 1 - math.floor(math.log10(abs(rounded))))
    plain_range = 1e-4 <= abs(rounded) < 1e7
    text = f"{rounded:.{places}f}" if plain_range else f"{rounded:.{min(kept - 1, 1)}e}"
    return text.replace("-", "−")


def _digits(value: float, step: float, most: int) -> int:
    """Return how many digits of a number are shown: none below the step, but one at least."""
    if not step > 0:
        return most
    places = math.floor(math.log10(abs(value))) - round(math.log10(step)) + 1
    return min(max(places, 1), most)


def percent(share: float, *, sign: bool = False, step: float = 0.0) -> str:
    r"""Return a share in per cent, without a line break before the sign.

    Tenths are left out if they are below the `step` of the share.

    Examples
    --------
    >>> percent(0.574), percent(0.0002), percent(-0.031, sign=True), percent(0.0)
    ('57\xa0%', '< 0.1\xa0%', '−3.1\xa0%', '0\xa0%')
    >>> percent(0.574, step=0.1), percent(0.031, step=0.01), percent(0.004, step=0.01)
    ('57\xa0%', '3\xa0%', '0.4\xa0%')
    """
    if not math.isfinite(share):
        return "—"
    if 0 < share < 0.0005 and not sign:
        return "< 0.1\N{NO-BREAK SPACE}%"
    digits = 0 if abs(share) >= 0.0995 or share == 0 else 1
    if step >= _PERCENT and abs(share) >= _PERCENT:
        digits = 0
    rounded = round(100 * share, digits) + 0.0  # no minus before 0
    text = f"{rounded:{'+' if sign and rounded else ''}.{digits}f}\N{NO-BREAK SPACE}%"
    return text.replace("-", "−")


def capital(text: str) -> str:
    """Return a sentence with its first letter in upper case, unless it begins with a name in code.

    Examples
    --------
    >>> capital("many samples"), capital("sample_count: four times as many"), capital("")
    ('Many samples', 'sample_count: four times as many', '')
    """
    return text if "_" in text.partition(" ")[0] else text[:1].upper() + text[1:]


def listed(names: Sequence[str]) -> str:
    """Return names as a list in a sentence.

    Examples
    --------
    >>> listed(["a", "b", "c"]), listed([])
    ('a, b and c', '')
    """
    *first, last = names or [""]
    return f"{', '.join(first)} and {last}" if first else last


def step_of(low: float, high: float, *, beside: Sequence[float] = ()) -> float:
    """Return the place of the last digit that an interval supports, a power of ten; 0 for all.

    Half of the interval has two digits there if they are at most 35, otherwise one (Particle Data
    Group, "Review of Particle Physics", introduction, section 5.3). No end that lies beside one of
    the numbers `beside`, such as the limit of a claim, is rounded to it.

    Examples
    --------
    >>> step_of(0.21, 0.44), step_of(0.25, 0.42), step_of(150, 600), step_of(2.0, 2.0)
    (0.01, 0.01, 10.0, 0.0)
    >>> step_of(0.01, 0.96), step_of(0.01, 0.96, beside=[1.0])
    (0.1, 0.01)
    """
    half = (high - low) / 2
    if not 0 < half < math.inf:
        return 0.0
    place = math.floor(math.log10(half))
    place -= half < 3.55 * 10.0**place
    apart = [abs(end - other) for end in (low, high) for other in beside if end != other]
    if apart:
        place = min(place, max(math.floor(math.log10(1.99 * min(apart))), -9))
    return float(f"1e{place}")


def with_margin(value: float, margin: float) -> str:
    """Return a value with its margin of error.

    Examples
    --------
    >>> with_margin(0.31, 0.2)
    '0.31 ± 0.20'
    """
    if not (math.isfinite(value) and math.isfinite(margin)):
        return "—"
    return f"{value:.2f} ± {margin:.2f}".replace("-", "−")


def with_interval(
    value: float,
    low: float,
    high: float,
    write: NumberWriter = number,
    *,
    beside: Sequence[float] = (),
) -> str:
    """Return a value with its interval, or alone if that is unknown or has no width.

    No digit is shown that the interval does not support: see `step_of`.

    Examples
    --------
    >>> with_interval(0.9131, 0.8691, 0.9502), with_interval(1.0, float("nan"), float("nan"))
    ('0.91 [0.87, 0.95]', '1.00')
    """
    if not (math.isfinite(low) and math.isfinite(high)) or low == high:
        return write(value)
    write = partial(write, step=step_of(low, high, beside=beside))
    return f"{write(value)} [{write(low)}, {write(high)}]"


def ends_in_words(
    low: float, high: float, write: NumberWriter = number, *, beside: Sequence[float] = ()
) -> str:
    """Return the ends of an interval in words; "" if there is none.

    Examples
    --------
    >>> ends_in_words(0.2134, 0.4419), ends_in_words(0.5, math.inf), ends_in_words(0, math.nan)
    ('0.21 to 0.44', '0.500 or more', '')
    """
    if math.isnan(low) or math.isnan(high):
        return ""
    write = partial(write, step=step_of(low, high, beside=beside))
    return f"{write(low)} or more" if math.isinf(high) else f"{write(low)} to {write(high)}"


def about(value: float, low: float, high: float, unit: str) -> str:
    """Return a number that is known to a factor, in words with its range.

    Examples
    --------
    >>> about(321.0, 152.4, 610.0, "samples"), about(1234.5, 1100.0, 1400.0, "spp")
    ('about 300 samples, 150 to 610', 'about 1,200 spp, 1,100 to 1,400')
    >>> about(160.0, 64.0, 270.0, "spp"), about(9.7e3, 4e3, 2e4, "spp")
    ('about 150 spp, 64 to 270', 'about 10,000 spp, 4,000 to 20,000')
    >>> about(82.0, 63.0, math.inf, "samples"), about(87.2, math.nan, math.nan, "spp")
    ('63 samples or more', 'about 87 spp')
    """

    def rounded(x: float) -> str:
        return f"{float(f'{x:.2g}'):,.0f}"

    if not (math.isfinite(low) and high > low):
        return f"about {rounded(value)} {unit}"
    if math.isinf(high):
        return f"{rounded(low)} {unit} or more"
    place = 10.0 ** math.floor(math.log10(value))
    if high > 2 * low:  # known to a factor of 2 at best: 1, 1.5, 2, 2.5, 3, 4 ...
        place /= 2 if value < 2.75 * place else 1
        value = max(round(value / place), 1) * place
    ends = f", {rounded(low)} to {rounded(high)}" if rounded(low) != rounded(high) else ""
    return f"about {rounded(value)} {unit}{ends}"


def byte_size(count: float) -> str:
    """Return a number of bytes in the unit that suits it.

    Examples
    --------
    >>> byte_size(512), byte_size(165_000), byte_size(21_916_437), byte_size(3e12)
    ('512 B', '161 KiB', '20.9 MiB', '2.73 TiB')
    """
    power = min(4, max(0, math.floor(math.log2(max(count, 1)) / 10)))
    unit = ("B", "KiB", "MiB", "GiB", "TiB")[power]
    return f"{count} B" if power == 0 else f"{number(count / 1024**power)} {unit}"


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it.

    Examples
    --------
    >>> duration(5.74e-8), duration(0.288), duration(73.4), duration(700), duration(9000)
    ('57 ns', '288 ms', '73 s', '12 min', '2.5 h')
    """
    for unit, size in (("h", 3600), ("min", 60), ("s", 1), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size * (2 if size >= 60 else 1):
            amount = seconds / size
            return f"{amount:.0f} {unit}" if amount >= 9.95 else f"{amount:.2g} {unit}"
    return f"{seconds * 1e9:.0f} ns"


def written(value: Any) -> str:
    r"""Return a value as text: a large array as its shape and range.

    Examples
    --------
    >>> written({"shape": np.array(2.8252), "scale": 0.0506})
    'shape 2.83, scale 0.0506'
    >>> written(np.array([[0.25, 1.0], [2.0, np.nan]])), written(np.arange(100) > 24)
    ('[[0.250, 1.00], [2.00, —]]', '(100,) bool, 75\xa0% true')
    >>> written(np.linspace(0, 1, 600).reshape(20, 30))
    '(20, 30) float64, 0 to 1.00'
    """
    if isinstance(value, np.ndarray | np.generic):
        return _array(np.asarray(value))
    if isinstance(value, float):
        return number(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {written(v)}" for name, v in value.items())
    if isinstance(value, tuple | list):
        return ", ".join(map(written, value))
    if isinstance(value, Shown):
        return value._card().title
    text = str(value)
    return text if len(text) <= _LONG else f"{text[: _LONG - 3]}..."


def each(write: Callable[..., str], values: npt.ArrayLike, *others: npt.ArrayLike) -> str:
    """Return numbers with others beside them as text, one by one; the range of large arrays.

    Examples
    --------
    >>> each(with_interval, [0.5, 2.0], [0.25, 1.0], [1.0, 4.0])
    '[0.5 [0.2, 1.0], 2.0 [1.0, 4.0]]'
    """
    x = np.asarray(values)
    if x.size > _IN_FULL:
        return _array(x)
    texts = np.empty(x.shape, object)
    for i in np.ndindex(x.shape):
        texts[i] = write(float(x[i]), *(float(np.asarray(other)[i]) for other in others))
    return _nested(texts.tolist())


def with_error(value: float, error: float) -> str:
    """Return a value with its standard error.

    Examples
    --------
    >>> with_error(2.8252, 0.473), with_error(2.8252, float("nan"))
    ('2.83 ± 0.473', '2.83')
    """
    return f"{number(value)} ± {number(error)}" if math.isfinite(error) else number(value)


def as_p(value: float) -> str:
    """Return a p-value; below 0.001 as a power of ten.

    Examples
    --------
    >>> as_p(0.25), as_p(0.0123), as_p(2e-5), as_p(float("nan"))
    ('0.25', '0.012', '2e−5', '—')
    """
    if not math.isfinite(value):
        return "—"
    if value == 0:  # too small for a float
        return "≈\N{NO-BREAK SPACE}0"
    if value < 1e-3:
        return f"{value:.0e}".replace("-", "−").replace("e−0", "e−")
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}"


def in_unit(text: str, unit: str) -> str:
    """Return a number with its unit; alone if it has no unit, or is missing.

    Examples
    --------
    >>> in_unit("0.5", "W sr-1 m-2"), in_unit("0.5", "1"), in_unit("—", "W sr-1 m-2")
    ('0.5 W sr-1 m-2', '0.5', '—')
    """
    return text if text == "—" or unit == "1" else f"{text} {unit}"


def reasons(codes: npt.ArrayLike) -> str:
    """Return the reasons among codes, in words; "" if nothing is missing.

    Examples
    --------
    >>> reasons([0, 0, 2, 1]), reasons(np.zeros((3, 4)))
    ('all null, too few', '')
    """
    found = (Reason(int(code)) for code in np.unique(np.asarray(codes)))
    return ", ".join(r.name.lower().replace("_", " ") for r in found if r is not Reason.OK)


def _array(x: npt.NDArray[Any]) -> str:
    if x.size <= _IN_FULL:
        return _nested(x.tolist())
    about = f"{x.shape} {x.dtype}"
    if x.dtype == bool:
        return f"{about}, {percent(float(x.mean()))} true"
    known = x[np.isfinite(x)] if x.dtype.kind == "f" else x
    if x.dtype.kind not in "fiu" or not known.size:
        return f"{about}, no number" if x.dtype.kind == "f" else about
    missing = f", {percent(1 - known.size / x.size)} missing" if known.size < x.size else ""
    return f"{about}, {written(known.min().item())} to {written(known.max().item())}{missing}"


def _nested(x: Any) -> str:
    return f"[{', '.join(map(_nested, x))}]" if isinstance(x, list) else written(x)


_CELL = ' style="text-align: left; padding-right: 1em"'
_IMAGE = ' style="max-width: 100%; min-width: 160px; image-rendering: pixelated"'


@dataclass(frozen=True)
class Card:
    """What a result shows.

    Parameters
    ----------
    title
        Name of the result.
    facts
        Names and values, the most important first.
    table
        Rows of text by the titles of the columns.
    images
        PNG files, by what they show.
    """

    title: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    table: Sequence[Mapping[str, str]] = ()
    images: Mapping[str, bytes] = field(default_factory=dict)

    def known(self) -> dict[str, str]:
        """Return the facts as text, without empty ones."""
        texts = {name: written(value) for name, value in self.facts.items() if value is not None}
        return {name: text for name, text in texts.items() if text}

    def text(self) -> str:
        """Return at most 24 lines of 80 letters: the facts, then the rows of the table."""
        lines = _in_columns([*self.known().items()])
        if self.table:
            lines += _in_columns([[*self.table[0]], *([*row.values()] for row in self.table)])
        if len(lines) > _LINES - 1:
            left_out = len(lines) - (_LINES - 2)
            lines = [*lines[: _LINES - 2], f"... and {left_out} more lines"]
        return "\n".join([self.title, *(f"{' ' * _INDENT}{line}" for line in lines)])

    def html(self) -> str:
        """Return images and tables side by side, in the colours of the page that shows them."""
        figures = "".join(
            f'<figure style="margin: 0"><img alt="{html.escape(caption)}"{_IMAGE} '
            f'src="data:image/png;base64,{base64.b64encode(image).decode()}">'
            f'<figcaption style="font-size: 85%">{html.escape(caption)}</figcaption></figure>'
            for caption, image in self.images.items()
        )
        import pandas as pd

        facts = pd.Series(self.known(), dtype=object).to_frame()
        parts = [_html(facts, header=False)] if len(facts) else []
        parts += [_html(pd.DataFrame([*self.table]), index=False)] if self.table else []
        return (
            f'<div><strong>{html.escape(self.title)}</strong><div style="display: flex; '
            'flex-wrap: wrap; gap: 1em; align-items: flex-start">'
            f"{figures}<div>{''.join(parts)}</div></div></div>"
        )

    def latex(self) -> str:
        """Return the table as LaTeX, or names and values if there is none; see `latex`."""
        if self.table:
            return latex(self.table)
        rows = [{"quantity": name, "value": text} for name, text in self.known().items()]
        wide = max((len(row["value"]) for row in rows), default=0) > _WIDTH
        return latex(rows, r"lp{0.7\linewidth}" if wide else "ll")


_INTERVAL = re.compile(r"\[[^\[\],]*, [^\[\],]*\]")


def _unbroken(interval: re.Match[str]) -> str:
    return interval[0].replace(" ", "\0")


def _in_columns(rows: Sequence[Sequence[str]], width: int = _WIDTH - _INDENT) -> list[str]:
    """Return the lines of rows of text in columns, wider than asked for rather than cut.

    Cells wrap between words, those of the widest columns first; an interval is one word if there is
    room.

    Examples
    --------
    >>> _in_columns([["test", "verdict"], ["nulls", "cannot tell"]], 14)
    ['test   verdict', 'nulls  cannot', '       tell']
    """
    whole = [[_INTERVAL.sub(_unbroken, text) for text in row] for row in rows]
    for cells in whole, rows:
        columns = [*zip(*cells, strict=True)]
        widths = [max(1, *map(len, column)) for column in columns]
        least = [max(len(w) for text in column for w in text.split(" ")) for column in columns]
        if sum(least) + 2 * (len(least) - 1) <= width:
            break
    while sum(widths) + 2 * (len(widths) - 1) > width:
        wide = [i for i, size in enumerate(widths) if size > max(least[i], 1)]
        if not wide:
            break
        widths[max(wide, key=lambda i: widths[i])] -= 1
    lines = []
    for row in cells:
        wrapped = [
            textwrap.wrap(text, size, break_long_words=False, break_on_hyphens=False) or [""]
            for text, size in zip(row, widths, strict=True)
        ]
        for parts in itertools.zip_longest(*wrapped, fillvalue=""):
            padded = (f"{part:{size}}" for part, size in zip(parts, widths, strict=True))
            lines.append("  ".join(padded).rstrip().replace("\0", " "))
    return lines


def _html(frame: pd.DataFrame, **options: bool) -> str:
    """Return a data frame of text as a table, whole and to the left: pandas would cut it short."""
    import pandas as pd

    with pd.option_context("display.max_colwidth", None):
        text = str(frame.to_html(border=0, justify="left", **options))
    return text.replace("<th>", f"<th{_CELL}>").replace("<td>", f"<td{_CELL}>")


_LATEX = str.maketrans({
    **{letter: f"${letter}$" for letter in "<>"},
    "−": "$-$", "±": r"$\pm$", "×": r"$\times$", "÷": r"$\div$",
    "≤": r"$\le$", "≥": r"$\ge$", "▲": r"$\triangle$", "µ": r"$\mu$", "|": r"\textbar{}",
    "—": "---", "–": "--", "…": r"\dots{}", "\N{NO-BREAK SPACE}": "~",
})  # fmt: skip
"""What LaTeX has for letters that its fonts lack."""


def latex(rows: Sequence[Mapping[str, str]], columns: str = "") -> str:
    r"""Return rows of text as a LaTeX table with the rules of the package booktabs.

    Parameters
    ----------
    rows
        Text by the titles of the columns.
    columns
        Alignment of the columns; by default, the first at the left, others at the right.

    Examples
    --------
    >>> print(latex([{"estimator": "mean", "bias": "-1 %"}]))
    \begin{tabular}{lr}
    \toprule
    estimator & bias \\
    \midrule
    mean & -1 \% \\
    \bottomrule
    \end{tabular}
    """
    import pandas as pd

    frame = pd.DataFrame([*rows])
    form = columns or "l" + "r" * (frame.shape[1] - 1)
    text = str(frame.to_latex(index=False, escape=True, column_format=form))
    return text.rstrip().translate(_LATEX)


class Shown:
    """A result that shows itself: in a notebook, or as text on a screen of a terminal.

    Examples
    --------
    >>> @dataclass(frozen=True, repr=False)
    ... class Found(Shown):
    ...     share: float
    ...     image: npt.NDArray[np.float64]
    >>> Found(0.5, np.zeros((4, 4)))
    Found
      share  0.500
      image  (4, 4) float64, 0 to 0
    >>> Found(0.5, np.zeros((4, 4)))._repr_html_().count("<td")
    2
    """

    _drawn: ClassVar[str] = ""
    """What ``plot`` draws, for results whose figure a notebook shows."""

    def _card(self) -> Card:
        """Return what is worth seeing; by default, every field of a dataclass except functions."""
        fields: Any = dataclasses.fields(self)  # type: ignore[arg-type]
        facts = {f.name: getattr(self, f.name) for f in fields}
        facts = {name: value for name, value in facts.items() if not callable(value)}
        facts |= {n: reasons(codes) for n, codes in facts.items() if n.endswith("reason")}
        return Card(type(self).__name__, {n.replace("_", " "): v for n, v in facts.items()})

    def to_latex(self) -> str:
        r"""Return the result's table as LaTeX, with the rules of the package booktabs.

        It is the table that a notebook shows, or names and values if there is none.

        Examples
        --------
        >>> import chdstat as chd
        >>> rng = np.random.default_rng(0)
        >>> found = chd.compare(rng.exponential(size=(8, 8, 3, 128)), ["mean", "median"])
        >>> print(found.to_latex().splitlines()[4])
        sample mean & 1.00 & 1.00 &  & 0.0~\% & --- \\
        """
        return self._card().latex()

    def __repr__(self) -> str:
        return self._card().text()

    def _repr_html_(self) -> str:
        card = self._card()
        if self._drawn:
            with contextlib.suppress(InputError):  # such as a fit of too many pixels
                figure = cast("Any", self).plot()
                card = replace(card, images={**card.images, self._drawn: figure._repr_png_()})
        return card.html()


class Tabled(Shown):
    """A result with rows of numbers, which can be taken away as a data frame or a file.

    Examples
    --------
    >>> @dataclass(frozen=True, repr=False)
    ... class Found(Tabled):
    ...     def table(self) -> list[dict[str, Any]]:
    ...         return [{"n": 4, "bias": 0.5}]
    >>> Found().to_dataframe()["bias"].tolist()
    [0.5]
    """

    FORMATS: ClassVar = (".csv", ".json")
    """File formats that `save` writes."""

    def table(self) -> list[dict[str, Any]]:
        """Return rows of all numbers and names, ready for JSON, by the names of the columns."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return everything ready for JSON; None for NaN."""
        return {"table": plain(self.table())}

    def to_dataframe(self) -> pd.DataFrame:
        """Return what one reads of `table` as a `pandas.DataFrame`."""
        import pandas as pd

        return pd.DataFrame(self._shown_rows())

    def _shown_rows(self) -> list[dict[str, Any]]:
        """Return the rows and columns of the data frame; by default, all of `table`."""
        return self.table()

    def save(self, path: str | Path) -> Path:
        """Write `table` to a .csv, or everything to a .json file.

        Raises
        ------
        InputError
            If the path has another ending.
        StoreError
            If it cannot be written to.
        """
        target = checked_target(path, *self.FORMATS)
        with replacing(target) as file:
            text = json.dumps(self.to_dict(), indent=1, ensure_ascii=False)
            if target.suffix == ".csv":
                import pandas as pd

                text = str(pd.DataFrame(self.table()).to_csv(index=False))
            file.write_text(text, encoding="utf-8")
        return target


def channel_names(count: int) -> tuple[str, ...]:
    """Return the names of the channels of an image: R, G and B, or numbers if there are not three.

    Examples
    --------
    >>> channel_names(3), channel_names(2)
    (('R', 'G', 'B'), ('channel0', 'channel1'))
    """
    return ("R", "G", "B") if count == 3 else tuple(f"channel{i}" for i in range(count))


def colour(channel: str) -> str:
    """Return the name of a channel in words; render B and the channel B are then two things.

    Examples
    --------
    >>> colour("B"), colour("luminance")
    ('blue', 'luminance')
    """
    return {"R": "red", "G": "green", "B": "blue"}.get(channel, channel)


def png(values: npt.ArrayLike, about: str = "") -> bytes:
    """Return an image as a PNG file: sRGB from 0 to 1, shape (y, x, 3), or (y, x) for grey.

    `about` becomes its comment.
    """
    from PIL import Image, PngImagePlugin

    pixels = np.round(255 * np.nan_to_num(np.asarray(values, np.float64)).clip(0, 1))
    notes = PngImagePlugin.PngInfo()
    notes.add(b"sRGB", b"\0")
    notes.add_text("Comment", about)
    file = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(file, "png", pnginfo=notes)
    return file.getvalue()
