import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

import chdstat as chd

samples = chd.simulate(["gamma", "lognormal"], shape=(16, 16), spp=512, seed=1)
pixel, others = (
    samples[0, 0][1],
    {"a neighbour": samples[0, 1][1], "another kind": samples[0, 15][1]},
)
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.2), layout="constrained")
rank = np.arange(1, 513) / 512
axes[0].plot(np.sort(pixel), rank, color="black", label="a pixel")
both, rng = np.concatenate([pixel, others["a neighbour"]]), np.random.default_rng(1)
divided = [stats.ks_2samp(*np.split(rng.permutation(both), 2)).statistic for _ in range(300)]
axes[1].hist(divided, bins=20, color="#DDDDDD")
for (name, other), color in zip(others.items(), ("#0072B2", "#D55E00"), strict=True):
    found = chd.difference(pixel, other)
    axes[0].plot(
        np.sort(other), rank, color=color, label=f"{name}: distance {found.distance.max():.2f}"
    )
    axes[1].axvline(found.distance.max(), color=color, label=f"{name}: p = {found.p_value:.3f}")
axes[0].set(xscale="log", xlim=(0.05, 10), xlabel="radiance", title="share of samples below")
axes[1].set(yticks=[], xlabel="largest distance", title="300 random divisions of the samples")
for ax in axes:
    ax.legend(fontsize=7)
fig
