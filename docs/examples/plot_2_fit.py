"""
Fit a distribution, and ask whether averages are Gaussian
=========================================================

Which family describes the samples of a pixel? And how many of them must be averaged until the
average behaves as error bars and denoisers assume, like a Gaussian?
"""

# %%
# We draw 16384 samples of three pixels of the bathroom, and look at the green channel.

import numpy as np
from matplotlib.figure import Figure

import chdstat as chd
from chdstat import viz
from chdstat.normality import gaussianity_of_means

names = ["wall", "vanity", "below the vanity"]
pixels = [(11, 67), (54, 43), (59, 37)]
x = chd.render_pixels("bathroom", pixels, spp=16384, size=(96, 96), seed=3)
null = (x == 0).all(axis=1)
green = x[:, 1]

# %%
# Gamma or log-normal?
# --------------------
#
# Every fit is zero-inflated: a point mass at 0 for the nulls, and a family for the rest. The pixels
# are a batch, so one call fits all three. `chdstat.fit.select` compares the families by BIC; the
# margin is how much better the best one is, and above 10 the evidence is very strong.

found = chd.fit.select(green, ["gamma", "lognormal"], null=null)
for name, family, margin in zip(names, found.names, found.margin, strict=True):
    print(f"{name:16} {family:10} by {margin:7.0f}")

# %%
# The best of two may still be poor, so look at it. Both densities are drawn over the log histogram:
# a density per unit of radiance becomes one per decade when multiplied by ``x log(10)``.

histogram = chd.histogram(green, null=null)
with viz.style():
    figure = Figure(figsize=(6.7, 2.2), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, 3)):
        curve = viz.Curve(histogram.edges[i], histogram.density[i])
        viz.chd_axes(axes, {"G": curve}, scale="log")
        radiance = histogram.centers[i]
        for family, color in zip(found.families, viz.PALETTE[4:], strict=False):
            density = found.fits[family].pdf(radiance)[i] * radiance * np.log(10)
            axes.plot(radiance, density, color=color, label=family)
        axes.set(title=names[i], xlabel="radiance (log scale)")
    figure.axes[0].legend(loc="upper left")
figure

# %%
# Neither follows the samples: the wall is more peaked than both, and below the vanity there are
# several humps that no single family has. Such shapes are why Elek, Thomas and Forbes (2019) look
# for patterns instead of parameters.
#
# Averages of N samples
# ---------------------
#
# `chdstat.normality.gaussianity_of_means` averages N samples at a time and tests whether the
# averages are Gaussian. Independent samples promise that the skewness falls as one over the root
# of N.

means = gaussianity_of_means(green, n_means=128)
with viz.style():
    figure = Figure(figsize=(6.7, 2.3), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, 3, sharey=True)):
        axes.plot(means.sizes, means.skewness[i], "o", color=viz.PALETTE[4], label="measured")
        axes.plot(means.sizes, means.predicted_skewness[i], color=viz.PALETTE[5], label="promised")
        axes.set_xscale("log", base=2)
        axes.set(title=names[i], xlabel="samples per average")
    figure.axes[0].set_ylabel("skewness of averages")
    figure.axes[-1].legend(loc="upper right")
figure

# %%
# The averages keep the promise, but it is a slow one: the skewness for 64 samples is an eighth of
# that for one, and the test still tells most averages from Gaussian.

for name, p_values in zip(names, means.p_value, strict=True):
    rejected = means.sizes[p_values < 0.05]
    print(f"{name:16} told from Gaussian at N = {', '.join(map(str, rejected))}")
