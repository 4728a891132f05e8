import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd

truth = chd.certified()
bars = truth.coverage.sel(channel="luminance", size=128)
fig, axes = plt.subplots(2, 4, figsize=(6.7, 3.9), layout="constrained")
for ax, name in zip(axes.flat, np.unique(truth.scene), strict=True):
    image = chd.render(name, size=(64, 64), spp=16, backend="scalar", progress=False)
    radiance = image.read().mean(axis=-1)
    shown = (radiance / (radiance + radiance.mean())) ** (1 / 2.2)
    ax.imshow(shown, interpolation="nearest")
    here = bars.where(bars.scene == name, drop=True)
    dots = ax.scatter(
        *(here.x, here.y, 14), c=here, cmap="plasma", vmin=0.6, vmax=0.95, edgecolors="w", lw=0.5
    )
    ax.set(xticks=[], yticks=[], title=name)
fig.colorbar(dots, ax=axes, label="coverage of 95 % error bars, n = 128", extend="min", shrink=0.9)
fig
