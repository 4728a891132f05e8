"""
Have two integrators the same mean?
===================================

A renderer was changed, and its image looks the same. Is it? `chdstat.contrast` tests pixels and
windows of all sizes, and says how large a loss it would have found.
"""

# %%
# A path tracer, the same with another seed, and one that leaves out long paths.

# sphinx_gallery_panel = 2
import chdstat as chd
from chdstat import viz

view = {"spp": 48, "size": (48, 48), "backend": "scalar"}
path = chd.render("cornell-box", seed=1, **view)
again = chd.render("cornell-box", seed=2, **view)
shorter = chd.render("cornell-box", seed=3, max_depth=4, **view)

print(chd.contrast(path, again).verdict)

# %%
# Of shorter paths, single pixels show little at 48 samples, and windows much.

found = chd.contrast(path, shorter)
viz.contrast(found)

# %%
# **Next:** the `how-to page <../how-to/compare-renders.html>`_ on equal seeds, converged images and
# the tests of a renderer.
