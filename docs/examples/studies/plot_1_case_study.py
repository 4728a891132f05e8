"""
A case study of four scenes
===========================

Do the same kinds of distributions recur in different scenes, and in different places of one scene?

The paper studies four scenes: a bathroom, a living room by day and by night, and a symmetric hall.
chdstat has remakes of all four, which `The scenes <../../scenes/index.html>`_ shows larger.
"""

# %%
# A recipe names regions of a scene and the phenomenon that each shows. We draw 1024 samples of the
# pixel in the middle of six regions of the bathroom. The image of few samples, which only shows
# where they are, went through a denoiser.

# sphinx_gallery_panel = 1, 1

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

SIZE = (128, 128)
regions = [r for r in find_recipe("bathroom").regions if r.name not in ("vanity", "tub-tap")]
names = [region.name.replace("-", " ") for region in regions]
marks = [
    viz.Mark(name, *r.pixels(*SIZE), r.center(*SIZE))
    for name, r in zip(names, regions, strict=True)
]
pixels = [mark.pixel for mark in marks]


def picture(scene):
    samples = chd.render(scene, spp=12, size=SIZE, seed=1, backend="scalar")
    features = {name: samples.features[name] for name in ("albedo", "normal")}
    return chd.io.denoise(samples.read().mean(axis=-1), **features)


images = {"bathroom": picture("bathroom")}
x = chd.rendering.render_pixels("bathroom", pixels, spp=1024, size=SIZE, seed=2)
panels = [viz.Panel.of(name, x[i]) for i, name in enumerate(names)]
notes = [region.phenomenon.replace("-", " ") for region in regions]
look = {"channels": ["R", "G", "B"], "scales": ("linear", "log")}
viz.region_study(images["bathroom"], marks, panels, notes=notes, **look)

# %%
# Diffuse and glossy surfaces have one broad mode in the log domain and a long tail in the linear
# one. The mirror shows the distribution of the wall that it reflects. Under the vanity most samples
# are null and many are dark. At the edge of the shadow on the floor a narrow mode stands beside a
# broad one.

null = (x == 0).all(axis=1).mean(axis=-1)
green = x[:, 1]
spread = green.std(axis=-1) / green.mean(axis=-1)
sentence = (
    f"Six places of one bathroom, six distributions: from {null.min():.0%} null samples "
    f"({names[null.argmin()]}) to {null.max():.0%} ({names[null.argmax()]}), and from a standard "
    f"deviation of {spread.min():.1f} times the mean ({names[spread.argmin()]}) to "
    f"{spread.max():.1f} ({names[spread.argmax()]}) in 1024 samples."
)
print(sentence)

# %%
# The other scenes, each under an exposure of its own:

images |= {scene: picture(scene) for scene in ("day-room", "night-room", "gallery")}
figure = viz.map_grid(4, columns=4)
for ax, (scene, image) in zip(figure.axes, images.items(), strict=True):
    viz.image_map(image, title=scene.replace("-", " "), ax=ax)
figure

# %%
# **Next:** `One room by day and by night <plot_2_day_and_night.html>`_ studies the living room,
# `Fireflies in a hall of columns <plot_3_fireflies.html>`_ the hall.
