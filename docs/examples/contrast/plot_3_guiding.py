"""
What path guiding does to distributions
=======================================

A guided path tracer draws directions where earlier paths have found light. What does that do to the
distributions of its samples, and does it pay?
"""

# %%
# A room by night, whose two lamps have paper shades: light leaves them by chance only. Guiding
# needs the LLVM or CUDA backend; without, both columns are path tracing.

import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.rendering.backend import resolve
from chdstat.rendering.recipes import find_recipe

SIZE = (64, 64)
guided = None if resolve().name == "scalar" else "guided"
integrators = {"path tracing": None, "path guiding": guided}
regions = [r for r in find_recipe("night-room").regions if r.name in ("lamplit-wall", "carpet")]
names = [region.name.rpartition("-")[2] for region in regions]
pixels = [r.center(*SIZE) for r in regions]
drawn = {
    name: chd.rendering.render_pixels(
        "night-room", pixels, spp=8192, size=SIZE, seed=2, integrator=integrator, backend="auto"
    )
    for name, integrator in integrators.items()
}
panels = {
    name: [viz.Panel.of(region, x[i]) for i, region in enumerate(names)]
    for name, x in drawn.items()
}
viz.chd_grid(panels)

# %%
# The numbers of a single pixel say little, because one sample of many times the mean, of light that
# no guide expects, decides its error:

for name, x in drawn.items():
    for region, light in zip(names, x.mean(axis=1, dtype=np.float64), strict=True):
        error, mean = light.std(ddof=1) / len(light) ** 0.5, light.mean()
        null, most = np.mean(light == 0), light.max() / mean
        print(f"{name}, {region:12}: {mean:.4f} ± {error:.4f}, {null:.0%} null, x{most:.0f}")

# %%
# Over the image
# --------------
#
# The whole image tells more: the noise of a sample relative to the mean, of guiding over path
# tracing, with an interval over blocks of eight by eight pixels.

images = [
    chd.summarize(chd.render("night-room", spp=96, size=SIZE, seed=4, integrator=integrator))
    for integrator in integrators.values()
]
level = sum(image["mean"].mean("channel") for image in images) / 2
noise = [
    (image["variance"].mean("channel") / (level**2 + 1e-4)).values.reshape(8, 8, 8, 8)
    for image in images
]
before, after = (x.mean(axis=(1, 3)).ravel() for x in noise)
ratio = after.sum() / before.sum()
picks = np.random.default_rng(1).integers(before.size, size=(2000, before.size))
low, high = np.quantile(after[picks].sum(axis=1) / before[picks].sum(axis=1), (0.025, 0.975))
verdict = (
    "less" if high < 1 else "more" if low > 1 else "neither surely less nor surely more"
)  # fmt: skip
nulls = [float(image["null_share"].mean()) for image in images]
sentence = (
    f"At equal samples, path guiding makes this image {verdict} noisy than path tracing: "
    f"{ratio:.2f} times its relative variance ({low:.2f} to {high:.2f}). Null samples go from "
    f"{nulls[0]:.0%} to {nulls[1]:.0%}."
    if guided
    else "Path guiding needs the LLVM or CUDA backend, which this machine does not have."
)
print(sentence)

# %%
# Guiding costs time for each sample, and a second before the first one. ``integrator="auto"``
# guides only where there are samples enough, and its own paths tell that this pays. The claims
# of ``chdstat study --integrators`` put numbers on what is seen here, for any scene.
#
# **Next:** `Which of several renders is noisier? <plot_4_several_renders.html>`_, and the how-to
# pages on `contrasting renders <../../how-to/contrast-renders.html>`_ and on
# `adaptive counts <../../how-to/adaptive.html>`_.
