"""
Error against the number of samples
===================================

An estimator that helps with 8 samples may harm with 64. Up to how many samples does each one pay?
"""

# %%
# `chdstat.comparison.error_curve` repeats a comparison for batches of different sizes. The samples
# come from the hall of columns.

import chdstat as chd
from chdstat import viz
from chdstat.comparison import error_curve

samples = chd.render("gallery", spp=256, size=(48, 48), seed=1, backend="scalar")
names = ["mean", "trimmed_mean", "median_of_means", "gmon_adaptive", "zirr2018"]
curve = error_curve(samples, names, sizes=[4, 8, 16, 32], progress=False)
viz.error_curves(curve)

# %%
# Bands are 95 % intervals over blocks of pixels, and dashed lines are estimators that look at the
# pixels around. A trimmed mean of 8 samples trims nothing. The noise of a mean falls with more
# samples. A bias that does not fall as fast ends up as the larger error, so that what pays at few
# samples may harm at many. MSE over that of the mean:

ratio = curve.measures["mse_ratio"]
print("".ljust(16), *(f"N = {n}".ljust(22) for n in curve.sizes))
called = [chd.estimators.lookup(n).label or n.replace("_", " ") for n in curve.estimators]
for k in range(len(called)):
    cells = (str(ratio[i, k]).ljust(22) for i in range(len(curve.sizes)))
    print(called[k].ljust(16), *cells)

# %%
# What the intervals allow to say:


def sizes_where(is_so):
    """Return the numbers of samples where something holds, in words."""
    *first, last = [str(n) for n, so in zip(curve.sizes, is_so, strict=True) if so] or [""]
    return f"{', '.join(first)} and {last}" if first else last


parts = []
for i in range(1, len(called)):
    low, high = ratio.low[:, i], ratio.high[:, i]
    pays, harms = sizes_where(high < 1), sizes_where(low > 1)
    verdicts = [f"surely pays with {pays} samples"] * bool(pays) + [
        f"surely harms with {harms}"
    ] * bool(harms)
    parts.append(f"{called[i]} " + (" and ".join(verdicts) or "cannot be told from the mean"))
rises = [
    called[i]
    for i in range(1, len(called))
    if any(ratio.low[k, i] > ratio.high[:k, i].min() for k in range(1, len(curve.sizes)))
]
sentence = (
    f"In this hall, {'; '.join(parts)}. "
    + (
        f"The ratio of {' and of '.join(rises)} surely rises "
        if rises
        else "No ratio surely rises "
    )
    + f"with up to {curve.sizes[-1]}"
    + ("." if rises else ": where an estimator ceases to pay, these sizes do not tell.")
)
print(sentence)

# %%
# **Next:** `The paper's network <plot_4_network.html>`_ learns an estimator.
