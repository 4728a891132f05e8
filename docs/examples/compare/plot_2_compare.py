"""
Compare estimators side by side
===============================

Which estimator is best depends on the measure, on the scene, and on the pixel. How do several of
them do on the same samples?
"""

# %%
# `chdstat.compare` cuts the samples of every pixel of the hall into batches of 32. Each estimator
# estimates from each batch. All other samples of the pixel judge, and their noise is in no error.

import chdstat as chd
from chdstat import viz

samples = chd.render("gallery", spp=160, size=(64, 64), seed=1, backend="scalar")
names = ["mean", "trimmed_mean", "median_of_means", "gmon_adaptive", "zirr2018", "shared_shape"]
found = chd.compare(samples, names, n=32, labels="classify", progress=False)
viz.estimator_measures(found)

# %%
# Ratios are relative to the sample mean: below 1 is better. Bars show the share of estimates that
# came closer to the truth, stayed, or moved away; hatched is what the other samples cannot tell.
# Lines are 95 % intervals over blocks of pixels.


def told(x):
    """Return a number with its interval."""
    return f"{x.value:.2g} ({x.low:.2g} to {x.high:.2g})"


# The last column is the average over the channels.
error, bias = (found.measures[name][:, -1] for name in ("mse_ratio", "bias"))
better = [i for i, high in enumerate(error.high) if i and high < 1]
dark = [i for i, high in enumerate(bias.high) if i and high < 0]
best = min(better or [0], key=lambda i: error.value[i])
called = [chd.estimators.lookup(n).label or n.replace("_", " ") for n in found.estimators]
rivals = [i for i in better if i != best and error.low[i] <= error.high[best]]
overlap = " and of ".join(f"{called[i]} ({error.value[i]:.2g})" for i in rivals)
sentence = (
    f"Of {len(names) - 1} estimators, {len(better)} surely have a smaller squared error than the "
    f"mean and {len(dark)} surely lose light"
    + (
        f"; the smallest error, {told(error[best])} times that of the mean, is that of "
        f"{called[best]}"
        if best
        else ""
    )
    + (f", but it is not told from that of {overlap}: the intervals overlap." if rivals else ".")
)
print(sentence)

# %%
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
viz.side_by_side(shown | {"mean of all": found.reference})

# %%
# **Next:** `Error against the number of samples <plot_3_error_curves.html>`_
