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
from scipy.spatial import cKDTree
from scipy.stats import rankdata

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
# The fourth feature, position, is where the ray hits. The shadow of the vanity, the sunlight on the
# floor and what the mirror shows are in the noise but in none of the three maps.
#
# Albedo and noise, pixel by pixel
# --------------------------------

albedo = features["albedo"].mean(axis=-1)
points = {"pixels": (albedo.ravel(), noise.ravel())}
labels = "albedo", "standard deviation over mean"
viz.finding_plots({"bathroom": PlotData("points", points, *labels)}, width="column")

# %%
# Pixels of one albedo have all kinds of noise. But is it the same for all albedos?
#
# What each feature explains
# --------------------------
#
# We rank the pixels by their noise, and predict the rank of each by that of the 20 other pixels
# with the most similar features. Where these err by as much as the mean rank does, features explain
# nothing; where they never err, all. Ends of the intervals are percentiles of 1000 draws of 64
# blocks of pixels.

places = rankdata(noise, nan_policy="omit").ravel()
known = np.isfinite(places)
rng = np.random.default_rng(0)
rows, columns = np.indices(noise.shape) // 12
block = (rows * 8 + columns).ravel()[known]
drawn = rng.multinomial(64, np.full(64, 1 / 64), size=1000)


def explained(errors, spread):
    """Return 1 - errors / spread, and the ends of its 95 % interval."""
    errors, spread = (np.bincount(block, x, minlength=64) for x in (errors, spread))
    ends = np.quantile(1 - drawn @ errors / (drawn @ spread), [0.025, 0.975])
    return 1 - errors.sum() / spread.sum(), *ends


def predicted(*names):
    """Return the mean rank of the 20 pixels with the most similar features."""
    similar = np.concatenate([features[n].reshape(noise.size, -1)[known] for n in names], axis=1)
    similar = similar / similar.std(axis=0)
    similar += 1e-3 * rng.standard_normal(similar.shape)  # Draws among equals.
    _, near = cKDTree(similar).query(similar, 21)
    return places[known][near[:, 1:]].mean(axis=1)


true = places[known]
spread = (true - true.mean()) ** 2
sets = [("albedo",), ("depth",), ("normal",), ("albedo", "depth", "normal"), ("position",)]
found = {" + ".join(s): explained((true - predicted(*s)) ** 2, spread) for s in sets}
told = {name: f"{x:.0%} ({low:.0%} to {high:.0%})" for name, (x, low, high) in found.items()}
for name, words in told.items():
    print(f"{name:24} {words}")

# %%
# No feature explains chance, which is part of any noise that is measured from 32 samples. If r is
# the rank correlation of the noise in the two halves of the samples, 2 r / (1 + r) of the order of
# all of them can be explained (Spearman and Brown's formula).


def ranked(half):
    """Return the ranks of the known pixels by their noise in some of the samples."""
    x = samples.read(ss=half)
    with np.errstate(invalid="ignore"):
        return rankdata((x.std(axis=-1) / x.mean(axis=-1)).mean(axis=-1), nan_policy="omit")


one, other = (ranked(half).ravel()[known] for half in (slice(0, 16), slice(16, 32)))
both = np.isfinite(one) & np.isfinite(other)
halves = [
    np.where(both, part, 0) for part in ((one - other) ** 2 / 2, (one - np.nanmean(one)) ** 2)
]
r = np.array(explained(*halves))
most = 2 * r / (1 + r)

alone = max(found[name][2] for name in ("albedo", "depth", "normal"))
sentence = (
    f"Position, which is what the pixels around share, explains {told['position']} of the order of "
    f"the pixels by noise; albedo, depth and normal explain {told['albedo + depth + normal']} "
    f"together, and each alone at most {alone:.0%}. As part of it is chance, "
    f"more than {most[0]:.0%} ({most[1]:.0%} to {most[2]:.0%}) cannot be explained."
)
print(sentence)

# %%
# **Next:** `A map of patterns <../fit/plot_4_patterns.html>`_ describes the pixels by their samples
# instead. Features do help an estimator that also sees the samples: `A better image without a
# reference <../compare/plot_5_estimate.html>`_.
