import matplotlib.pyplot as plt
import numpy as np

rng = np.random.default_rng(4)
fig, axes = plt.subplots(1, 4, figsize=(6.7, 2.1), layout="constrained")
rise = np.linspace(0, 8, 200)  # -log of the share of samples beyond
for xi, color in (
    (-0.2, "#56B4E9"),
    (0, "#0072B2"),
    (0.25, "#009E73"),
    (0.5, "#E69F00"),
    (1, "#D55E00"),
):
    y = np.expm1(xi * rise) / xi if xi else rise
    axes[0].plot(y, np.exp(-rise), color=color, label=f"ξ = {xi:g}")
axes[0].set(
    xscale="log",
    yscale="log",
    xlim=(0.1, 1e3),
    ylim=(5e-4, 1),
    xlabel="radiance above the threshold",
)
axes[0].set(title="share of samples beyond")
axes[0].legend(handlelength=1, fontsize=7)

for ax, xi, color in zip(axes[1:], (0, 0.5, 1), ("#0072B2", "#E69F00", "#D55E00"), strict=True):
    rise = rng.standard_exponential((10, 4096))
    x = np.expm1(xi * rise) / xi if xi else rise
    n = np.arange(1, 4097)
    ax.plot(n, (x.cumsum(axis=1) / n).T, color=color, linewidth=0.6)
    ax.set(xscale="log", xlim=(16, 4096), ylim=(0, 6), title=f"means, ξ = {xi:g}", xlabel="samples")
fig
