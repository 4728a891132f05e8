"""
How sure is an estimate?
========================

An estimate comes with a certainty and an interval. Can they be trusted?
"""

# %%
# We estimate the bathroom from the first 32 samples of each pixel, without a reference.

# sphinx_gallery_panel = 2, 1
import matplotlib.pyplot as plt

import chdstat as chd
from chdstat import viz

few = chd.render("bathroom", spp=32, size=(48, 48), seed=6, backend="scalar")
found = chd.estimate(few, level=0.9, progress=False)

# %%
# Certainty is the weight of all candidates but the mean. The interval is meant to contain the
# truth with a probability of 90 %.

width = (found.high - found.low).mean(axis=-1) / found.radiance.mean(axis=-1)
figure = viz.map_grid(3)
left, middle, right = figure.axes
viz.image_map(found.radiance, title="Estimate from 32 samples", ax=left)
viz.value_map(found.certainty, title="Certainty", limits=(0, 1), ax=middle)
viz.value_map(width, title="Width of the interval ÷ estimate", limits=(0, 3), ax=right)
figure

# %%
# Count how often it holds
# ------------------------
#
# The mean of 2048 other samples stands for the truth. Against a mean of a hundred, even perfect
# intervals would seem to miss far more than they do.

reference = chd.render("bathroom", spp=2048, size=(48, 48), seed=7).read()
reference = reference.mean(axis=-1, dtype=float)
levels, shares = (0.5, 0.8, 0.9, 0.95), []
for level in levels:
    at = chd.estimate(few, level=level, progress=False)
    shares.append(((at.low <= reference) & (reference <= at.high)).mean())
with viz.style():
    figure, ax = plt.subplots(figsize=(3.4, 2.8))
    ax.plot(levels, levels, "--", color="#888888", label="stated")
    ax.plot(levels, shares, "o-", label="measured: bathroom, 32 spp")
    ax.set(xlabel="stated", title="Intervals that contain the reference")
    ax.legend()
figure

# %%
# **Next:** `Denoise from a better start <plot_25_denoise.html>`_ passes an estimate on to a
# denoiser.
