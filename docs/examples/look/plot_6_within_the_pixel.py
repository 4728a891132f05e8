"""
Is it noise, or an edge in the pixel?
=====================================

Most samples of a pixel are null, as if its light were hard to find. Are its paths to blame, or does
an edge run through the pixel?
"""

# %%
# With ``film=True``, a render keeps where in its pixel each sample fell. `film_split
# <chdstat.patterns.film_split>` tells the variance of paths from that of the picture within the
# pixel.

# sphinx_gallery_panel = 1, 1
import chdstat as chd
from chdstat import viz

samples = chd.render("cornell-box", spp=256, size=(48, 48), film=True, backend="scalar", seed=1)
split = chd.patterns.film_split(samples)
viz.film_split(split).figure

# %%
# The frame of the box, the lamp and the edges of the two blocks stand out; walls are grey, as
# nothing that is significant over the image changes within their pixels.

share = split["share_told"]
y, x = map(int, share.argmax(...).values())
pixel = samples.pixel(y, x)
print(f"label: {pixel.label}", pixel.variance_by_place, sep="\n")
viz.pixel_by_place(pixel)

# %%
# An edge is seen at once. Strata over the pixel would take this part of its noise; more samples,
# or better paths, are for the rest. How many pixels are like this?

sentence = (
    f"The picture changes within {float((split['rejected'] == 1).mean()):.0%} of the pixels, and "
    f"makes most of the variance in {float((share > 0.5).mean()):.0%}; in the median pixel it is "
    f"{float(split['share'].median()):.1%} of it."
)
print(sentence)

# %%
# **Next:** `Fit families of distributions to a pixel <../fit/plot_1_fit.html>`_. `How much of the
# noise is the picture itself <../../understand/within-pixels.html>`_ says how it is measured.
