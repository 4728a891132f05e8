"""
Robust estimators in place of the mean
======================================

The mean of a few samples is unbiased, but one bright sample can ruin it. What do estimators that
weigh such samples down gain, and what do they lose?
"""

# %%
# The caustics of this scene are fireflies waiting to happen. The first 32 samples of each pixel are
# the render; the others only judge.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("caustic", spp=512, size=(64, 64), seed=1, backend="scalar")
few = samples.read(ss=slice(0, 32))

# %%
# An estimator is a function of samples on the last axis. Those that look at the pixels around, as
# that of Zirr, Hanika and Dachsbacher (2018) does, take the whole image.

estimators = chd.estimators
images = {
    "mean": estimators.mean(few),
    "median_of_means": estimators.median_of_means(few),
    "zirr2018": estimators.zirr2018(few),
}
viz.side_by_side(images | {"mean of 512": samples.read().mean(axis=-1)})

# %%
# Both estimators remove fireflies, and some of the light with them: they take rare bright samples
# for mistakes, although these carry energy. So always read the error together with the bias:

chd.compare(samples, list(images), n=32, progress=False)

# %%
# The names of all estimators:

names = chd.estimators.names()
print(len(names), "estimators:", ", ".join(names[:8]), "...")

# %%
# **Next:** `The paper's network <plot_20_network.html>`_ learns an estimator; `Compare estimators
# side by side <plot_22_compare.html>`_ measures several of them on many batches.
