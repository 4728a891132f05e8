"""Lettering: what users have named is drawn as they wrote it, in fonts that have its letters.

`verbatim` is for every name that is not the library's own, `families` has the fonts, and `spelt`
goes around what saves figures.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import re
import warnings
from collections.abc import Iterator

import matplotlib as mpl
from matplotlib import font_manager

__all__ = ["families", "spelt", "verbatim"]

_log = logging.getLogger("chdstat")

_LATIN = ("STIXGeneral", "DejaVu Serif")
"""Matplotlib brings them along."""
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
"""What Linux, macOS and Windows have for Chinese, Japanese and Korean."""
_SHOWN = 10
_MISSING = re.compile(r"Glyph (\d+) .*missing from")


def verbatim(text: str) -> str:
    r"""Return what makes Matplotlib draw a text as it is: a dollar sign begins no formula.

    Examples
    --------
    >>> print(verbatim("a $x^$ b"))
    a \$x^\$ b
    """
    return text.replace("$", r"\$")


@functools.cache
def families() -> tuple[str, ...]:
    """Return families of fonts that this machine has; a later one has what those before lack."""
    known = set(font_manager.get_font_names())
    return (*_LATIN, *(name for name in _EAST_ASIAN if name in known))


@contextlib.contextmanager
def spelt() -> Iterator[None]:
    """Log in one line which letters no font has, where Matplotlib warns of each and each time."""
    with _silent_fonts(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
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


@contextlib.contextmanager
def _silent_fonts() -> Iterator[None]:
    """Keep quiet about fonts that have no bold letters: their plain ones are drawn."""
    log = logging.getLogger(font_manager.__name__)
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
