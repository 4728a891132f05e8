"""
One room by day and by night
============================

What does light do to the distributions of a scene when geometry and materials stay the same?
"""

# %%
# The living room has three large windows by day, and two lamps with paper shades by night. The
# camera does not move, so that a pixel sees the same surface by day and by night.

# sphinx_gallery_panel = 1, 4

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

SIZE = (128, 128)
SCENES = {"by day": "day-room", "by night": "night-room"}
SHOWN = ("lamplit-wall", "carpet", "mirror")
regions = {time: find_recipe(scene).regions for time, scene in SCENES.items()}
same = [r for r in regions["by night"] if r.name in SHOWN]


def draw(scene, regions):
    """Return the samples of the pixels in the middle of regions."""
    pixels = [r.center(*SIZE) for r in regions]
    return chd.rendering.render_pixels(scene, pixels, spp=1024, size=SIZE, seed=2)


shown = {
    "by day": [*same, *(r for r in regions["by day"] if "pane" not in r.name)][:9],
    "by night": [*same, *(r for r in regions["by night"] if r not in same)][:9],
}
x = {time: draw(scene, shown[time]) for time, scene in SCENES.items()}
viz.chd_grid(
    {
        time: [viz.Panel.of(r.name.replace("-", " "), x[time][i]) for i, r in enumerate(same)]
        for time in SCENES
    }
)

# %%
# On the wall the lamp leaves one narrow peak where daylight, of the windows and of the room, has
# two humps. On the carpet the red channel lies far above the others under either light: the cloth
# shifts the distributions, and the light makes their shape.

nulls = {time: (x[time][:3] == 0).all(axis=1).mean(axis=-1) for time in SCENES}
red = {time: x[time][1].mean(axis=-1) for time in SCENES}
day, night = (nulls[time] for time in SCENES)
sentence = (
    f"The same surfaces, other light: from day to night, null samples go from {day[0]:.0%} to "
    f"{night[0]:.0%} on the wall, from {day[1]:.0%} to {night[1]:.0%} on the carpet and from "
    f"{day[2]:.0%} to {night[2]:.0%} in the mirror."
)
print(sentence)
for time, (r, g, _) in red.items():
    print(f"carpet {time}: red is {r / g:.0f} times green")

# %%
# The room, place by place
# ------------------------
#
# The images went through a denoiser; they only show where the places are.


def study(time):
    scene, places = SCENES[time], shown[time][len(same) :]
    samples = chd.render(scene, spp=12, size=SIZE, seed=1, backend="scalar")
    features = {name: samples.features[name] for name in ("albedo", "normal")}
    image = chd.io.denoise(samples.read().mean(axis=-1), **features)
    names = [r.name.replace("-", " ") for r in places]
    marks = [
        viz.Mark(name, *r.pixels(*SIZE), r.center(*SIZE))
        for name, r in zip(names, places, strict=True)
    ]
    panels = [viz.Panel.of(name, x[time][len(same) + i]) for i, name in enumerate(names)]
    notes = [r.phenomenon.replace("-", " ") for r in places]
    return viz.region_study(image, marks, panels, notes=notes)


study("by day")

# %%
# By day paths find the large windows easily. The distributions are broad and alike in many places:
# indirect light looks much the same wherever it arrives.

study("by night")

# %%
# By night, direct light of the lamps is a narrow peak; all else spreads over several decades. The
# paper shades are virtual sources: a peak with a long faint tail.
#
# **Next:** `Fireflies in a hall of columns <plot_3_fireflies.html>`_ looks at samples that are
# rarer still.
