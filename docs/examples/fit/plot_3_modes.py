"""
Modes across the edge of a shadow
=================================

At the edge of a shadow some paths see the sun and some do not. How does the distribution change
from pixel to pixel across that edge?
"""

# %%
# Six pixels of the bathroom's floor, from the shadow into the sunlight, with 4096 samples each.

# sphinx_gallery_panel = 1, 10
import chdstat as chd
from chdstat import viz

SIZE = (128, 128)
pixels = [(115, x) for x in range(40, 46)]
x = chd.rendering.render_pixels("bathroom", pixels, spp=4096, size=SIZE, seed=2)
viz.chd_grid([viz.Panel.of(f"column {pixel[1]}", x[i]) for i, pixel in enumerate(pixels)])

# %%
# The narrow mode on the right is the sun, at a place of its own in each channel because the
# floor is brown. It grows from pixel to pixel, while the broad mode of all other light stays
# where it is.
#
# The same in numbers
# -------------------
#
# `chdstat.modality` fits mixtures of log-normal components to the samples that are not null, and
# counts the modes that the samples support, with the mass of each.

found = chd.modality(x[:, 1])
for i, (_, column) in enumerate(pixels):
    masses = " and ".join(f"{mass:.0%}" for mass in found.weights[i] if mass > 0)
    print(f"column {column}: {found.modes[i]} mode(s) with {masses} of the samples")

# %%
# Where a pixel sees little of the sun, its samples are part of the bright tail.

two = found.modes >= 2
weights = [float(found.weights[i][found.weights[i] > 0][-1]) for i in range(len(pixels))]
if two.any():
    first = int(two.argmax())
    sentence = (
        f"From one pixel to the next, the sun becomes a mode of its own: {first} pixels in the "
        f"shadow have one mode, and from the next on a second holds {weights[first]:.0%} and, at "
        f"the last, {weights[-1]:.0%} of the samples that find light."
    )
else:
    sentence = "In none of these pixels do the samples support a second mode."
print(sentence)

# %%
# For an image, `chdstat.modality` returns a Dataset with the same for every pixel.
#
# **Next:** `Do surface features tell where the noise is? <../test/plot_4_features.html>`_
