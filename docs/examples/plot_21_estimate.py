"""
A better image without a reference
==================================

A render has no reference: its samples are all there is. How do these say which of several images is
nearest to the truth?
"""

# %%
# The first 32 samples of each pixel are the render. All others only judge it at the end.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("night-room", spp=512, size=(48, 48), seed=6, backend="scalar")
few = samples.first(32)

# %%
# `chdstat.estimate` weights candidates pixel by pixel: the mean, a mean over pixels of similar
# distributions, and what a denoiser makes of both. Candidates made of one half of the samples are
# compared with the mean of the other half. That mean is noisy, but its expectation is the truth.

found = chd.estimate(few, progress=False)

# %%
# Mean, estimate and the mean of all samples, under one exposure:

mean = few.read().mean(axis=-1)
viz.side_by_side(
    {"mean of 32": mean, "estimate": found.radiance, "mean of 512": samples.read().mean(axis=-1)}
)

# %%
# How much closer it is, `chdstat.compare` measures against the other samples, without their noise:

chd.compare(samples, ["mean", "combination"], max_batches=4, progress=False)

# %%
# The weights of the candidates, which sum to 1 in every pixel:

weights = found.weights
figure = viz.map_grid(len(weights), columns=3)
for ax, (name, weight) in zip(figure.axes, weights.items(), strict=False):
    viz.value_map(weight, title=name, limits=(0, 1), ax=ax)
figure

# %%
# The command line writes an EXR with the estimate, its interval and its certainty:
# ``chdstat estimate night-room -o night.exr``.
#
# **Next:** `How sure is an estimate? <plot_24_certainty.html>`_
