import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.patterns import CHDS

fig, axes = plt.subplots(1, 3, figsize=(6.7, 2), layout="constrained")
for ax, name in zip(axes, ("lognormal", "bimodal", "multimodal"), strict=True):
    x = CHDS[name].draw(samples=512, seed=1)
    mixed = chd.fit.mixture(x)  # 1, 2 or 3 components, chosen by BIC
    viz.chd_axes(chd.histogram(x), names=["samples"], fits=[mixed.pdf], ax=ax)
    ax.lines[-1].set_color("black")
    t = np.geomspace(*ax.get_xlim(), 400)
    for j, color in zip(range(mixed.k), ("#0072B2", "#D55E00", "#009E73"), strict=False):
        parameters = {key: values[j] for key, values in mixed.parameters.items()}
        part = chd.fit.FAMILIES[str(mixed.family)].distribution(parameters).pdf(t)
        ax.plot(t, mixed.weights[j] * part * t * np.log(10), color=color, linestyle="--")
    ax.set(title=f"components: {mixed.k}", xlabel="radiance")
fig
