"""
Look at the distribution of a pixel
===================================

The samples of a pixel are draws from its *characteristic distribution*, CHD for short. What do
CHDs look like in different parts of one image?
"""

# %%
# We mark four pixels of the bathroom, each with the pixels around it. The image only shows where
# they are, so few samples and a denoiser do.

# sphinx_gallery_panel = 2, 6
import numpy as np

import chdstat as chd
from chdstat import viz

SIZE = (128, 128)
samples = chd.render("bathroom", spp=12, size=SIZE, seed=1, backend="scalar")
features = {name: samples.features[name] for name in ("albedo", "normal")}
image = chd.io.denoise(samples.read().mean(axis=-1), **features)
pixels = {
    "wall": (16, 88),
    "sunlit tub": (88, 108),
    "edge of the shadow": (113, 45),
    "below the vanity": (79, 50),
}
marks = [
    viz.Mark(name, slice(y - 4, y + 5), slice(x - 4, x + 5), (y, x))
    for name, (y, x) in pixels.items()
]
viz.with_marks(image, marks)

# %%
# Thousands of samples of four pixels
# -----------------------------------
#
# The shape of a distribution takes more samples than an image does.
# `chdstat.rendering.render_pixels` draws them for the pixels that we ask for, and for no others.

x = chd.rendering.render_pixels("bathroom", list(pixels.values()), spp=8192, size=SIZE, seed=2)
x.shape  # pixel, channel, sample

# %%
# Linear and logarithmic histograms
# ---------------------------------
#
# The histograms are those of the paper: 100 bins, evenly spaced in radiance on a support that fits
# the first 50 samples, or evenly spaced in log10 of radiance from 1e-5 to 1e5. Null samples are a
# point mass and no part of a density; they are counted beside the histogram.

viz.chd_grid([viz.Panel.of(name, x[i]) for i, name in enumerate(pixels)])

# %%
# Dashed lines are the means, nulls included, which is all that the image keeps. In the sunlit tub
# a path either sees the sun, and then brings nearly always the same radiance, or it does not. At
# the edge of the shadow the sun adds a second, narrow mode to the right of a broad one, at a place
# of its own in each channel because the floor is brown. The logarithmic axis shows all this; the
# linear one hides what is dark.

null = (x == 0).all(axis=1).mean(axis=-1)
tub = x[1, 1]
near = np.mean(np.abs(tub / tub.mean() - 1) < 0.1)
sentence = (
    f"Four pixels of one image have four kinds of distributions: between {null.min():.0%} and "
    f"{null.max():.0%} of their samples are null, and in the sunlit tub only {near:.1%} of the "
    f"samples lie within 10 % of the mean that the image shows."
)
print(sentence)

# %%
# The pixel on the wall as numbers:

wall = chd.histogram(x[0], scale="log", null=(x[0] == 0).all(axis=0))
print("in bins", wall.counts.sum(axis=-1), "null", wall.null_count, "darker", wall.underflow)

# %%
# **Next:** `Batches of samples and their means <plot_3_batches.html>`_ shows what such
# distributions do to averages of a few samples, and `A case study of four scenes
# <../studies/plot_1_case_study.html>`_ looks at all regions of four scenes.
