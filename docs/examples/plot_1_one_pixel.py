"""
The distributions behind an image
==================================

A path tracer draws many radiance samples for each pixel, averages them, and throws them away. Here
we keep them, and look at the distribution that they come from: the pixel's *characteristic
distribution*, CHD for short.
"""

# %%
# Render an image and keep every sample
# --------------------------------------
#
# The built-in bathroom is lit through one window, so that most paths find no light.
# `chdstat.render` returns all samples, here in memory; with ``out="bathroom.zarr"`` they would go
# to disk. The ``scalar`` backend runs on every machine.

import numpy as np

import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=64, size=(96, 96), seed=1, backend="scalar")
samples

# %%
# The image is the average over the last axis: of 64 numbers per pixel and channel it keeps one.
# We mark four pixels, and the pixels around each.

pixels = {
    "wall": (11, 67),
    "sunlit tub": (66, 81),
    "edge of the shadow": (84, 33),
    "below the vanity": (59, 37),
}
marks = [
    viz.Mark(name, slice(y - 2, y + 3), slice(x - 2, x + 3), (y, x))
    for name, (y, x) in pixels.items()
]
image = samples.read().mean(axis=-1)
viz.with_marks(image, marks)

# %%
# Thousands of samples of a few pixels
# ------------------------------------
#
# A distribution shows itself with more samples than an image needs.
# `chdstat.rendering.render_pixels` draws them for the pixels that we ask for, and for no others.

x = chd.rendering.render_pixels("bathroom", list(pixels.values()), spp=8192, size=(96, 96), seed=2)
x.shape  # pixel, channel, sample

# %%
# A *null* sample is one whose channels are all exactly 0: the path met no light. Nulls are a point
# mass, not part of any density, so they are counted apart.

null = (x == 0).all(axis=1)
for name, share in zip(pixels, null.mean(axis=-1), strict=True):
    print(f"{name:18} {share:4.0%} nulls")

# %%
# Linear and log10 histograms, as in the paper
# --------------------------------------------
#
# `chdstat.histogram` counts the other samples in 100 bins: evenly spaced in radiance, on a support
# that fits the first 50 samples, and evenly spaced in log10 of radiance from 1e-5 to 1e5. What
# falls outside is counted, never folded into the last bin.


def panel(name: str, x: np.ndarray) -> viz.Panel:
    null = (x == 0).all(axis=0)
    linear, log = (chd.histogram(x, scale=scale, null=null) for scale in ("linear", "log"))
    return viz.Panel(name, linear, log, mean=x.mean(axis=-1), note=f"{null.mean():.0%} nulls")


viz.chd_grid([panel(*pixel) for pixel in zip(pixels, x, strict=True)])

# %%
# Dashed lines are the averages, nulls included, which is all that the image keeps. In the sunlit
# tub, hardly any sample is near the average: either a path sees the sun, and brings nearly always
# the same, or it does not. At the edge of the shadow the sun makes a second, narrower hump to the
# right of a broad one, at a place of its own in each channel, since the floor is brown. The log
# axis shows this; the linear one hides most of what is dark.
