"""
Are two renders the same?
=========================

Two renders of one view differ by noise. How can one see whether there is more than noise, such as
another path length, in every pixel?
"""

# %%
# Three renders of the Cornell box: two with another seed, and one with paths of at most four
# segments.

# sphinx_gallery_panel = 1, 2
import chdstat as chd
from chdstat import viz

view = {"spp": 48, "size": (48, 48), "backend": "scalar"}
samples = chd.render("cornell-box", seed=1, **view)
again = chd.render("cornell-box", seed=2, **view)
shorter = chd.render("cornell-box", seed=3, max_depth=4, **view)

# %%
# `chdstat.difference` measures the distance of the distributions in each pixel and shuffles the
# samples to see how large it is by chance.

same, other = (chd.difference(samples, b, replicates=59) for b in (again, shorter))
for name, found in (("another seed", same), ("shorter paths", other)):
    print(f"{name:14} {(found.p_value <= 0.05).mean():4.0%} of the pixels have p <= 0.05")

# %%
# The negative control holds its level: another seed gives about 5 % of small p-values. Shorter
# paths give more of them, most of all where light arrives after many bounces. More samples would
# show the difference in more pixels.

figure = viz.map_grid(3)
left, middle, right = figure.axes
viz.value_map(same.distance.max(axis=-1), title="Another seed", limits=(0.1, 0.5), ax=left)
viz.value_map(other.distance.max(axis=-1), title="Shorter paths", limits=(0.1, 0.5), ax=middle)
viz.value_map(other.p_value, title="p-value, shorter paths", limits=(0, 1), ax=right)
figure

# %%
# **Next:** `Robust estimators in place of the mean <plot_19_estimators.html>`_ turns from
# describing samples to estimating from them.
