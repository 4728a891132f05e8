import json

import matplotlib.pyplot as plt
import numpy as np

results = np.load("fireplace.npz")
about = json.loads(str(results["about"]))
edges = results["edges"]
kinds = [*about["places"]["iron front"]["kinds"]]
lights = {"windows": "#E69F00", "room": "#009E73", "lamp": "#CC79A7"}
fig, axes = plt.subplots(1, 3, figsize=(6.7, 2.4), sharex=True, layout="constrained")
for color, counts in zip(("#D55E00", "#009E73", "#0072B2"), results["iron front/rgb"], strict=True):
    axes[0].stairs(100 * counts, edges, fill=True, color=color, alpha=0.45)
for ax, place in zip(axes[1:], ("iron front", "side of the firebox"), strict=True):
    counts = dict(zip(kinds, 100 * results[f"{place}/kinds"], strict=True))
    ax.stairs(sum(counts.values()), edges, fill=True, color="#DDDDDD", label="all")
    for light, color in lights.items():
        ax.stairs(counts[f"{light}, direct"], edges, color=color, label=f"{light}, direct")
        ax.stairs(counts[f"{light}, one bounce"], edges, color=color, ls=":", lw=1)
axes[0].set(title="iron front, R, G and B", ylabel="% of the samples", xlim=(-5.5, 2))
axes[1].set_title("the same by light")
axes[2].set_title("side of the firebox")
axes[2].plot([], [], ":", color="#777777", lw=1, label="one bounce")
axes[2].set_ylim(0, 2.4)
axes[2].legend(fontsize=6)
fig.supxlabel("log10 of radiance", fontsize=8)
fig
