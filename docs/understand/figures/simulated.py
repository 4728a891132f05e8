import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHD, Component

lamp = CHD((Component("gamma", 2.0),), tail_index=0.5, tail_share=0.1, null_share=0.3)
x = lamp.draw(samples=512, seed=1)
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.2), layout="constrained")
viz.chd_axes(chd.histogram(x), names=["samples"], fits=[lamp.pdf], ax=axes[0])
axes[0].axvline(lamp.threshold, color="#D55E00", linestyle="--")
axes[0].annotate(
    " tail", (lamp.threshold, 0.9), xycoords=("data", "axes fraction"), color="#D55E00"
)
axes[0].set(
    title=f"a known distribution, {np.mean(x == 0):.0%} of its samples null", xlabel="radiance"
)

shares = np.linspace(0.3, 0.7, 17)
rng = np.random.default_rng(1)
for n, color in ((64, "#56B4E9"), (256, "#0072B2"), (1024, "#222222")):
    x = rng.gamma(2.0, size=(17, 100, n)) * (rng.random((17, 100, n)) >= shares[:, None, None])
    flagged = (np.mean(x == 0, axis=-1) > 0.5).mean(axis=1)
    axes[1].plot(shares, flagged, color=color, marker="o", markersize=2.5, label=f"{n} samples")
axes[1].axvspan(0.45, 0.55, color="#DDDDDD", zorder=0)
axes[1].set(
    title="more than half of the samples null",
    xlabel="true share of nulls",
    ylabel="share of pixels",
)
axes[1].legend()
fig
