"""Exchange with other programs: the hand-over of estimates to a denoiser.

`denoise` gives a picture of estimates to Open Image Denoise.
"""

from __future__ import annotations

from chdstat.io.denoiser import denoise

__all__ = ["denoise"]
