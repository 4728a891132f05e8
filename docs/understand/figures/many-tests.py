import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd

samples = chd.simulate(["lognormal", "gamma"], shape=(40, 40), spp=256, seed=1)
maps = chd.gaussianity(samples)  # are the log samples Gaussian? On the left they are
p, q = maps["p_value"].sel(channel="G"), maps["q_value"].sel(channel="G")
fig, axes = plt.subplots(1, 3, figsize=(6.7, 2.1), layout="constrained")
axes[0].hist(np.ravel(p), bins=20, range=(0, 1), color="#56B4E9")
axes[0].set(title="p-values of all pixels", xlabel="p", yscale="log")
axes[0].set_yticks([30, 100, 300, 1000], ["30", "100", "300", "1000"])
axes[0].minorticks_off()
for ax, name, value in zip(axes[1:], "pq", (p, q), strict=True):
    ax.imshow(np.squeeze(value) < 0.05, cmap="Blues", vmin=0, vmax=1.3)
    ax.set(title=f"{name} < 0.05", xticks=[], yticks=[])
fig
