"""Stacks of EXR images, each a sample or an average of some.

The attributes that count samples are those that pbrt-v4 (``samplesPerPixel``,
src/pbrt/util/image.cpp) and Blender's Cycles (``cycles.<layer>.samples``) write.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from chdstat._core.arrays import warn_caller
from chdstat.errors import InputError
from chdstat.io.exr import Planes, read_planes
from chdstat.io.lazy import Frame, Frames, Opened, ReadOptions

__all__ = ["open_exr"]

_COUNTED = re.compile(r"samplesPerPixel|cycles\..*\.samples")
"""Attributes that say how many samples an image is the average of."""


def open_exr(paths: Sequence[Path], options: ReadOptions) -> Opened:
    """Open EXR files of one sample, or one average, of each pixel.

    The samples are the colours of the image, or the layer `variable`; alpha is left out. Features
    are layers, averaged over all files, since each sample of a pixel sees something else.

    Notes
    -----
    Read
        Float and half; scanlines and tiles; every lossless or lossy compression; several parts; R,
        G and B, in capitals or not, also as ``red``, ``green``, ``blue``; else ``Y``; else the only
        layer of such channels, or ``variable``; the number of averaged samples.
    Converted
        Data windows: placed in the display window, 0 outside of them; colours of other primaries:
        to linear Rec. 709; ``X``, ``Y``, ``Z`` without a layer: CIE XYZ to linear Rec. 709.
    Warned of
        Both conversions of colours; several parts of colours, the first of which is called like no
        image; overscan, which is cut; a colour space that is not known or not linear;
        chromaticities that are none; pixels that are no squares; half floats of 65504 or infinity;
        copies.
    Ignored
        Alpha, other layers, levels but the first of mipmaps, ``whiteLuminance``, ``expTime``,
        ``adoptedNeutral`` and other attributes.
    Refused
        Several layers that could be the image; luminance and chroma (``RY``, ``BY``); whole numbers
        as radiance; deep channels and those of lower resolution, if they are asked for; data
        windows outside of the display window; files of one stack that differ in display window,
        channels, or number of averaged samples; damaged files.
    """
    first, told = read_planes(paths[0]), set[str]()
    names = (
        first.layer(options.variable)
        if options.variable
        else first.main("give the layer of the samples as variable, one of")
    )
    layers = {name: first.layer(inside) for name, inside in options.features.items()}
    averaged = _averaged(first.attributes)

    def frame(planes: Planes) -> Frame:
        _check_equal(planes, first, [*names, *itertools.chain(*layers.values())])
        image = planes.image(names, colours=True)
        features = {n: planes.image(of, colours=n == "albedo") for n, of in layers.items()}
        for kind in planes.notes.keys() - told:
            told.add(kind)
            warn_caller(planes.notes[kind])
        return image, features

    def decode(samples: range) -> Iterator[Frame]:
        for number in samples:
            yield frame(read_planes(paths[number]) if number else first)

    shape = (*first.shape, len(names), len(paths))
    frame(first)  # what is to be said of it, is said now
    attrs = {"averaged": averaged} if averaged > 1 else {}
    return Opened(Frames(paths[0].parent, shape, decode, featured=bool(layers)), attrs)


def _check_equal(planes: Planes, first: Planes, names: Sequence[str]) -> None:
    """Refuse a file that is no further sample of what the first file shows."""
    path, counts = planes.path, [_averaged(p.attributes) for p in (planes, first)]
    if counts[0] != counts[1]:
        message = (
            f"{path} is an average of {counts[0]} samples, {first.path.name} of {counts[1]}: read "
            "them apart"
        )
        raise InputError(message)
    if not set(names) <= planes.channels.keys():
        held = ", ".join(planes.channels)
        message = f"{path} has channels {held}, but the first file {', '.join(names)}"
        raise InputError(message)
    if planes.window != first.window:
        shapes = [f"{p.shape} pixels" for p in (planes, first)]
        if planes.shape == first.shape:
            shapes = [f"a display window that begins at {p.window[:2]}" for p in (planes, first)]
        message = f"{path} has {shapes[0]}, but the first file {shapes[1]}"
        raise InputError(message)


def _averaged(attributes: Mapping[str, Any]) -> int:
    """Return how many samples an image says that it is the average of, or 1."""
    for name, value in attributes.items():
        if _COUNTED.fullmatch(name) and str(value).isdecimal():
            return max(int(value), 1)
    return 1
