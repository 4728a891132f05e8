"""Exchange with other programs: their samples, EXR files, maps, and estimates for a denoiser.

`read` opens samples in files of other programs; `get_include` names the folder of the C++ header
with which a renderer writes such files. `write_bcd`, `write_cascades` and `write_moments` write
what other denoisers start from. `write_exr` and `read_exr` keep images with their layers in EXR
files, `write_maps` and `write_netcdf` results per pixel; `denoise` gives an image of estimates to
Open Image Denoise.
"""

from __future__ import annotations

from chdstat.io.denoiser import denoise
from chdstat.io.denoiser_inputs import write_bcd, write_cascades, write_moments
from chdstat.io.exr import ExrImage, read_exr, write_exr
from chdstat.io.maps import write_maps, write_netcdf
from chdstat.io.reading import read
from chdstat.io.stream import get_include

__all__ = [
    "ExrImage",
    "denoise",
    "get_include",
    "read",
    "read_exr",
    "write_bcd",
    "write_cascades",
    "write_exr",
    "write_maps",
    "write_moments",
    "write_netcdf",
]


def __dir__() -> list[str]:
    return sorted(__all__)
