import matplotlib.pyplot as plt
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.estimators.default_estimate.candidates import Measured
from chdstat.estimators.default_estimate.weighting_network import proposed
from chdstat.estimators.default_estimate.weights import weight_of_mean

# A texture of little noise, which grows from top to bottom; fireflies in a disc; red is noisy.
edge, spp, rare, glint = 64, 32, 0.02, 8.0
rng = np.random.default_rng(2)
y, x = np.mgrid[:edge, :edge]
disc = (np.hypot(y - 21, x - 43) < 14)[..., np.newaxis]
texture = rng.choice((0.8, 1.2), (edge, edge, 1)) * np.array((0.3, 0.4, 0.5))
relative = np.where(np.arange(3) == 0, 2.5, 0.06 * 50 ** (y / edge)[..., np.newaxis])
shape = relative[..., np.newaxis] ** -2
samples = rng.gamma(shape, texture[..., np.newaxis] / shape, (*texture.shape, spp))
fireflies = disc * (rng.random((edge, edge, spp)) < rare)
samples += glint * fireflies[:, :, np.newaxis] * rng.exponential(size=(edge, edge, 1, spp))
samples = samples.astype(np.float32)
truth = texture + glint * rare * disc

# The weight of the mean in each channel, as `chdstat.estimate` finds it.
measured = Measured.of(chd.Samples.from_array(samples))
*_, parts = proposed(measured, {}, level=0.9)
weight = next(weight_of_mean(*parts))
found = chd.estimate(samples)

fig = plt.figure(figsize=(6.7, 3.1), layout="constrained")
grid = fig.add_gridspec(2, 5, width_ratios=(1, 1, 1, 0.06, 1.6))
mean, mse = samples.mean(axis=-1), lambda image: np.square(image - truth).mean()
images = {"truth": truth, f"mean, MSE {mse(mean):.4f}": mean}
images[f"estimate, MSE {mse(found.radiance):.4f}"] = found.radiance
for k, (name, image) in enumerate(images.items()):
    viz.image_map(image, title=name, ax=fig.add_subplot(grid[0, k]))
for k, name in enumerate(("red", "green", "blue")):
    ax = fig.add_subplot(grid[1, k])
    shown = ax.imshow(weight[..., k], vmin=0, vmax=1)
    ax.set(title=f"weight, {name}", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
fig.colorbar(shown, cax=fig.add_subplot(grid[1, 3]), ticks=(0, 1)).outline.set_visible(False)

ax = fig.add_subplot(grid[:, 4])
noise, calm = parts[0].noise / parts[0].unit, ~disc[..., 0]
v = np.square((parts[0].image * measured.unit - truth) / truth)[calm, 1].mean()
s = np.geomspace(0.01, 2, 100)
points = {"marker": ".", "linestyle": "", "markersize": 1.8, "markeredgewidth": 0, "alpha": 0.8}
for name, color, k, part, at in (
    ("green", "#009E73", 1, calm, 0.94),
    ("green, in the disc", "#0072B2", 1, ~calm, 0.87),
    ("red", "#D55E00", 0, calm, 0.80),
):
    ax.plot(noise[part, k], weight[part, k], color=color, **points)
    ax.text(1.8, at, name, color=color, ha="right", va="center")
ax.plot(s, v / (v + s**2), color="#222222", linewidth=1.2)
ax.text(1.8, 0.73, "$v / (v + s^2)$", color="#222222", ha="right", va="center")
ax.set(xscale="log", xlim=(0.01, 2), ylim=(0, 1), xlabel="noise s, over the radiance around")
ax.set_title("weight of the mean")
fig
