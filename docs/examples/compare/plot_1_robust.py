"""
Robust estimators in place of the mean
======================================

The mean of a few samples is unbiased, but one bright sample can ruin it. What do estimators that
weigh such samples down gain, and what do they lose?
"""

# %%
# The caustics of this scene are fireflies waiting to happen. The first 32 samples of each pixel are
# the render; the others only judge.
#
# An estimator is a function of samples on the last axis. Those that look at the pixels around, as
# that of Zirr, Hanika and Dachsbacher (2018) does, take the whole image.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

samples = chd.render("caustic", spp=160, size=(96, 96), seed=1, backend="scalar")
few = samples.read(ss=slice(0, 32))
estimators = chd.estimators
images = {
    "mean": estimators.mean(few),
    "median_of_means": estimators.median_of_means(few),
    "zirr2018": estimators.zirr2018(few),
}
caustics = [(slice(44, 66), slice(30, 62))]
viz.side_by_side(images | {"mean of all": samples.read().mean(axis=-1)}, insets=caustics)

# %%
# They take rare bright samples for mistakes, although these carry energy. So always read the error
# together with the bias:

found = chd.compare(samples, list(images), n=32, progress=False)
found

# %%
# In words:


def told(x):
    """Return a number with its interval."""
    return f"{x.value:.2g} ({x.low:.2g} to {x.high:.2g})"


error, bias = found.measures["relmse_ratio"], found.measures["bias"]
robust = found.estimators.index("median_of_means")
ratio, lost = error[robust, -1], bias[robust, -1]  # averaged over the channels
gain = (
    "lowers the relative squared error" if ratio.high < 1
    else "raises the relative squared error" if ratio.low > 1
    else "has a relative squared error that the intervals do not tell from that of the mean"
)  # fmt: skip
price = "loses light" if lost.high < 0 else "may or may not lose light"
sentence = (
    f"On caustics, the median of means {gain} ({told(ratio)} times it) and {price}: its "
    f"image differs by {100 * float(lost.value):+.0f} % ({100 * float(lost.low):+.0f} to "
    f"{100 * float(lost.high):+.0f} %)."
)
print(sentence)

# %%
# **Next:** `Compare estimators side by side <plot_2_compare.html>`_ measures several of them on
# many batches.
