"""
Are two renders the same?
=========================

A renderer was changed, and its image looks the same. Is it? `chdstat.contrast` tests pixels and
windows of all sizes, and says how large a loss it would have found.
"""

# %%
# A path tracer, the same with another seed, and one that leaves out long paths.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

view = {"spp": 48, "size": (48, 48), "backend": "scalar"}
samples = chd.render("cornell-box", seed=1, **view)
again = chd.render("cornell-box", seed=2, **view)
shorter = chd.render("cornell-box", seed=3, max_depth=4, **view)

print(chd.contrast(samples, again).conclusion)

# %%
# Of shorter paths, single pixels show little at 48 samples, and windows much.

found = chd.contrast(samples, shorter, distributions=True)
viz.contrast(found)

# %%
# A mean is not all: where paths are cut, the distributions differ too. Each map of p-values has one
# of q-values, which hold the share of false alarms over the image.

for name in ("q_value", "distribution_q_value"):
    print(f"{name:22}{float((found.maps[name] <= 0.05).mean()):4.0%} of the pixels are below 0.05")

# %%
# **Next:** `Robust estimators in place of the mean <plot_19_estimators.html>`_ turns from
# describing samples to estimating from them. The `how-to page <../how-to/contrast-renders.html>`_
# is about equal seeds, converged images and the tests of a renderer.
