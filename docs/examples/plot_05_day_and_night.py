"""
One room by day and by night
============================

What does light do to the distributions of a scene when geometry and materials stay the same?
"""

# %%
# The living room has three large windows by day, and two lamps with paper shades by night. The
# regions of both recipes are named after what they show.

import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import find_recipe

SIZE = (48, 48)
SHOWN = ("lamplit-wall", "carpet", "mirror")


def study(scene):
    regions = find_recipe(scene).regions
    marks = [viz.Mark(r.name, *r.pixels(*SIZE), r.center(*SIZE)) for r in regions]
    pixels = [mark.pixel for mark in marks]
    x = chd.rendering.render_pixels(scene, pixels, spp=1024, size=SIZE, seed=2)
    panels = [viz.Panel.of(mark.name, x[i]) for i, mark in enumerate(marks)]
    samples = chd.render(scene, spp=20, size=SIZE, seed=1, backend="scalar")
    notes = [region.phenomenon.replace("-", " ") for region in regions]
    return viz.region_study(samples.read().mean(axis=-1), marks, panels, notes=notes)


# %%
# By day
# ------

study("day-room")

# %%
# Few samples are null, because paths find the large windows easily. The distributions are broad
# and alike in many places: indirect light looks much the same wherever it arrives.
#
# By night
# --------

study("night-room")

# %%
# Direct light of the lamps is a narrow peak; all else spreads over several decades, and in most
# places more than half of the samples are null. The paper shades are virtual sources: a peak with a
# long faint tail.
#
# The same pixels
# ---------------
#
# The camera does not move, so that a pixel sees the same surface by day and by night.

regions = [r for r in find_recipe("night-room").regions if r.name in SHOWN]


def panel(scene, region):
    pixel = region.center(*SIZE)
    (x,) = chd.rendering.render_pixels(scene, [pixel], spp=1024, size=SIZE, seed=2)
    return viz.Panel.of(region.name, x)


scenes = {"by day": "day-room", "by night": "night-room"}
viz.chd_grid({name: [panel(scene, r) for r in regions] for name, scene in scenes.items()})

# %%
# On the wall the lamp leaves one narrow peak where daylight, of the windows and of the room, has
# two humps. On the carpet the red channel is more than ten times the others under either light:
# the cloth shifts the distributions, and the light makes their shape. In the mirror, nearly nine
# samples in ten are null by night.
#
# **Next:** `Fireflies in a hall of columns <plot_06_fireflies.html>`_ looks at samples that are
# rarer still.
