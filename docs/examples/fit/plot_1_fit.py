"""
Fit families of distributions to a pixel
========================================

Which family describes the samples of a pixel best, how well does it do so, and is a mixture better?
"""

# %%
# We draw 8192 samples of three pixels of the bathroom, and look at the green channel.

import numpy as np

import chdstat as chd
from chdstat import viz

names = ["wall", "vanity", "below the vanity"]
pixels = [(8, 44), (36, 29), (39, 25)]
x = chd.rendering.render_pixels("bathroom", pixels, spp=8192, size=(64, 64), seed=3)
null, green = (x == 0).all(axis=1), x[:, 1]

# %%
# Choose a family
# ---------------
#
# Every fit has a point mass at 0 for the null samples and a family for the others. The three pixels
# are a batch, so that one call fits them all. `chdstat.fit.select` compares the families by BIC;
# the margin says how much better the first is than the second.

found = chd.fit.select(green, null=null)
for name, family, margin in zip(names, found.names, found.margin, strict=True):
    print(f"{name:18} {family:12} margin {margin:6.0f}")

# %%
# Look at the fits
# ----------------
#
# The best of a few families may still be poor. Here are two of them on the pixel of the vanity, and
# a mixture of log-normal components.

mixture = chd.fit.mixture(green[1], null=null[1])
fitted = {name: chd.fit.fit(green[1], name, null=null[1]).pdf for name in ("gamma", "lognormal")}
fitted[f"{mixture.k} log-normal components"] = mixture.pdf
linear, log = (chd.histogram(green[1], scale=s, null=null[1]) for s in ("linear", "log"))
viz.fits(linear, log, fitted, title="vanity, green channel")

# %%
# How far is each from the samples? Kolmogorov's distance is the largest error of the share of
# samples below any radiance.

bright = np.sort(green[1][~null[1]])
steps = np.arange(bright.size + 1) / bright.size
share = null[1].mean()  # of nulls, which the distribution functions count


def distance(cdf):
    below = (cdf(bright) - share) / (1 - share)
    return max(np.max(steps[1:] - below), np.max(below - steps[:-1]))


two = {name: chd.fit.fit(green[1], name, null=null[1]).cdf for name in ("gamma", "lognormal")}
one, best = min((distance(cdf), name) for name, cdf in two.items())
several = distance(mixture.cdf)
called = {"gamma": "gamma", "lognormal": "log-normal"}[best]
noise = 1.36 / np.sqrt(bright.size)  # what 95 of 100 samples of the true distribution stay below
sentence = (
    f"On the vanity a mixture of {mixture.k} log-normal components errs by at most {several:.1%} "
    f"in any share of the samples, the better of gamma and log-normal, {called}, by {one:.1%}; "
    f"the samples themselves are known to {noise:.1%}."
)
print(sentence)

# %%
# How good is a fit?
# ------------------
#
# `chdstat.fit.goodness` draws from the fitted distribution, fits again, and counts how often the
# result is as far from its own fit as the samples are from theirs. With thousands of samples it
# finds small errors, too, so read the effect as well, which is Kolmogorov's distance again. Here is
# the best single family of each pixel; no p-value of 99 replicates is below 1/100.

test, passed = ("kolmogorov-smirnov",), []
for i, (name, family) in enumerate(zip(names, found.names, strict=True)):
    fit = chd.fit.goodness(green[i], str(family), tests=test, resamples=99, null=null[i])
    print(f"{name:18} {family:12} p {fit.p_value[0]:.2f}, distance {fit.effect[0]:.3f}")
    if fit.p_value[0] > 0.05:
        passed.append(name)
print(f"At the 5 % level, a single family passes for {len(passed)} of {len(names)} pixels.")

# %%
# From a histogram alone
# ----------------------
#
# The same families can be fitted to the counts of a histogram, without the samples. What is darker
# than its support has no place in it: a log-normal fit, as sensitive at its dark end as at its
# bright one, becomes narrower. A gamma fit changes less.

of_counts = chd.fit.select(chd.histogram(green, null=null))
for family, parameter in (("lognormal", "sigma"), ("gamma", "shape")):
    both = [fits[family].parameters[parameter].round(2) for fits in (found.fits, of_counts.fits)]
    print(f"{family} {parameter}: from samples {both[0]}, from counts {both[1]}")

# %%
# **Next:** `How heavy are the tails? <plot_2_tails.html>`_ looks at the largest samples alone.
