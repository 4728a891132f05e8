"""Lettering: names are drawn as they are written, in fonts that have their letters."""

from __future__ import annotations

import itertools
import logging
import warnings

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from chdstat import viz
from chdstat.studies.claims import PlotData
from chdstat.viz import styling
from chdstat.viz.maps import LABEL_COLORS
from chdstat.viz.styling import families, spelt, verbatim
from tests.viz.figures import texts
from tests.viz.test_drawing_functions import NAME

IN_NO_FONT = "\U0010fffd"

SERIES = {NAME: (np.arange(3), np.arange(3)), "other": (np.arange(3), np.arange(3))}


@pytest.mark.parametrize(
    "shown",
    [
        {NAME: PlotData("curves", SERIES)},
        {"": PlotData("points", SERIES)},
        {"": PlotData("bars", SERIES)},
        {"a": PlotData("curves", SERIES), "b": PlotData("points", {})},
    ],
)
def test_dollar_signs_in_a_name_begin_no_formula(shown):
    """Of all functions, see `test_drawing_functions`."""
    written = texts(viz.finding_plots(shown))
    assert any(verbatim(NAME) in text for text in written)
    assert not any(NAME in text for text in written)


VISION = {
    "protanopia": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.052]],
    "deuteranopia": [
        [0.3673, 0.8606, -0.2280],
        [0.2801, 0.6727, 0.0474],
        [-0.0118, 0.0429, 0.9689],
    ],
    "usual": np.eye(3),
}
"""Linear sRGB as these people see it: Machado et al. 2009, doi:10.1109/TVCG.2009.113."""
XYZ = np.array([[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])


def lab(color, vision):
    """Return CIELAB of a colour, as somebody sees it."""
    part = np.array(mpl.colors.to_rgb(color))
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(XYZ @ np.clip(VISION[vision] @ linear, 0, 1) / XYZ.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize(
    ("colors", "least"),
    [
        (viz.PALETTE, 15),
        (viz.CHANNELS.values(), 20),
        ([color for color, _ in viz.VERDICTS.values()], 40),
        ({**LABEL_COLORS, "undetermined": "#DDDDDD"}.values(), 10),
    ],
)
def test_colours_are_distinct_for_colour_blind_readers(colors, least, vision):
    seen = [lab(color, vision) for color in dict.fromkeys(colors)]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > least


def test_channels_and_magnitudes_are_told_apart_in_grey():
    red, green, blue = (lab(color, "usual")[0] for color in viz.CHANNELS.values())
    assert green - 12 > red > blue + 12
    lightness = [lab(color, "usual")[0] for color in styling.color_map()(np.linspace(0, 1, 64))]
    assert np.diff(lightness).min() > 0.5


def test_letters_that_no_font_has_are_told_once(tmp_path, caplog):
    with viz.style(), spelt():
        for name in ("first.svg", "second.png"):
            figure = Figure()
            figure.text(0.5, 0.5, f"wall {IN_NO_FONT}")
            figure.savefig(tmp_path / name)
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("chdstat", logging.WARNING)
    assert f"no font has the letters {IN_NO_FONT}: boxes" in record.getMessage()


def test_other_warnings_are_still_given(caplog):
    with pytest.warns(UserWarning, match="of something else"), spelt():
        warnings.warn("of something else", stacklevel=1)
    assert not caplog.records


def test_fonts_are_those_that_the_machine_has(monkeypatch):
    with viz.style():
        assert mpl.rcParams["font.family"] == [*families()]
    known = ["DejaVu Serif", "SimSun", "STIXGeneral", "Noto Serif CJK JP", "Comic Sans MS"]
    monkeypatch.setattr(styling.font_manager, "get_font_names", lambda: known)
    families.cache_clear()
    assert families() == ("STIXGeneral", "DejaVu Serif", "Noto Serif CJK JP", "SimSun")
    families.cache_clear()
