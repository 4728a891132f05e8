"""
A better image without a reference
==================================

A render has no reference: its samples are all there is. How do these say which of several images is
nearest to the truth?
"""

# %%
# The first 32 samples of each pixel are the render. The others only judge it at the end.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("night-room", spp=128, size=(48, 48), seed=6, backend="scalar")
few = samples.first(32)

# %%
# `chdstat.estimate` weights candidates pixel by pixel: the mean, a mean over pixels of similar
# distributions, and what a denoiser makes of both. Candidates made of one half of the samples are
# compared with the mean of the other half. That mean is noisy, but its expectation is the truth.

found = chd.estimate(few, progress=False)

# %%
# Mean, estimate and reference under one exposure, with squared errors on one scale:

mean = few.read().mean(axis=-1)
reference = samples.read(ss=slice(32, 128)).mean(axis=-1)
images = {"mean of 32": mean, "estimate": found.radiance, "reference": reference}
errors = {name: ((images[name] - reference) ** 2).mean(axis=-1) for name in list(images)[:2]}
viz.side_by_side(images, errors=errors)

# %%
for name, error in errors.items():
    bias = images[name].mean() / reference.mean() - 1
    print(f"{name:11} MSE {error.mean():.5f}, bias {bias:+.1%}")
better = errors["estimate"] < errors["mean of 32"]
print(f"closer to the reference in {better.mean():.0%} of the pixels")

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
