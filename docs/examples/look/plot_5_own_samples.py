"""
Bring your own samples
======================

What if the samples come from another renderer, or from no renderer at all?
"""

# %%
# Every function takes NumPy arrays with the samples on the last axis. Here are three pixels that a
# renderer of yours might have written: 1000 samples each, some of them null.

import tempfile

import numpy as np

import chdstat as chd
from chdstat import viz

rng = np.random.default_rng(1)
x = rng.gamma([[0.5], [2.0], [8.0]], size=(3, 1000))
x[0, :400] = 0

null = x == 0
found = chd.fit.select(x, null=null)
tail = chd.fit.tail_index(x, null=null)
for i, (name, xi) in enumerate(zip(found.names, tail.xi, strict=True)):
    print(f"pixel {i}: {null[i].mean():.0%} nulls, {name}, tail index {xi:+.2f}")

# %%
# The density of a fit over the histogram of its samples:

family = str(found.names[1])
linear, log = (chd.histogram(x[1], scale=scale) for scale in ("linear", "log"))
viz.fits(linear, log, {family: chd.fit.fit(x[1], family).pdf})

# %%
# The samples were drawn from a gamma distribution of shape 2.

shape = chd.fit.fit(x[1], "gamma").parameters["shape"]
sentence = (
    f"An array with the samples last is all that a fit needs: of a thousand samples of a gamma "
    f"distribution of shape 2, chdstat says {family}, and a gamma fit has the shape "
    f"{float(shape):.2f}."
)
print(sentence)

# %%
# A whole image
# -------------
#
# `Samples.from_array` wraps an array (y, x, channel, sample), and the features if you have them.
# From then on it is an image like any other.

brightness = np.linspace(0.2, 1.0, 24)[:, np.newaxis, np.newaxis, np.newaxis]
samples = chd.Samples.from_array(brightness * rng.gamma(0.5, size=(24, 24, 3, 256)), scene="mine")
patterns = chd.classify(samples)
print(samples)
print(f"null-heavy: {float(patterns['null_heavy'].mean()):.0%} of the pixels")

# %%
# Estimates for other programs
# ----------------------------
#
# `chdstat.io.write_exr` writes an image with any number of layers.

image = chd.estimators.gmon_adaptive(samples.read())
with tempfile.TemporaryDirectory() as folder:
    mean = samples.read().mean(axis=-1)
    path = chd.io.write_exr(f"{folder}/mine.exr", image, extra={"mean": mean})
    print(sorted(chd.io.read_exr(path).extra))

# %%
# The command line and the explorer read such images from stores, which `chdstat.render` writes.
#
# **Next:** `Is it noise, or an edge in the pixel? <plot_6_within_the_pixel.html>`_
