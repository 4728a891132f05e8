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
        above.legend(handles, ["samples, green channel", "fitted mixture"], loc="upper left")
        above.tick_params(labelbottom=False)
        below.set_xlabel("radiance of one sample")
        figure.savefig(Path(__file__).with_name("chd.png"), dpi=200)


def draw(axes: Axes, x: np.ndarray, name: str, color: str) -> None:
    null = (x == 0).all(axis=0)
    histogram = chd.histogram(x[1], null=null)
    viz.chd_axes(histogram, names=["G"], ax=axes)
    # The mixture has a narrow peak: what it expects in each bin compares with the histogram.
    mixture = chd.fit.mixture(x[1], null=null)
    expected = np.diff(mixture.cdf(histogram.edges)) / (1 - mixture.cdf(0))
    density = expected / np.diff(np.log10(histogram.edges))
    axes.plot(histogram.centers, density, color="0.15", linewidth=1.4, label="mixture")
    axes.set_xlim(1e-4, 1e1)
    axes.set_ylabel("density per decade")
    axes.spines["bottom"].set(color=color, linewidth=2.2)
    axes.set_title(f"{name}: {null.mean():.0%} of the samples are null", loc="left")


if __name__ == "__main__":
    main()
