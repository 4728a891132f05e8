"""What the tests of drawing functions look for."""

from __future__ import annotations

import matplotlib as mpl


def texts(figure):
    """Return all texts of a figure that are seen."""
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_visible()}
