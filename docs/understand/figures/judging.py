import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat.estimators import Estimator

# Exponential samples among 90 % nulls: a sample has the variance v, in squared means.
edge, nulls, n = 48, 0.9, 32
v = 2 / (1 - nulls) - 1
black = Estimator("black", lambda x: np.zeros(np.shape(x)[:-1]), "this page")
half = Estimator("half the mean", lambda x: np.asarray(x).mean(axis=-1) / 2, "this page")
rng = np.random.default_rng(0)
spp = [64, 128, 256, 512, 1024]
said, naive = [], []
for count in spp:
    x = rng.exponential(size=(edge, edge, 1, count)) * (rng.random((edge, edge, 1, count)) >= nulls)
    rows = chd.compare(x, [black, half], n=n, progress=False).table()
    said.append([[row[f"relmse_ratio{end}"] for end in ("", "_low", "_high")] for row in rows])
    # The usual way: against the mean of the other samples, which divides, too.
    errors = np.zeros(3)
    for first in range(0, min(count, 16 * n), n):
        batch = x[..., first : first + n].mean(axis=-1)
        others = np.delete(x, np.s_[first : first + n], axis=-1).mean(axis=-1)
        weight = 1 / (others**2 + 0.01 * x.mean() ** 2)
        errors += [(weight * (p - others) ** 2).mean() for p in (batch, 0 * batch, batch / 2)]
    naive.append(errors[1:] / errors[0])
fig, axes = plt.subplots(1, 2, figsize=(6.7, 2.4), layout="constrained", sharey=True)
for k, (ax, c) in enumerate(zip(axes, (0.0, 0.5), strict=True)):
    value, low, high = np.transpose([one[k] for one in said])
    ax.axhline(c**2 + (1 - c) ** 2 * n / v, color="#222222", linewidth=1, label="true")
    ax.axhline(1, color="#999999", linewidth=0.8, linestyle=":")
    ax.errorbar(spp, value, (value - low, high - value), fmt="o", color="#0072B2", label="compare")
    ax.plot(spp, [one[k] for one in naive], "x", color="#D55E00", label="against the other samples")
    ax.set(
        xscale="log", title=f"{('A black image', 'Half of the mean')[k]}, over the mean's relMSE"
    )
    ax.set_xticks(spp, [str(count) for count in spp])
    ax.minorticks_off()
    ax.set_xlabel("spp")
axes[1].legend()
fig
