import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHD, Component

body = Component("lognormal", 0.5, 0.05, 0.55), Component("gamma", 2.0, 1.0, 0.45)
known = CHD(body, tail_index=0.5, tail_share=0.06, null_share=0.4)
x = known.draw(samples=4096, seed=1)
fig, ax = plt.subplots(figsize=(6.7, 2.5), layout="constrained")
viz.chd_axes(chd.histogram(x), names=["samples"], fits=[chd.fit.mixture(x).pdf], ax=ax)
top = ax.get_ylim()[1]
ax.axvline(x.mean(), color="#0072B2", linestyle="--")
arrow = {"arrowstyle": "-", "color": "#D55E00"}
for text, tip, place in (
    (f"{np.mean(x == 0):.0%} null samples\nsummarize", (3e-3, 0.02), (3e-3, 0.6)),
    ("a mode: one kind of path\nmodality", (0.045, 0.6), (9e-3, 0.95)),
    ("a mixture, a family\nfit.mixture, fit.select", (0.18, 0.22), (0.14, 0.95)),
    ("the mean, and better values\nestimate", (x.mean(), 0.75), (6, 0.95)),
    ("the tail\nfit.tail_index", (12, 0.03), (25, 0.4)),
):
    ax.annotate(
        text,
        (tip[0], tip[1] * top),
        (place[0], place[1] * top),
        ha="center",
        va="center",
        arrowprops=arrow,
    )
ax.set(xlim=(1e-3, 1e2), ylim=(0, 1.12 * top), xlabel="radiance of one sample")
fig
