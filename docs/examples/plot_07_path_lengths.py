"""
Shorter and longer paths
========================

What does each further bounce of light do to the distribution of a pixel?

This is the comparison of path lengths in the paper's study of the hall.
"""

# %%
# The same view of the hall twice: with paths of up to three segments, which is one bounce, and with
# the scene's own limit.

# sphinx_gallery_panel = 1, 2
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

depths = {"full paths": None, "up to 3 segments": 3}
view = {"size": (64, 64), "seed": 1, "backend": "scalar"}
images = {
    name: chd.render("gallery", spp=24, max_depth=depth, **view).read().mean(axis=-1)
    for name, depth in depths.items()
}
for name, image in images.items():
    print(f"{name:16} mean radiance {image.mean():.3f}")

# %%
# Four regions in detail
# ----------------------
#
# We draw 4096 samples of the pixel in the middle of four regions, each with both path lengths.

regions = find_recipe("gallery").regions[:4]
pixels = [region.center(64, 64) for region in regions]
x = {
    name: chd.rendering.render_pixels("gallery", pixels, spp=4096, max_depth=depth, **view)
    for name, depth in depths.items()
}
marks = [viz.Mark(r.name, *r.pixels(64, 64), r.center(64, 64)) for r in regions]
viz.renders_contrasted(images, {name: [*those] for name, those in x.items()}, marks)

# %%
# Longer paths add light, so that the image is brighter and fewer samples are null. They add it at
# many scales: the peaks become smaller, and more samples lie far above them.

for i, region in enumerate(regions):
    for name in depths:
        null, bright = (x[name][i] == 0).all(axis=0).mean(), np.quantile(x[name][i, 1], 0.99)
        print(f"{region.name:12} {name:16} {null:4.0%} nulls, 99 % of samples below {bright:.2f}")

# %%
# **Next:** `Are two renders the same? <plot_18_two_renders.html>`_ tests such a difference in every
# pixel.
