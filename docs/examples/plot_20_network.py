"""
The paper's network
===================

Can a small network that sees 32 samples of one channel of one pixel, and nothing else, beat their
mean?

This is the model of Elek, Thomas and Forbes (2019), with the three figures of its evaluation.
"""

# %%
# We train on half of the pixels, each batch of 32 samples against the mean of all other samples of
# its pixel. The paper takes 2048 samples per pixel, 6400 pixels and 30,000 iterations; here are a
# few of each.

import chdstat as chd
from chdstat import viz

samples = chd.render("gallery", spp=512, size=(48, 48), seed=1, backend="scalar")
model = chd.estimators.MLP.preset("elek2019").train(samples, iterations=2500, progress=False)
viz.training(model.history).figure

# %%
# Dashed lines are the squared error of the sample mean. The loss on the training pixels falls far
# below it; on the validation pixels it soon stops improving, as in the paper, and remains near that
# of the mean: a thousand pixels are few.
#
# The estimate
# ------------
#
# `chdstat.compare` judges on the pixels that did not train. Below are the mean of the first 32
# samples, what the network makes of the same samples, and the mean of all.

found = chd.compare(samples, ["mean", "elek2019"], model=model, progress=False)
mean, learned = found.estimates
viz.side_by_side({"mean of 32": mean, "network": learned, "mean of all": found.reference})

# %%
# Pixel by pixel
# --------------
#
# 25 random pixels that did not train, from dark to bright. An estimate improves where its mark is
# closer to the black bar than the circle.

viz.pixel_estimates(found.draw_pixels(25)).figure

# %%
# Outliers of the mean are drawn towards the other pixels, and the darkest pixels become too bright.
# In numbers, with what the errors cost in bias:

found

# %%
# With so little data, the network is no match for what it became in the paper. ``chdstat train``
# trains it on any store, and `Compare estimators side by side <plot_22_compare.html>`_ shows how to
# judge it beside others.
#
# **Next:** `A better image without a reference <plot_21_estimate.html>`_
