"""
An atlas of distributions
=========================

Patterns are defined beforehand. Which shapes of distributions does an image have when nobody tells
what to look for?
"""

# %%
# `chdstat.atlas` moves the log histogram of each pixel so that brightness plays no part, groups the
# shapes, and chooses how many groups the samples support: shapes found in one half of the samples
# must predict the other half.

import chdstat as chd
from chdstat import viz

samples = chd.render("cornell-box", spp=256, size=(48, 48), seed=4, backend="scalar")
atlas = chd.atlas(samples)
viz.atlas(atlas)

# %%
# Each panel is the typical shape of one group, as density per decade around the pixel's own scale;
# the band holds the middle half of its pixels. The numbers in the map mark the most typical pixel
# of each group.
#
# How far to trust it
# -------------------
#
# Neighbouring groups blend into each other, and a pixel between two may fall on either side. The
# adjusted Rand index says how far the labels from two halves of the samples agree.

for number, explained in zip(atlas.candidates, atlas.explained, strict=True):
    print(f"{number:2} shapes explain {explained:4.0%} of what one half repeats of the other")
found = dict(zip(atlas.candidates, atlas.explained, strict=True))[len(atlas.medoids)]
sentence = (
    f"Without being told what to look for, {len(atlas.medoids)} shapes explain {found:.0%} of what "
    f"one half of the samples says of the other; the maps of both halves agree to an adjusted "
    f"Rand index of {atlas.stability:.2f}, where 1 is the same map and 0 is chance."
)
print(sentence)

# %%
# The most typical pixels in detail
# ---------------------------------

x = chd.rendering.render_pixels("cornell-box", atlas.medoids, spp=2048, size=(48, 48), seed=5)
viz.chd_grid([viz.Panel.of(f"row {y}, column {c}", x[i]) for i, (y, c) in enumerate(atlas.medoids)])

# %%
# **Next:** `Are two renders the same? <../contrast/plot_1_two_renders.html>`_
