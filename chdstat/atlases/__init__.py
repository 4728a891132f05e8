"""Atlas: the shapes that recur over a scene, found without labels.

`chdstat.classify` asks each pixel for patterns that are known beforehand; `atlas` asks the image
which distributions it has. Pixels that differ only in brightness have the same shape.
"""

from chdstat.atlases.of_images import Atlas, atlas

__all__ = ["Atlas", "atlas"]
