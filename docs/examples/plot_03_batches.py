"""
Batches of samples and their means
==================================

A render with 32 samples per pixel takes one batch of the distribution and shows its mean. How much
do such means vary from batch to batch, and are they symmetric around the true value?

This is the first figure of Elek, Thomas and Forbes (2019).
"""

# %%
# We draw five pixels of the bathroom at random, and 64 batches of 32 samples for each.

import numpy as np

import chdstat as chd
from chdstat import viz

SIZE = (64, 64)
rng = np.random.default_rng(7)
pixels = rng.integers(4, 60, size=(5, 2))
marks = [
    viz.Mark(f"pixel {i + 1}", slice(y - 2, y + 3), slice(x - 2, x + 3), (y, x))
    for i, (y, x) in enumerate(pixels.tolist())
]
x = chd.rendering.render_pixels("bathroom", pixels, spp=64 * 32, size=SIZE, seed=3)
green = x[:, 1].reshape(5, 64, 32)

# %%
# Above, the 64 batches of each pixel are drawn over each other; below are their means. The dashed
# line is the mean of all samples.

viz.batch_histograms({mark.name: batches for mark, batches in zip(marks, green, strict=True)})

# %%
# Most samples lie below the mean, and a few far above it carry much of the energy. The means
# inherit part of that skew: in the last two pixels more than half of them are too dark, and the
# brightest of the 64 is more than three times the true value. Such a mean is a firefly in an image.

means = green.mean(axis=-1)
for mark, of_pixel in zip(marks, means, strict=True):
    low = (of_pixel < of_pixel.mean()).mean()
    print(f"{mark.name}: {low:.0%} of the means are too dark, largest / mean = ", end="")
    print(f"{of_pixel.max() / of_pixel.mean():.2f}")

# %%
# Where the pixels are:

samples = chd.render("bathroom", spp=32, size=SIZE, seed=1, backend="scalar")
viz.with_marks(samples.read().mean(axis=-1), marks)

# %%
# **Next:** `How many samples until averages are Gaussian? <plot_12_averages.html>`_
