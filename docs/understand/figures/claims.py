import matplotlib.pyplot as plt

fig, ax = plt.subplots(figsize=(6.7, 1.5), layout="constrained")
ax.axvspan(0.5, 0.92, color="#56B4E9", alpha=0.2)
ax.annotate(
    "range of the claim",
    (0.71, 2.55),
    ha="center",
    va="bottom",
    color="#0072B2",
    annotation_clip=False,
)
intervals = {
    "supported": (0.56, 0.61, 0.66, "#009E73"),
    "cannot tell": (0.42, 0.49, 0.56, "#777777"),
    "not supported": (0.2, 0.26, 0.32, "#D55E00"),
}
for y, (low, value, high, color) in enumerate(intervals.values()):
    ax.plot([low, high], [y, y], color=color)
    ax.plot(value, y, "o", color=color)
ax.set(
    yticks=range(3),
    yticklabels=intervals,
    xlim=(0, 1),
    ylim=(2.5, -0.5),
    xlabel="share of null samples",
)
ax.set_ylim(-0.5, 2.5)
fig
