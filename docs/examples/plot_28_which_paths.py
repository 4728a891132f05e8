"""
Which paths make the noise?
===========================

A pixel is noisy, and its distribution has two modes. Which of its paths are to blame?
"""

# %%
# With ``by_depth``, every sample is rendered again with its path cut after 2, 3 and 4 segments. The
# random numbers are the same, and so are the paths: the differences are the light that each sample
# gathers by paths of one length.

# sphinx_gallery_panel = 1, 1
import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=128, size=(48, 48), backend="scalar", by_depth=4)
found = chd.patterns.attribute(samples)

figure = viz.map_grid(4, columns=4)
shares = found["variance_share"].transpose("segments", "y", "x")
for ax, name, share in zip(figure.axes, found["paths"].values, shares, strict=True):
    viz.value_map(100 * share, title=str(name), unit="% of the variance", limits=(0, 100), ax=ax)
figure

# %%
# Where lamps or the window shine, direct light makes the variance; elsewhere, light that has been
# reflected before. The shares of a pixel add up to 100 %.

for name, share in zip(found["paths"].values, shares.mean(("y", "x")), strict=True):
    print(f"{name:24}{float(share):5.0%} of the variance, on average")

# %%
# A single pixel says it of its modes and its tail, too: here the dark mode is light that was
# reflected, the bright one is direct.

pixel = samples.pixel(29, 36)
for row in pixel.light:
    parts = ", ".join(f"{share:.0%} {name}" for name, share in list(row.items())[2:])
    print(f"{row['of']:9}{parts}")

# %%
# **Next:** :doc:`/how-to/noisy-pixel` asks what else a noisy pixel tells.
