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
        figure = Figure(figsize=(6.7, 2.7), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.25])
        main_axes = figure.add_subplot(grid[:, 0])
        main_axes.imshow(viz.tonemap(image))
        main_axes.set_axis_off()
        for i, (name, (row, column)) in enumerate(PIXELS.items()):
            color = viz.PALETTE[i]
            ring = Circle((column, row), 4, fill=False, edgecolor=color, linewidth=1.6)
            main_axes.add_patch(ring)
            draw(figure.add_subplot(grid[i, 1]), x[i], name, color)
        handles, _ = figure.axes[1].get_legend_handles_labels()
        figure.axes[1].legend(handles, ["green samples", "gamma", "log-normal"], loc="upper left")
        figure.axes[2].set_xlabel("radiance (log scale)")
        figure.savefig(Path(__file__).with_name("chd.png"), dpi=180)


def draw(axes: Axes, x: np.ndarray, name: str, color: str) -> None:
    null = (x == 0).all(axis=0)
    histogram = chd.histogram(x[1], null=null)
    viz.chd_axes(histogram, channels=["G"], ax=axes)
    found = chd.fit.select(x[1], null=null)
    for family, line in zip(found.families, viz.PALETTE[4:], strict=False):
        density = found.fits[family].pdf(histogram.centers) * histogram.centers * np.log(10)
        axes.plot(histogram.centers, density, color=line, label=family)
    axes.set_xlim(1e-4, 1e1)
    axes.spines["bottom"].set(color=color, linewidth=2.2)
    axes.set_title(f"{name}: {null.mean():.0%} of the samples are null", loc="left")


if __name__ == "__main__":
    main()
