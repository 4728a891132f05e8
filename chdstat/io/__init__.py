"""Exchange with other programs: their samples, EXR files, maps, and a denoiser for estimates.

- `read` opens samples in files of other programs. `get_include` returns the folder of the C++
  header with which a renderer writes such files.
- `write_exr` and `read_exr` keep images with their layers in EXR files. `write_image` writes an
  image in the format of the file's suffix. `write_maps` and `write_netcdf` write results per pixel.
  `write_reference` writes what tests of a renderer compare with.
- `write_estimates` estimates the radiance of an image and writes it to a file. `denoise` denoises
  an image of estimates with Open Image Denoise.
"""

from __future__ import annotations

from chdstat._core.denoiser import denoise
from chdstat.io.exr import ExrImage, read_exr, write_exr
from chdstat.io.reading import read
from chdstat.io.reference_files import write_reference
from chdstat.io.stream import get_include
from chdstat.io.writing import write_estimates, write_image, write_maps, write_netcdf

__all__ = [
    "ExrImage",
    "denoise",
    "get_include",
    "read",
    "read_exr",
    "write_estimates",
    "write_exr",
    "write_image",
    "write_maps",
    "write_netcdf",
    "write_reference",
]


def __dir__() -> list[str]:
    return sorted(__all__)
