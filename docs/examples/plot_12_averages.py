"""
How many samples until averages are Gaussian?
=============================================

Error bars and many denoisers assume that the mean of a pixel's samples is normally distributed.
From how many samples on is that so?
"""

# %%
# `chdstat.inference.gaussianity_of_means` averages N samples at a time, for N = 1, 2, 4 and so on,
# and tests 32 such averages of each pixel for every N.

import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.inference import gaussianity_of_means

samples = chd.render("cornell-box", spp=512, size=(48, 48), seed=1, backend="scalar")
found = gaussianity_of_means(samples)

# %%
# Left, the share of pixels in which the test rejects; right, the quartiles of the skewness over the
# pixels, and what the central limit theorem predicts from the skewness of single samples.

quartiles = np.nanquantile(found["skewness"], (0.25, 0.5, 0.75), axis=(0, 1, 2))
predicted = found["predicted_skewness"].median(["y", "x", "channel"])
rejected = {name: found["rejected_share"].sel(channel=name) for name in "RGB"}
viz.averages(found["size"], rejected, quartiles, predicted, alpha=0.05)

# %%
# The averages follow the theorem, but it is slow: skewness falls with one over the square root of
# N, so that 16 samples leave a quarter of it.
#
# Where in the image
# ------------------
#
# For each pixel, the smallest N from which on its averages pass.

figure = viz.map_grid(2, columns=2)
left, right = figure.axes
viz.image_map(samples.read().mean(axis=-1), title="Mean of 512 samples", ax=left)
viz.n_needed(found["n_needed"].sel(channel="G"), found["size"], title="N needed, green", ax=right)
figure

# %%
# A test of 32 averages misses small departures: passing it means that an error bar from 32 batches
# is reasonable, not that the averages are exactly Gaussian.
#
# **Next:** `Modes across the edge of a shadow <plot_13_modes.html>`_ counts the modes of the
# distributions.
