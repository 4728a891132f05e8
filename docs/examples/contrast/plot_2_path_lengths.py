"""
Shorter and longer paths
========================

What does each further bounce of light do to the distribution of a pixel?

This is the paper's study of path lengths in the hall.
"""

# %%
# The same view of the hall twice: with five bounces of indirect light and with two. Direct light
# takes two segments of a path, each bounce one more. The images went through a denoiser; the
# distributions below are of 4096 samples of the pixel in the middle of four regions.

# sphinx_gallery_panel = 1, 3
import numpy as np

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

SIZE = (128, 128)
depths = {"five bounces": 7, "two bounces": 4}
regions = find_recipe("gallery").regions[:4]
pixels = [region.center(*SIZE) for region in regions]
renders, images, x = {}, {}, {}
for name, depth in depths.items():
    options = {"size": SIZE, "seed": 1, "max_depth": depth, "backend": "scalar"}
    renders[name] = samples = chd.render("gallery", spp=12, **options)
    features = {kind: samples.features[kind] for kind in ("albedo", "normal")}
    images[name] = chd.io.denoise(samples.read().mean(axis=-1), **features)
    x[name] = chd.rendering.render_pixels("gallery", pixels, spp=4096, **options)
names = [region.name.replace("-", " ") for region in regions]
marks = [
    viz.Mark(name, *r.pixels(*SIZE), r.center(*SIZE))
    for name, r in zip(names, regions, strict=True)
]
viz.renders_contrasted(images, {name: [*those] for name, those in x.items()}, marks)

# %%
# Longer paths add light, so that the image is brighter and fewer samples are null. They add it at
# many scales.

nulls = {name: (those == 0).all(axis=1).mean(axis=-1) for name, those in x.items()}
for i, region in enumerate(names):
    for name in depths:
        bright = np.quantile(x[name][i, 1], 0.99)
        null = nulls[name][i]
        print(f"{region:12} {name:16} {null:4.0%} nulls, 99 % of samples below {bright:.2f}")

plain = {"size": (32, 32), "spp": 96, "backend": "scalar"}
short = chd.render("gallery", max_depth=4, seed=2, **plain)
loss = chd.contrast(chd.render("gallery", max_depth=7, seed=1, **plain), short).loss
lower = [100 * (nulls["two bounces"][i] - nulls["five bounces"][i]) for i in range(4)]
sentence = (
    f"Two bounces instead of five lose {loss.value:.0%} of the light "
    f"({loss.low:.0%} to {loss.high:.0%}) and make {min(lower):.0f} to {max(lower):.0f} more of a "
    f"hundred samples null in each of four places."
)
print(sentence)

# %%
# **Next:** `What path guiding does to distributions <plot_3_guiding.html>`_
