"""
How many samples until averages are Gaussian?
=============================================

Error bars and many denoisers assume that the mean of a pixel's samples is normally distributed.
From how many samples on is that so?
"""

# %%
# `chdstat.inference.gaussianity_of_means` averages N samples at a time, for N = 1, 2 and so on,
# and tests such averages of each pixel for every N.

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
# N.

first, last = (found["rejected_share"].isel(size=i).mean("channel").item() for i in (0, -1))
sizes = found["size"].values
sentence = (
    f"Averages of {sizes[-1]} samples are not yet Gaussian everywhere: the test, which rejects "
    f"{first:.0%} of the pixels for single samples, still rejects {last:.0%}. Their skewness has "
    f"fallen from {quartiles[1][0]:.1f} to {quartiles[1][-1]:.1f}."
)
print(sentence)

# %%
# Where in the image
# ------------------
#
# For each pixel, the smallest N from which on its averages pass.

figure = viz.map_grid(2, columns=2)
left, right = figure.axes
larger = chd.render("cornell-box", spp=8, size=(144, 144), seed=2, backend="scalar")
seen = {name: larger.features[name] for name in ("albedo", "normal")}
viz.image_map(chd.io.denoise(larger.read().mean(axis=-1), **seen), title="The scene", ax=left)
viz.n_needed(found["n_needed"].sel(channel="G"), found["size"], title="N needed, green", ax=right)
figure

# %%
# A test of a few averages misses small departures: passing it means that an error bar from as many
# batches is reasonable, not that the averages are exactly Gaussian.
#
# **Next:** `How many samples does a test need? <plot_3_power.html>`_
