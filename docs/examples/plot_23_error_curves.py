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

samples = chd.render("gallery", spp=192, size=(48, 48), seed=1, backend="scalar")
names = ["mean", "trimmed_mean", "median_of_means", "gmon_adaptive", "zirr2018"]
curve = error_curve(samples, names, sizes=[4, 8, 16, 32], progress=False)
viz.error_curves(curve)

# %%
# Bands are 95 % intervals over blocks of pixels, and dashed lines are estimators that look at the
# pixels around. The dotted line is about the noise of the reference: errors near it cannot be
# distinguished. A trimmed mean of 8 samples trims nothing. Robust estimators gain most in relMSE
# and with few samples; then their curves flatten, because a bias does not fall as quickly as the
# noise.

ratio = curve.measures["mse_ratio"].value
print("MSE over that of the mean".ljust(26), *(f"N={n:<4}" for n in curve.sizes))
for k, name in enumerate(curve.estimators):
    print(name.ljust(26), *(f"{value:<6.2f}" for value in ratio[:, k]))

# %%
# **Next:** `How sure is an estimate? <plot_24_certainty.html>`_ shows an estimate that says how
# far it can be wrong.
