"""
A better image without a reference
==================================

A render has no reference: its samples are all there is. How can an estimator learn from those
alone?
"""

# %%
# The first 32 samples of each pixel are the render. The others only judge it at the end.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("night-room", spp=128, size=(48, 48), seed=6, backend="scalar")
few = samples.first(32)

# %%
# `chdstat.estimate` shows a network one part of a pixel's samples and asks for the mean of the
# others. That mean is noisy, but its expectation is the truth, so the network learns the truth. It
# also sees what the camera rays hit first, and the pixels around. By default it takes 2000 steps;
# 80 keep this page short.

found = chd.estimate(few, iterations=80, progress=False)

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
# How far the estimate moves from the mean is measured on pixels that did not train it. Where the
# training has learned nothing, the mean stays.
#
# The command line writes an EXR with the estimate, its interval and its certainty:
# ``chdstat estimate night-room -o night.exr``.
#
# **Next:** `How sure is an estimate? <plot_24_certainty.html>`_
