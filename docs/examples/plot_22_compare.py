"""
Compare estimators side by side
===============================

Which estimator is best depends on the measure, on the scene, and on the pixel. How do several of
them do on the same samples?
"""

# %%
# `chdstat.compare` cuts the samples of every pixel of the hall into batches of 32. Each estimator
# estimates from each batch, and is judged against the mean of all other samples of the pixel.

import chdstat as chd
from chdstat import viz

samples = chd.render("gallery", spp=128, size=(48, 48), seed=1, backend="scalar")
names = ["mean", "trimmed_mean", "median_of_means", "gmon_adaptive", "zirr2018", "shared_shape"]
found = chd.compare(samples, names, labels="classify", progress=False)
viz.estimator_measures(found)

# %%
# Ratios are relative to the sample mean: below 1 is better. Bars show the share of estimates that
# came closer to the reference, stayed, or moved away. Lines are 95 % intervals over blocks of
# pixels. Estimators that look at one pixel gain most in relMSE and lose a seventh of the light or
# more; those that use neighbours change few pixels, mostly fireflies, and keep nearly all of it.
#
# By pattern
# ----------
#
# The same measure for each label of `chdstat.classify`. A frame marks the best estimator that looks
# at one pixel only; pale numbers may be chance.

viz.pattern_breakdown(found.breakdown).figure

# %%
# Images
# ------

images = dict(zip(found.estimators, found.estimates, strict=True))
shown = {name: images[name] for name in ("mean", "gmon_adaptive", "shared_shape")}
errors = {name: ((image - found.reference) ** 2).mean(axis=-1) for name, image in shown.items()}
viz.side_by_side(shown | {"reference": found.reference}, errors=errors)

# %%
# **Next:** `Error against the number of samples <plot_23_error_curves.html>`_
