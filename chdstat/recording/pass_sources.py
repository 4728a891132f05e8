"""Passes: images of one sample of every pixel, and what draws them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from chdstat._core.arrays import Image, check_real
from chdstat._core.numbering import number_of, permuted
from chdstat.errors import InputError
from chdstat.samples.film_steps import checked_places
from chdstat.samples.tiles import FILM, LightPart

SEEDS = 2**30
"""Seeds of passes, and of users."""
_HALF = 2**15
_MOST_CHANNELS = 4
_FEATURES = {"albedo": 3, "normal": 3, "position": 3, "depth": 0}
"""Components of first-hit features; 0 for none."""


class DrawnPass(NamedTuple):
    """One sample of every pixel.

    Attributes
    ----------
    image
        Linear radiance, shape (y, x, channel).
    features
        First-hit features by name: albedo, normal and position, shape (y, x, 3); depth, (y, x).
    parts
        Parts of the same samples, each as `image`: `chdstat.samples.tiles.DIRECT_DEPTH` is emission
        and direct light; a name is what one light or group of lights adds.
    film
        Where in its pixel each sample fell, shape (y, x, 2): from 0 to 1 across and down.
    """

    image: Image
    features: Mapping[str, Image] = {}
    parts: Mapping[LightPart, Image] = {}
    film: Image | None = None


def checked_pass(found: Any) -> DrawnPass:
    """Return what a source drew as a pass in single precision, its film among the parts.

    Raises
    ------
    InputError
        If it is no image of linear radiance, or its features or parts are of another image.
    """
    if isinstance(found, tuple) and not isinstance(found, DrawnPass):
        if len(found) != 2 or not isinstance(found[1], Mapping):
            message = (
                "draw must return an image (y, x, channel), or a tuple of it and a dict of features"
                f", got a tuple of {', '.join(type(item).__name__ for item in found) or 'nothing'}"
            )
            raise InputError(message)
        found = DrawnPass(*found)
    elif not isinstance(found, DrawnPass):
        found = DrawnPass(found)
    image = _image(found.image, "the image")
    features = {name: _feature(f, str(name), image) for name, f in found.features.items()}
    parts = {which: _image(part, f"part {which!r}") for which, part in found.parts.items()}
    for which, part in parts.items():
        if part.shape != image.shape:
            message = f"part {which!r} must have the shape of the image, {image.shape}, got "
            raise InputError(message + str(part.shape))
    if found.film is not None:
        shape = (*image.shape[:2], 2)
        parts[FILM] = np.asarray(checked_places(found.film, shape, "film that draw returns"))
    return DrawnPass(image, features, parts)


def _image(given: Any, what: str) -> Image:
    array = np.asarray(given)
    if array.dtype.kind not in "biufc" or array.ndim not in (2, 3) or 0 in array.shape:
        kind = f"shape {array.shape}" if array.dtype.kind in "biufc" else type(given).__name__
        message = f"{what} that draw returns must be an array (y, x, channel), got {kind}"
        raise InputError(message)
    check_real(array.dtype, what)
    array = array if array.ndim == 3 else array[..., np.newaxis]
    if array.shape[2] > _MOST_CHANNELS:
        message = (
            f"{what} that draw returns must be (y, x, channel) with at most {_MOST_CHANNELS} "
            f"channels, got {array.shape}; put the channels last, as np.moveaxis(image, 0, -1) does"
        )
        raise InputError(message)
    with np.errstate(over="ignore"):  # kept as infinite, and told
        return np.asarray(array, np.float32)


def _feature(given: Any, name: str, image: Image) -> Image:
    """Return a first-hit feature, 0 where nothing was hit."""
    array = np.asarray(given)
    if name not in _FEATURES:
        message = f"features are {', '.join(_FEATURES)}, got {name!r}"
        raise InputError(message)
    shape = (*image.shape[:2], *([_FEATURES[name]] if _FEATURES[name] else []))
    if name == "depth" and array.shape == (*shape, 1):
        array = array[..., 0]
    if array.dtype.kind not in "iuf" or array.shape != shape:
        message = (
            f"feature {name} must be an array of shape {shape}, got {array.dtype} {array.shape}"
        )
        raise InputError(message)
    with np.errstate(over="ignore"):
        return np.nan_to_num(np.asarray(array, np.float32), posinf=0, neginf=0)


class PassSource(Protocol):
    """A renderer with a scene, which draws passes.

    It can be sent to other processes, where it starts its renderer again.
    """

    @property
    def name(self) -> str:
        """Name of the scene."""

    @property
    def attrs(self) -> Mapping[str, Any]:
        """Provenance, ready for JSON: all that samples depend on, apart from seeds."""

    def __call__(self, seed: int) -> DrawnPass:
        """Draw one sample of every pixel. Equal seeds need not give equal samples."""

    def close(self) -> None:
        """Stop the renderer."""


def seed_of_pass(seed: int, number: int) -> int:
    """Return the seed below 2^30 that draws a pass; one to one with its number.

    Seeds of consecutive passes look unrelated, which weak generators need. Two small seeds of a
    user share no pass, unless there are millions of passes.

    Examples
    --------
    >>> [seed_of_pass(0, number) for number in range(3)]
    [632626252, 458925464, 523402588]
    """
    return permuted(number_of(seed, number, SEEDS), 0, half=_HALF)
