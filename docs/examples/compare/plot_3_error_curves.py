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
# pixels around. A trimmed mean of 8 samples trims nothing. The curves of robust estimators flatten,
# because a bias does not fall as quickly as the noise. MSE over that of the mean:

ratio = curve.measures["mse_ratio"]
print("".ljust(16), *(f"N = {n}".ljust(22) for n in curve.sizes))
called = [chd.estimators.lookup(n).label or n.replace("_", " ") for n in curve.estimators]
for k in range(len(called)):
    cells = (str(ratio[i, k]).ljust(22) for i in range(len(curve.sizes)))
    print(called[k].ljust(16), *cells)

# %%
# What the intervals allow to say:

last = curve.sizes[-1]
pays = [i for i, high in enumerate(ratio.high[-1]) if high < 1]
open_ = [i for i in range(1, len(names)) if ratio.low[-1][i] <= 1 <= ratio.high[-1][i]]
listed = ", ".join(called[i] for i in pays) or "no estimator"
unclear = ", ".join(called[i] for i in open_)
sentence = (
    f"Of estimates from {last} samples of this hall, those of {listed} surely have a smaller "
    f"squared error than the mean"
    + (f"; for {unclear} the interval does not tell." if unclear else ".")
)
print(sentence)

# %%
# **Next:** `The paper's network <plot_4_network.html>`_ learns an estimator.
