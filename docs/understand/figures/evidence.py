import csv
from pathlib import Path

import matplotlib.pyplot as plt

with Path(__file__).with_name("estimates.csv").open() as file:
    rows = list(csv.DictReader(file, skipinitialspace=True))
scenes = list(dict.fromkeys(row["scene"] for row in rows))
looks = {"16": ("o", "#56B4E9"), "64": ("s", "#0072B2"), "256": ("^", "#222222")}
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.9), layout="constrained", sharey=True)
for ax, measure in zip(axes, ("MSE", "relMSE"), strict=True):
    for row in rows:
        value, low, high = (
            float(part.strip(" ],"))
            for part in row[measure].replace("[", ",").split(",")
            if part.strip()
        )
        marker, color = looks[row["spp"]]
        y = scenes.index(row["scene"]) + 0.22 * (list(looks).index(row["spp"]) - 1)
        ax.plot([max(low, 0.08), high], [y, y], color=color, linewidth=0.8)
        ax.plot(max(value, 0.08), y, marker, color=color, markersize=3.5)
    ax.axvline(1, color="#888888", linewidth=0.8, linestyle=":")
    ax.set(xscale="log", xlim=(0.08, 2.5), title=f"{measure} over that of Open Image Denoise")
    ax.set_xticks([0.1, 0.2, 0.5, 1, 2], ["0.1", "0.2", "0.5", "1", "2"])
    ax.minorticks_off()
axes[0].set_yticks(range(len(scenes)), scenes)
axes[0].invert_yaxis()
for spp, (marker, color) in looks.items():
    axes[1].plot([], [], marker, color=color, label=f"{spp} spp")
axes[1].legend(loc="lower left")
fig
