import json

import matplotlib.pyplot as plt
import numpy as np

results = np.load("renderers.npz")
about = json.loads(str(results["about"]))
names = {"mitsuba": "Mitsuba", "cycles": "Cycles", "luxcore": "LuxCore"}
colors = dict(zip(names, ("#0072B2", "#D55E00", "#009E73"), strict=True))
pixels = {"cornell-box": "wall", "room": "back wall"}
places = {"cornell-box": (16, 16), "room": (14, 13)}
fig, axes = plt.subplots(
    2, 4, figsize=(6.7, 3.5), layout="constrained", width_ratios=(1, 1, 1, 1.6)
)
for row, (scene, pixel) in zip(axes, pixels.items(), strict=True):
    for ax, name in zip(row, names, strict=False):
        mean = results[f"{scene}/{name}/mean"].astype(float)
        ax.imshow(np.clip(mean / (mean + 0.25), 0, 1) ** (1 / 2.2), interpolation="nearest")
        ax.plot(*places[scene][::-1], "s", mfc="none", mec="white", ms=6)
        ax.set(xticks=[], yticks=[], title=names[name] if ax in axes[0] else "")
        x = np.sort(results[f"{scene}/{name}/{pixel}"].astype(float))
        rank = np.arange(1, len(x) + 1) / len(x)
        row[3].step(x, rank, color=colors[name], label=names[name], lw=1, where="post")
    row[0].set_ylabel({"cornell-box": "Cornell box", "room": "room"}[scene])
    row[3].set(xscale="log", ylim=(0, 1.02), title="share of samples below" * (ax in axes[0]))
axes[1, 3].set_xlabel("luminance of a sample")
axes[0, 3].legend(fontsize=7)
fig
