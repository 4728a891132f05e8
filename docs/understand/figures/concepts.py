import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz

samples = chd.render("bathroom", spp=256, size=(64, 64), out="bathroom.zarr")
y, x = 8, 45
pixel = samples[y, x].mean(axis=0)  # (sample,)
fig = plt.figure(figsize=(6.7, 1.9), layout="constrained")
left, middle, right = fig.subplots(1, 3, width_ratios=[1, 1.5, 1.5])
viz.image_map(samples.read().mean(axis=-1), ax=left, title="a pixel")
left.plot(
    x, y, "s", markersize=7, markerfacecolor="none", markeredgecolor="#D55E00", markeredgewidth=1.6
)
middle.vlines(np.arange(64), 0, pixel[:64], color="#0072B2", linewidth=1)
middle.axhline(pixel.mean(), color="#D55E00", linestyle="--")
middle.set(title="64 of its samples, and the mean", xlabel="sample", ylabel="radiance")
viz.chd_axes(chd.histogram(pixel), names=["luminance"], ax=right)
right.axvline(pixel.mean(), color="#D55E00", linestyle="--")
right.set_title("its distribution", loc="left")
right.set_title(f"{np.mean(pixel == 0):.0%} null", loc="right", color="#666666")
right.set_xlabel("radiance of one sample")
fig
