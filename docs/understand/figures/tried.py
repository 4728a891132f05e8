import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

with Path(__file__).with_name("tried.csv").open() as file:
    rows = list(csv.DictReader(file, skipinitialspace=True))
kinds = list(dict.fromkeys(row["kind"] for row in rows))
y = np.array([i + 0.8 * kinds.index(row["kind"]) for i, row in enumerate(rows)])
fig, axes = plt.subplots(1, 2, figsize=(6.7, 3.2), layout="constrained", sharey=True)
for ax, measure in zip(axes, ("MSE", "relMSE"), strict=True):
    value = [float(row[measure]) for row in rows]
    used = ["used" in row["what was tried"] for row in rows]
    ax.barh(y, value, 0.7, color=["#0072B2" if one else "#56B4E9" for one in used])
    for place, number in zip(y, value, strict=True):
        ax.annotate(f" {number:g}", (number, place), va="center", fontsize=7)
    ax.set_title(f"{measure} over that of the mean")
axes[0].set_yticks(y, [row["what was tried"].replace(" (used)", "") for row in rows])
axes[0].invert_yaxis()
fig
