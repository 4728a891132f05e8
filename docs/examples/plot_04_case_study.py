"""
A case study of four scenes
===========================

Do the same kinds of distributions recur in different scenes, and in different places of one scene?

The paper studies four scenes: a bathroom, a living room by day and by night, and a symmetric hall.
chdstat has remakes of all four.
"""

# %%
# The scenes, each under an exposure of its own:

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

SIZE = (48, 48)
images = {
    scene: chd.render(scene, spp=20, size=SIZE, seed=1, backend="scalar").read().mean(axis=-1)
    for scene in ("bathroom", "day-room", "night-room", "gallery")
}
figure = viz.map_grid(4, columns=4)
for ax, (scene, image) in zip(figure.axes, images.items(), strict=True):
    viz.image_map(image, title=scene, ax=ax)
figure

# %%
# The bathroom, region by region
# ------------------------------
#
# A recipe names regions of a scene and the phenomenon that each shows. We draw 1024 samples of the
# pixel in the middle of each region.

regions = find_recipe("bathroom").regions
marks = [viz.Mark(r.name, *r.pixels(*SIZE), r.center(*SIZE)) for r in regions]
pixels = [mark.pixel for mark in marks]
x = chd.rendering.render_pixels("bathroom", pixels, spp=1024, size=SIZE, seed=2)
panels = [viz.Panel.of(mark.name, x[i]) for i, mark in enumerate(marks)]
notes = [region.phenomenon.replace("-", " ") for region in regions]
look = {"channels": ["R", "G", "B"], "scales": ("linear", "log")}
viz.region_study(images["bathroom"], marks, panels, notes=notes, **look)

# %%
# Diffuse and glossy surfaces have one broad mode in the log domain and a long tail in the linear
# one; on the brown wood of the vanity the channels are shifted apart. The mirror shows the
# distribution of the wall that it reflects. Under the vanity most samples are null and many are
# dark. At the edge of the shadow on the floor a narrow mode stands beside a broad one.
#
# **Next:** `One room by day and by night <plot_05_day_and_night.html>`_ studies the living room,
# `Fireflies in a hall of columns <plot_06_fireflies.html>`_ the hall.
