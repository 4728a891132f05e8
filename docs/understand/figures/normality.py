import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

from chdstat.patterns import CHDS

fig, axes = plt.subplots(2, 4, figsize=(6.7, 2.7), layout="constrained")
for row, name in zip(axes.tolist(), ("gamma", "long-tail"), strict=True):
    x = CHDS[name].draw((2000,), samples=64, seed=1)
    for ax, n in zip(row, (1, 4, 16, 64), strict=True):
        z = stats.zscore(x[:, :n].mean(axis=1))
        ax.hist(z, bins=np.linspace(-4, 4, 41), density=True, color="#56B4E9")
        t = np.linspace(-4, 4, 200)
        ax.plot(t, stats.norm.pdf(t), color="black", linewidth=1)
        ax.set(yticks=[], xlim=(-4, 4))
        ax.set_title(f"N = {n}" if name == "gamma" else "")
    row[0].set_ylabel(name)
fig.supxlabel("average of N samples, standardised; the line is Gaussian")
fig
