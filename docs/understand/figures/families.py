import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd

shapes = {
    "gamma": [{"shape": k, "scale": 1 / k} for k in (0.3, 1, 4)],
    "lognormal": [{"mu": 0, "sigma": s} for s in (1.6, 1, 0.4)],
    "weibull": [{"shape": k, "scale": 1} for k in (0.5, 1, 3)],
    "burr": [{"c": c, "d": d, "scale": 1} for c, d in ((1, 1.2), (2, 1), (4, 1))],
}
x = np.geomspace(1e-3, 1e3, 300)
fig, axes = plt.subplots(1, 4, figsize=(6.7, 1.9), layout="constrained", sharex=True)
for ax, (name, those) in zip(axes.flat, shapes.items(), strict=True):
    for parameters, color in zip(those, ("#D55E00", "#0072B2", "#009E73"), strict=True):
        density = chd.fit.FAMILIES[name].distribution(parameters).pdf(x) * x  # of log radiance
        ax.fill_between(x, density, color=color, alpha=0.12)
        label = ", ".join(
            f"{key} {value:g}" for key, value in parameters.items() if key not in ("scale", "mu")
        )
        ax.plot(x, density, color=color, label=label)
    ax.set(xscale="log", ylim=(0, None), yticks=[], title=chd.fit.FAMILIES[name].label)
    ax.legend(fontsize=6.5, handlelength=1, loc="upper left")
fig.supxlabel("radiance")
fig
