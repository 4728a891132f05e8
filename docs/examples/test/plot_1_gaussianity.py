"""
Are the samples Gaussian on some scale?
=======================================

The samples of a pixel are far from Gaussian. Are their logarithms? In how many pixels, and in
which direction do the others depart?
"""

# %%
# `chdstat.gaussianity` tests all pixels at once, on several scales, and corrects for their number:
# of the pixels that it rejects, few are false alarms. Null samples take no part.

# sphinx_gallery_panel = 1, 1
import chdstat as chd
from chdstat import viz

samples = chd.render("day-room", spp=96, size=(48, 48), seed=1, backend="scalar")
found = chd.gaussianity(samples, transform=("linear", "sqrt", "log"))
rejected = found["rejected"].mean(["y", "x", "channel"])
print(rejected.to_series().map("{:.0%}".format).to_string())

# %%
# The direction
# -------------
#
# Skewness says which side has the longer tail: it is 0 for a Gaussian.

skewness = found["skewness"].mean("channel")
figure = viz.map_grid(3)
for ax, scale in zip(figure.axes, ("linear", "sqrt", "log"), strict=True):
    title = f"Skewness, {scale} samples"
    viz.value_map(skewness.sel(transform=scale), title=title, limits=(-3, 3), ax=ax)
figure

# %%
# On the linear scale the bright tail is long everywhere but in the windows. The logarithm
# overshoots: now the dark tail is the longer one. The square root lies between.

middle = {scale: float(skewness.sel(transform=scale).median()) for scale in ("linear", "log")}
sentence = (
    f"The test rejects Gaussian samples in {float(rejected.sel(transform='linear')):.0%} of the "
    f"pixels of this room, and Gaussian logarithms in "
    f"{float(rejected.sel(transform='log')):.0%}: taking logarithms turns the median skewness from "
    f"{middle['linear']:+.1f} to {middle['log']:+.1f}."
)
print(sentence)

# %%
# **Next:** `How many samples until averages are Gaussian? <plot_2_averages.html>`_, and `How many
# samples does a test need? <plot_3_power.html>`_
