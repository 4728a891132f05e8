"""
Look at the distribution of a pixel
===================================

The samples of a pixel are draws from its *characteristic distribution*, CHD for short. What do
CHDs look like in different parts of one image?
"""

# %%
# We mark four pixels of the bathroom, each with the pixels around it.

# sphinx_gallery_panel = 2, 6
import chdstat as chd
from chdstat import viz

SIZE = (64, 64)
samples = chd.render("bathroom", spp=32, size=SIZE, seed=1, backend="scalar")
pixels = {
    "wall": (8, 44),
    "sunlit tub": (44, 54),
    "edge of the shadow": (56, 22),
    "below the vanity": (39, 25),
}
marks = [
    viz.Mark(name, slice(y - 2, y + 3), slice(x - 2, x + 3), (y, x))
    for name, (y, x) in pixels.items()
]
viz.with_marks(samples.read().mean(axis=-1), marks)

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
# hardly any sample is near its mean: a path either sees the sun, and then brings nearly always the
# same radiance, or it does not. At the edge of the shadow the sun adds a second, narrow mode to the
# right of a broad one, at a place of its own in each channel because the floor is brown. The
# logarithmic axis shows all this; the linear one hides what is dark.
#
# The pixel on the wall as numbers:

wall = chd.histogram(x[0], scale="log", null=(x[0] == 0).all(axis=0))
print("in bins", wall.counts.sum(axis=-1), "null", wall.null_count, "darker", wall.underflow)

# %%
# **Next:** `Batches of samples and their means <plot_03_batches.html>`_ shows what such
# distributions do to averages of 32 samples, and `A case study of four scenes
# <plot_04_case_study.html>`_ looks at all regions of four scenes.
