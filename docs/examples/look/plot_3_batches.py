"""
Batches of samples and their means
==================================

A render with 32 samples per pixel takes one batch of the distribution and shows its mean. How much
do such means vary from batch to batch, and are they symmetric around the true value?

This is the first figure of Elek, Thomas and Forbes (2019).
"""

# %%
# We draw five pixels of the bathroom at random, and 64 batches of 32 samples for each. Above, the
# batches of each pixel are drawn over each other; below are their means. The dashed line is the
# mean of all samples.

import numpy as np

import chdstat as chd
from chdstat import viz

SIZE = (128, 128)
pixels = np.random.default_rng(7).integers(8, 120, size=(5, 2))
names = [f"pixel {i + 1}" for i in range(len(pixels))]
x = chd.rendering.render_pixels("bathroom", pixels, spp=64 * 32, size=SIZE, seed=3)
green = x[:, 1].reshape(5, 64, 32)
viz.batch_histograms(dict(zip(names, green, strict=True)))

# %%
# Most samples lie below the mean, and a few far above it carry much of the energy. The means
# inherit some of that skew. A mean far above the truth is a firefly in an image.

means, truth = green.mean(axis=-1), green.mean(axis=(1, 2))
largest = means.max(axis=1) / truth
for name, of_pixel, true, factor in zip(names, means, truth, largest, strict=True):
    low = (of_pixel < true).mean()
    print(f"{name}: {low:.0%} of the means are too dark, largest / truth = {factor:.2f}")

worst, calm = largest.argmax(), largest.argmin()
below = (green < truth[:, None, None]).mean(axis=(1, 2))
sentence = (
    f"Of the samples of these pixels, {below.min():.0%} to {below.max():.0%} lie below the mean. "
    f"The largest of 64 means of 32 samples is {largest[calm]:.1f} times the truth in "
    f"{names[calm]} and {largest[worst]:.1f} times in {names[worst]}."
)
print(sentence)

# %%
# Where the pixels are, in an image of few samples that went through a denoiser:

samples = chd.render("bathroom", spp=12, size=SIZE, seed=1, backend="scalar")
features = {name: samples.features[name] for name in ("albedo", "normal")}
marks = [
    viz.Mark(name, slice(y - 4, y + 5), slice(x - 4, x + 5), (y, x))
    for name, (y, x) in zip(names, pixels.tolist(), strict=True)
]
viz.with_marks(chd.io.denoise(samples.read().mean(axis=-1), **features), marks)

# %%
# **Next:** `How many samples until averages are Gaussian? <../test/plot_2_averages.html>`_
