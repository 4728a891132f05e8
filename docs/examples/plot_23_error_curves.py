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

samples = chd.render("gallery", spp=512, size=(48, 48), seed=1, backend="scalar")
names = ["mean", "trimmed_mean", "median_of_means", "gmon_adaptive", "zirr2018"]
curve = error_curve(samples, names, sizes=[4, 8, 16, 32], progress=False)
viz.error_curves(curve)

# %%
# Bands are 95 % intervals over blocks of pixels, and dashed lines are estimators that look at the
# pixels around. A trimmed mean of 8 samples trims nothing. The curves of robust estimators flatten,
# because a bias does not fall as quickly as the noise. MSE over that of the mean:

ratio = curve.measures["mse_ratio"]
print("".ljust(16), *(f"N = {n}".ljust(22) for n in curve.sizes))
for k, name in enumerate(curve.estimators):
    cells = (str(ratio[i, k]).ljust(22) for i in range(len(curve.sizes)))
    print(name.ljust(16), *cells)

# %%
# **Next:** `How sure is an estimate? <plot_24_certainty.html>`_ shows an estimate that says how
# far it can be wrong.
