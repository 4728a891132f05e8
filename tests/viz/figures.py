"""What the tests of drawing functions look for."""

from __future__ import annotations

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg


def texts(figure):
    """Return all texts of a figure that are seen."""
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_visible()}


def clashes(figure, monkeypatch):
    """Return which texts of a figure are cut by its edge, or are written over each other."""
    drawn, original = {}, mpl.text.Text.draw

    def draw(text, renderer, *args, **options):
        if text.get_visible() and text.get_text().strip():
            drawn[text] = text.get_window_extent(renderer)
        return original(text, renderer, *args, **options)

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    with monkeypatch.context() as patch:
        patch.setattr(mpl.text.Text, "draw", draw)
        figure.draw(renderer)
    sheet = figure.bbox.padded(1)
    found = [t.get_text() for t, box in drawn.items() if not sheet.contains(box.x0, box.y0)
             or not sheet.contains(box.x1, box.y1)]  # fmt: skip
    # The boxes of slanted texts are larger than these.
    level = [(t.get_text(), box) for t, box in drawn.items() if t.get_rotation() % 90 == 0]
    for i, (text, box) in enumerate(level):
        found += [f"{text} / {other}" for other, over in level[:i] if over.padded(-1).overlaps(box)]
    return found
