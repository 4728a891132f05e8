"""Exports: figures with the map and in the colours of the page."""

import io

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_hex

import chdstat as chd
from chdstat.explorer import export
from chdstat.explorer.address import View
from chdstat.explorer.overlays import DIFFERENCES, IMAGES, ramp
from chdstat.explorer.panels import LIGHT, RENDER_COLORS, mark_colors
from chdstat.explorer.selection import SelectionResults
from chdstat.explorer.workspace import opened

EDGE = 8
PIXELS = View(pixels=((3, 4), (1, 1), (6, 2)), shown=0, reference=1)


def noise(seed):
    return np.random.default_rng(seed).gamma(1.0, size=(EDGE, EDGE, 3, 64)).astype(np.float32)


@pytest.fixture
def selected():
    """Return plots and images of a selection in so many renders."""
    shared = []

    def asked(renders, view=PIXELS):
        samples = [chd.Samples.from_array(noise(k), scene=f"render {k}") for k in range(renders)]
        shared.append(opened(samples))
        plots = SelectionResults(shared[-1]).plots(view)
        means = [x.read().mean(axis=-1) for x in samples]
        return plots, dict(zip(shared[-1].names, means, strict=True))

    yield asked
    for one in shared:
        one.stop()


def boxes(figure):
    """Return the colours of the numbers of marks in the first image."""
    return [to_hex(text.get_bbox_patch().get_facecolor()) for text in figure.axes[0].texts]


def test_renders_and_marks_have_the_colours_of_the_page(selected):
    plots, images = selected(2)
    figure = export._compared(plots, images, 0.0, None)
    (legend,) = figure.legends
    drawn = {text.get_text(): line.get_color() for text, line in
             zip(legend.get_texts(), legend.get_lines(), strict=True)}  # fmt: skip
    assert drawn == {name: LIGHT[color] for name, color in plots.legend}  # as on a light page
    assert boxes(figure) == list(mark_colors(2)[:3])
    assert not {*boxes(figure), *mark_colors(2)} & {*RENDER_COLORS, *drawn.values()}
    rows = [text[3] for text in plots.panels["log"].texts[::2]]
    assert rows == list(mark_colors(2)[:3])  # numbers of rows on the page


def test_marks_of_one_render_have_the_colours_of_the_page(selected):
    plots, images = selected(1)
    figure = export._mapped(plots, images, 0.0, IMAGES["null_share"].filled(np.eye(EDGE)))
    assert boxes(figure) == list(mark_colors(1)[:3])
    assert [color for _, color in plots.legend] == list(mark_colors(1)[:3])


def test_the_map_is_exported_as_it_is_shown(selected):
    plots, images = selected(2)
    kind = IMAGES["relative_error"]
    values = np.geomspace(1e-4, 2, EDGE * EDGE).reshape(EDGE, EDGE)
    shown = export.replace(kind.filled(values), cmap="magma", ends=(1e-2, 1))
    figure = export._compared(plots, images, 0.0, shown)
    (image,) = figure.axes[2].images
    assert [to_hex(c) for c in image.get_cmap()(range(256))] == list(ramp("magma"))
    assert (image.norm.vmin, image.norm.vmax) == (1e-2, 1)
    signed = export.replace(DIFFERENCES["diff:signed"], values=values - 1, cmap="RdBu_r")
    (image,) = export._compared(plots, images, 0.0, signed).axes[2].images
    assert image.get_cmap().name == "RdBu_r"
    name, content = export.exported("png", *selected(1), 0.0, shown)
    assert name.endswith(".png")
    assert matplotlib.image.imread(io.BytesIO(content)).shape[0] > 600
