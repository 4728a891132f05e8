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

samples = chd.render("bathroom", spp=32, size=(96, 96), seed=1, backend="scalar")
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
viz.finding_plots({"bathroom": PlotData("points", points, *labels)}, width="column")

# %%
# Pixels of one albedo have all kinds of noise. Spearman's rank correlation puts numbers to it: 0
# where a feature says nothing, 1 or -1 where it orders the pixels by their noise. Its square is the
# share of the order that a feature explains.

found = {}
for name, values in {"albedo": albedo, "depth": features["depth"]}.items():
    seen = np.isfinite(values) & np.isfinite(noise)
    rho = found[name] = spearmanr(values[seen], noise[seen]).statistic
    print(f"{name:7} {rho:+.2f}, {rho**2:.1%} of the order explained")

most = max(found, key=lambda name: abs(found[name]))
sentence = (
    f"What a camera ray hits first says little of the noise behind it: of albedo and depth, {most} "
    f"orders the pixels best, and explains {found[most] ** 2:.1%} of the order of their noise."
    if abs(found[most]) < 0.5
    else f"Of albedo and depth, {most} explains {found[most] ** 2:.0%} of the order of the noise."
)
print(sentence)

# %%
# **Next:** `A map of patterns <../fit/plot_4_patterns.html>`_ describes the pixels by their samples
# instead. Features do help an estimator that also sees the samples: `A better image without a
# reference <../compare/plot_5_estimate.html>`_.
