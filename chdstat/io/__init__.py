"""Exchange with other programs: EXR files, and the hand-over of estimates to a denoiser.

`write_exr` and `read_exr` keep images with their layers in EXR files; `denoise` gives an image
of estimates to Open Image Denoise.
"""

from __future__ import annotations

from chdstat.io.denoiser import denoise
from chdstat.io.exr import ExrImage, read_exr, write_exr

__all__ = ["ExrImage", "denoise", "read_exr", "write_exr"]


def __dir__() -> list[str]:
    return sorted(__all__)
