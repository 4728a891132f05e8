"""
The distributions behind a picture
==================================

A path tracer draws many radiance samples for each pixel, averages them, and throws them away. Here
we keep them, and look at the distribution that they come from: the pixel's *characteristic
distribution*, CHD for short.
"""

# %%
# Render a picture and keep every sample
# --------------------------------------
#
# The built-in bathroom is lit through one window, so that most paths find no light.
# `chdstat.render` returns all samples, here in memory; with ``out="bathroom.zarr"`` they would go
# to disk. The ``scalar`` backend runs on every machine.

import chdstat as chd
from chdstat import viz
from chdstat.recipes import find_recipe

samples = chd.render("bathroom", spp=64, size=(96, 96), seed=1, backend="scalar")
samples

# %%
# The picture is the average over the last axis: of 64 numbers per pixel and channel it keeps one.
# The recipe of the bathroom names regions of interest; we mark four of them.

regions = {region.name: region for region in find_recipe("bathroom").regions}
names = ["wall", "tub-sunlit", "floor-shadow", "under-vanity"]
marks = []
for name in names:
    region = regions[name]
    marks.append(viz.Mark(name, *region.pixels(96, 96), region.center(96, 96)))
picture = samples.read().mean(axis=-1)
viz.with_marks(picture, marks)

# %%
# Thousands of samples of a few pixels
# ------------------------------------
#
# A distribution shows itself with more samples than a picture needs. `chdstat.render_pixels` draws
# them for the pixels that we ask for, and for no others.

pixels = [mark.pixel for mark in marks]
x = chd.render_pixels("bathroom", pixels, spp=8192, size=(96, 96), seed=2)
x.shape  # pixel, channel, sample

# %%
# A *null* sample is one whose channels are all exactly 0: the path met no light. Nulls are a point
# mass, not part of any density, so they are counted apart.

null = (x == 0).all(axis=1)
for name, share in zip(names, null.mean(axis=-1), strict=True):
    print(f"{name:14} {share:4.0%} nulls")

# %%
# Linear and log10 histograms, as in the paper
# --------------------------------------------
#
# `chdstat.histogram` counts the other samples in 100 bins: evenly spaced in radiance, on a support
# that fits the first 50 samples, and evenly spaced in log10 of radiance from 1e-5 to 1e5. What
# falls outside is counted, never folded into the last bin.


def panel(pixel: int) -> viz.Panel:
    curves = {}
    for scale in ("linear", "log"):
        h = chd.histogram(x[pixel], scale=scale, null=null[pixel])
        channels = zip(samples.channels, h.edges, h.density, strict=True)
        curves[scale] = {c: viz.Curve(edges, density) for c, edges, density in channels}
    means = dict(zip(samples.channels, x[pixel].mean(axis=-1), strict=True))
    note = f"{null[pixel].mean():.0%} nulls"
    return viz.Panel(names[pixel], curves["linear"], curves["log"], means, note)


viz.chd_grid([panel(pixel) for pixel in range(len(names))])

# %%
# Dashed lines are the averages, nulls included, which is all that the picture keeps. In the sunlit
# tub, hardly any sample is near the average: either a path sees the sun, and brings nearly always
# the same, or it does not. At the edge of the shadow the sun makes a small second hump to the right
# of a broad one, at a place of its own in each channel, since the floor is brown. The log axis
# shows this; the linear one hides most of what is dark.
