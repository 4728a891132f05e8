"""
An atlas of shapes
==================

Patterns are known beforehand. `chdstat.atlas` asks the other way round: which distributions does
this image have? It moves the log histogram of every pixel so that brightness plays no part, groups
the shapes, and says how many groups the samples bear out.
"""

# %%
# Render, then find the shapes
# ----------------------------
#
# The samples of each pixel are halved at random: a number of shapes is as good as the shapes found
# in one half predict the other half. Shapes that only follow noise predict nothing.

import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=512, size=(64, 64), seed=4, backend="scalar")
atlas = chd.atlas(samples)
for number, explained in zip(atlas.candidates, atlas.explained, strict=True):
    print(f"{number:2} shapes explain {explained:4.0%} of what one half repeats of the other")

# %%
# The map and the shapes
# ----------------------
#
# Each panel is the typical shape of one group: the mean density per decade around the pixel's own
# scale, with the quartiles over its pixels as a band. The numbers in the map mark the pixel that
# is nearest to it.

viz.atlas(atlas)

# %%
# How far to trust the map
# ------------------------
#
# Shapes of neighbouring groups pass into each other, and a pixel between two may fall on either
# side: the adjusted Rand index says how far two halves of the samples agree on the labels.

print(f"repeatable share of the variation: {atlas.repeatable:.0%}")
print(f"adjusted Rand index between halves: {atlas.stability:.2f}")

# %%
# The pixel behind a shape
# ------------------------
#
# The most typical pixel of each shape is a good one to look at closely, here that of the second.

y, x = atlas.medoids[1]
green = samples[y, x][1]
names = ("gamma", "lognormal")
viz.fits(
    chd.histogram(green, scale="linear"),
    chd.histogram(green, scale="log"),
    {name: chd.fit.fit(green, name).pdf for name in names},
    title=f"pixel y {y}, x {x}, green",
)
