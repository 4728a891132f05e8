import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHDS

x = {name: CHDS[name].draw(samples=512, seed=1) for name in ("gamma", "bimodal", "multimodal")}
x["above a floor"] = 0.1 + np.random.default_rng(1).exponential(size=512)
fig, axes = plt.subplots(1, 4, figsize=(6.7, 1.9), layout="constrained")
for ax, (name, pixel) in zip(axes, x.items(), strict=True):
    found = chd.modality(pixel)
    viz.chd_axes(chd.histogram(pixel), names=["samples"], ax=ax)
    for place in 10 ** found.places[: found.modes]:
        ax.axvline(place, color="#D55E00", linestyle="--", linewidth=1)
    ax.set(title=f"{name}: {found.modes}", xlabel="radiance")
fig
