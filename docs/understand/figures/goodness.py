import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat.patterns import CHDS

fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.2), layout="constrained", sharey=True)
for ax, name in zip(axes, ("gamma", "long-tail"), strict=True):
    x = np.sort(CHDS[name].draw(samples=256, seed=3))
    fitted = chd.fit.gamma(x)
    good = chd.fit.goodness(x, "gamma", tests=["kolmogorov-smirnov"])
    rank = np.arange(1, x.size + 1) / x.size
    u = fitted.cdf(x)
    worst = np.argmax(np.abs(rank - u))
    ax.step(x, rank, where="post", color="#E69F00", label="samples")
    ax.plot(x, u, color="#0072B2", label="gamma fit")
    ax.plot([x[worst]] * 2, [u[worst], rank[worst]], color="#D55E00", linewidth=3, label="D")
    ax.set(xscale="log", xlabel="radiance", xlim=(0.05, 30))
    ax.set_title(
        f"{name} samples: D = {np.squeeze(good.effect):.3f}, p = {np.squeeze(good.p_value):.2f}"
    )
axes[0].set_ylabel("share of samples below")
axes[0].legend()
fig
