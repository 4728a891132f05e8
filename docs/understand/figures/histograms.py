import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHDS

x = CHDS["long-tail"].draw(samples=512, seed=1)
linear, log = chd.histogram(x, scale="linear"), chd.histogram(x)
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.2), layout="constrained")
viz.chd_axes(linear, names=["samples"], ax=axes[0])
axes[0].set_title(f"linear: {int(linear.overflow)} of 512 samples lie beyond its end")
fits = {"fit to the samples": chd.fit.fit(x, "burr"), "fit to the counts": chd.fit.fit(log, "burr")}
viz.chd_axes(log, names=["samples"], ax=axes[1])
t = np.geomspace(*axes[1].get_xlim(), 300)
for (name, fit), style in zip(
    fits.items(), ({"color": "#0072B2"}, {"color": "#D55E00", "linestyle": "--"}), strict=True
):
    axes[1].plot(t, fit.pdf(t) * t * np.log(10), label=name, **style)
axes[1].set_title("log: ten bins a decade, five decades either side of 1")
axes[1].legend(loc="upper left")
for ax in axes:
    ax.set_xlabel("radiance")
fig
