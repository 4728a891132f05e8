"""
Fit a distribution, and ask whether averages are Gaussian
=========================================================

Which family describes the samples of a pixel, and how well? How heavy is the tail? And how many
samples must be averaged until the average behaves as error bars and denoisers assume, like a
Gaussian?
"""

# %%
# We draw 16384 samples of three pixels of the bathroom, and look at the green channel.

import numpy as np
from matplotlib.figure import Figure

import chdstat as chd
from chdstat import viz
from chdstat.inference import MORE_THAN_TESTED, gaussianity_of_means

names = ["wall", "vanity", "below the vanity"]
pixels = [(11, 67), (54, 43), (59, 37)]
x = chd.rendering.render_pixels("bathroom", pixels, spp=16384, size=(96, 96), seed=3)
null = (x == 0).all(axis=1)
green = x[:, 1]

# %%
# Which family?
# -------------
#
# Every fit is zero-inflated: a point mass at 0 for the nulls, and a family for the rest. The pixels
# are a batch, so one call fits all three. `chdstat.fit.select` compares the families by BIC; the
# margin is how much better the best one is, and above 10 the evidence is very strong. Held-out
# likelihood asks which family predicts best, and has a standard error.

found = chd.fit.select(green, null=null, held_out=True)
print(f"{'':16} {'by BIC':8} {'margin':>6}   {'held out':8} margin, nats per sample")
for i, name in enumerate(names):
    other = found.held_out
    predicts = found.families[other.best[i]]
    print(
        f"{name:16} {found.names[i]:8} {found.margin[i]:6.0f}   "
        f"{predicts:8} {other.margin[i]:.3f} +- {other.margin_se[i]:.3f}"
    )

# %%
# The best of four may still be poor, so look at it, with a mixture of log-normal components beside
# it. The densities are drawn over the log histogram: a density per unit of radiance becomes one per
# decade when multiplied by ``x log(10)``.

mixed = chd.fit.mixture(green, null=null)
with viz.style():
    figure = Figure(figsize=(6.7, 2.3), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, 3)):
        viz.chd_axes(chd.histogram(green[i], null=null[i]), channels=["G"], ax=axes)
        best = found.names[i]
        fits = {best: found.fits[best], f"{mixed.k[i]} log-normal": mixed}
        radiance = np.geomspace(1e-5, 1e2, 400)
        for (label, fit), color, dashes in zip(
            fits.items(), (viz.PALETTE[5], viz.PALETTE[4]), ("--", "-"), strict=True
        ):
            density = fit.pdf(radiance)[i] * radiance * np.log(10)
            axes.plot(radiance, density, color=color, linestyle=dashes, label=label)
        axes.set(title=names[i], xlabel="radiance (log scale)", xlim=(1e-5, 1e2))
        axes.legend(loc="upper left", fontsize=6.5)
figure

# %%
# How good is the fit?
# --------------------
#
# `chdstat.fit.goodness` draws from the fitted distribution, fits again, and says how often chance
# is as far from its own fit as the samples are from theirs. With so many samples no model passes:
# 0.01 is the least that 99 replicates can tell. So read the effect, Kolmogorov's distance: the
# largest error of the share of samples below any radiance. That of the mixtures is smaller.

test = ("kolmogorov-smirnov",)
of_mixtures = chd.fit.goodness(green, mixed, tests=test, null=null)
for i, (name, best) in enumerate(zip(names, found.names, strict=True)):
    single = chd.fit.goodness(green[i], str(best), tests=test, null=null[i])
    print(
        f"{name:16} {best:8} p {single.p_value[0]:.2f}, distance {single.effect[0]:.3f}"
        f"   mixture p {of_mixtures.p_value[i, 0]:.2f}, distance {of_mixtures.effect[i, 0]:.3f}"
    )

# %%
# How heavy is the tail?
# ----------------------
#
# Only the largest samples tell. The tail index is 0 for gamma-like tails, and from 1/2 on the
# variance would be infinite. Here no tail comes near.

tail = chd.fit.tail_index(green, null=null)
for name, xi, (low, high), n in zip(names, tail.xi, tail.interval, tail.n, strict=True):
    print(f"{name:16} xi {xi:5.2f}, 95 % interval {low:5.2f} to {high:.2f}, from {n} samples")

# %%
# What a histogram keeps
# ----------------------
#
# The same families can be fitted to the log histogram alone, whatever the number of samples. What
# is darker than its support, here 1e-5, cannot be told from a zero. A handful of paths on the wall
# and the vanity are that dark, down to 1e-20: a log-normal distribution, as sensitive at the dark
# end as at the bright one, is wider with them. The gamma fits hardly notice.

histogram = chd.histogram(green, null=null)
of_counts = chd.fit.select(histogram)
for i, name in enumerate(names):
    sigmas = (fits["lognormal"].parameters["sigma"][i] for fits in (found.fits, of_counts.fits))
    shapes = (fits["gamma"].parameters["shape"][i] for fits in (found.fits, of_counts.fits))
    print(
        f"{name:16} {histogram.underflow[i]:4} below the support; from samples and histogram: "
        "gamma shape {:.2f}, {:.2f}, log-normal sigma {:.2f}, {:.2f}".format(*shapes, *sigmas)
    )

# %%
# Averages of N samples
# ---------------------
#
# `chdstat.inference.gaussianity_of_means` averages N samples at a time and tests whether the
# averages are Gaussian. Independent samples promise that the skewness falls as one over the root
# of N.

means = gaussianity_of_means(green, n_means=128)
with viz.style():
    figure = Figure(figsize=(6.7, 2.3), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, 3, sharey=True)):
        axes.plot(means.sizes, means.predicted_skewness[i], color=viz.PALETTE[5], label="promised")
        measured = {"color": viz.PALETTE[4], "markersize": 4, "label": "measured"}
        axes.plot(means.sizes, means.skewness[i], "o", **measured)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log", base=2)
        axes.set_xticks(means.sizes, [str(n) for n in means.sizes])
        axes.set_yticks([0.5, 1, 2, 4, 8], ["1/2", "1", "2", "4", "8"])
        axes.minorticks_off()
        axes.set(title=names[i], xlabel="samples per average")
    figure.axes[0].set_ylabel("skewness of averages")
    figure.axes[-1].legend(loc="upper right")
figure

# %%
# The averages keep the promise, as far as few averages of many samples can show it, but it is a
# slow one: the skewness for 64 samples is an eighth of that for one. How many samples does an
# average need until 128 such averages are no longer rejected as Gaussian? What is predicted
# follows from the skewness and kurtosis of single samples, where these are identified.

for name, needed, predicted in zip(names, means.n_needed, means.n_predicted, strict=True):
    told = f"more than {means.sizes[-1]}" if needed == MORE_THAN_TESTED else str(needed)
    expected = f"predicts {predicted:.0f}" if predicted > 0 else "cannot tell"
    print(f"{name:16} needs {told}; the central limit theorem {expected}")
