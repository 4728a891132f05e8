"""Make chd.png, the image in the README: two pixels of the bathroom and what is behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import chdstat as chd
from chdstat import viz

SIZE = (160, 160)
PIXELS = {"wall": (19, 112), "edge of the shadow": (141, 55)}


def main() -> None:
    image = chd.render("bathroom", spp=256, size=SIZE, seed=1).read().mean(axis=-1)
    x = chd.rendering.render_pixels("bathroom", list(PIXELS.values()), spp=65536, size=SIZE, seed=2)
    with viz.style():
        figure = Figure(figsize=(7.2, 3.0), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.3])
        main_axes = figure.add_subplot(grid[:, 0])
        main_axes.imshow(viz.tonemap(image))
        main_axes.set_axis_off()
        for i, (name, (row, column)) in enumerate(PIXELS.items()):
            color = viz.PALETTE[i]
            ring = Circle((column, row), 4, fill=False, edgecolor=color, linewidth=1.8)
            main_axes.add_patch(ring)
            draw(figure.add_subplot(grid[i, 1]), x[i], name, color)
        above, below = figure.axes[1:]
        handles, _ = above.get_legend_handles_labels()
        names = ["samples, green channel", "fitted mixture"]
        above.legend(handles, names, loc="upper left", bbox_to_anchor=(0, 0.93))
        above.tick_params(labelbottom=False)
        below.set_xlabel("radiance of one sample")
        figure.savefig(Path(__file__).with_name("chd.png"), dpi=200)


def draw(axes: Axes, x: np.ndarray, name: str, color: str) -> None:
    pixel = chd.Samples.from_array(x[np.newaxis, np.newaxis]).pixel(0, 0)
    green = pixel.names.index("G")
    curves = [pixel.curve(row) if row == green else None for row in range(len(pixel.names))]
    found = pixel.histograms["log"]
    viz.chd_axes(found, names=pixel.names, channels="G", fits=curves, limits=(1e-4, 10), ax=axes)
    axes.lines[-1].set(color="0.15", label="curve")
    axes.set_ylabel("density per decade")
    axes.spines["bottom"].set(color=color, linewidth=2.2)
    axes.set_title(f"{name}: {pixel.null_share:.0%} of the samples are null", loc="left")


if __name__ == "__main__":
    main()
