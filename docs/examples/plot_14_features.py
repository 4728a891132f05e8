"""
Do surface features tell where the noise is?
============================================

Many denoisers are guided by what a camera ray hits first: albedo, normal, depth and position. How
much of the noise do such features explain?
"""

# %%
# `chdstat.render` stores these features beside the samples.

# sphinx_gallery_panel = 1, 2
import numpy as np
from scipy.stats import spearmanr

import chdstat as chd
from chdstat import viz
from chdstat.studies.claims import PlotData

samples = chd.render("bathroom", spp=64, size=(64, 64), seed=1, backend="scalar")
features = samples.features
summary = chd.summarize(samples)
noise = (summary["variance"] ** 0.5 / summary["mean"]).mean("channel").values

figure = viz.map_grid(4, columns=4)
axes = iter(figure.axes)
viz.image_map(features["albedo"], title="Albedo", exposure=0, ax=next(axes))
viz.image_map(features["normal"] / 2 + 0.5, title="Normal", exposure=0, ax=next(axes))
viz.value_map(features["depth"], title="Depth", ax=next(axes))
viz.value_map(noise, title="Standard deviation ÷ mean", limits=(0, 6), ax=next(axes))
figure

# %%
# The shadow of the vanity, the sunlight on the floor and what the mirror shows are in the noise but
# in none of the features.
#
# Albedo and noise, pixel by pixel
# --------------------------------

albedo = features["albedo"].mean(axis=-1)
points = {"pixels": (albedo.ravel(), noise.ravel())}
labels = "albedo", "standard deviation over mean"
viz.finding_plots({"bathroom": PlotData("points", points, *labels)})

# %%
# Pixels of one albedo have all kinds of noise. Spearman's rank correlation puts numbers to it: 0
# where a feature says nothing, 1 or -1 where it orders the pixels by their noise.

for name, values in {"albedo": albedo, "depth": features["depth"]}.items():
    seen = np.isfinite(values) & np.isfinite(noise)
    print(f"{name:7} {spearmanr(values[seen], noise[seen]).statistic:+.2f}")

# %%
# **Next:** `A map of patterns <plot_15_patterns.html>`_ describes the pixels by their samples
# instead. Features do help an estimator that also sees the samples: `A better image without a
# reference <plot_21_estimate.html>`_.
