"""Draws: what a test calls its render, as samples for a look and as a reference.

**Seeds.** A name has seeds of its own: 2^30 for tests and 2^30 for references, all of them below
2^31, so that they fit into a signed number. Thus a test never draws the samples of its reference,
and draws the same ones when it is run again: no second run passes by luck. Consecutive passes have
seeds that lie far apart, as multiples of the golden ratio do, because some renderers add the number
of a pixel to the seed. Two such passes would share random numbers if their seeds were neighbours.

**Looks.** The second look at a render has other samples than the first. A reference that replaces
another one has other samples than that.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from chdstat._core.arrays import Array, Image
from chdstat._core.display import channel_names
from chdstat._core.files import is_exr, is_path, place_of
from chdstat.errors import InputError, InputWarning, brief
from chdstat.inference import Contrast, contrast
from chdstat.inference.references import BATCHES, OF_TEST, Reference, sums_of_good
from chdstat.samples import Samples, is_store, samples_of
from chdstat.samples.samples import single
from chdstat.scenes import Scene, load_scene

_HALF = 2**30
_GOLDEN = 0x9E3779B1 % _HALF | 1
"""2^32 over the golden ratio, odd: its multiples take each value of 30 bits once."""
_APART = 2**20
"""Passes of a reference before those of its successor begin."""


@dataclass(frozen=True)
class Seeds:
    """Seeds of passes, by the name of the test and a number that the user may give.

    Examples
    --------
    >>> seeds = Seeds("bathroom")
    >>> drawn = {seeds.of_test(i) for i in range(1000)}
    >>> kept = {seeds.of_reference(i, other=False) for i in range(3000)}
    >>> len(drawn), len(kept), len(drawn & kept), max(kept) < 2**31
    (1000, 3000, 0, True)
    """

    name: str
    number: int = 0

    def of_test(self, i: int) -> int:
        """Return the seed of pass i of a test."""
        return (self._begin(f"{self.name} {self.number}") + i) * _GOLDEN % _HALF

    def of_reference(self, i: int, *, other: bool) -> int:
        """Return the seed of pass i of a reference: the one or the `other` of two series."""
        return _HALF + (self._begin(self.name) + _APART * other + i) * _GOLDEN % _HALF

    @staticmethod
    def _begin(text: str) -> int:
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest()) % _HALF


class Render(Protocol):
    """What is tested."""

    again: ClassVar[bool]
    """Whether other samples can be drawn."""

    def compare(
        self, reference: Reference, spp: int | None, seeds: Iterator[int], **options: Any
    ) -> Contrast:
        """Return its contrast with a reference, from samples drawn with the next seeds."""
        ...

    def reference(self, spp: int | None, seeds: Iterator[int]) -> Reference:
        """Return a reference for tests of `spp`."""
        ...


def render_of(render: Any, name: str) -> Render:
    """Return what a test calls its render.

    Raises
    ------
    InputError
        If it is none of the things that `same_light` takes.
    StoreError
        If a file or store is missing or damaged.
    """
    if isinstance(render, Scene):
        return _SceneRender(render)
    if is_path(render):
        return _of_path(render)
    if isinstance(render, list | tuple):
        return _Fixed(_of_passes(render, name))
    if callable(render) and not hasattr(render, "__array__"):
        return _FunctionRender(render, name)
    if not isinstance(render, Samples) and np.ndim(render) == 3:
        message = (
            f"{name} is an image of shape {np.shape(render)}, which does not show its noise: give "
            "a function of a seed that draws one sample of each pixel, or all samples (y, x, "
            "channel, sample)"
        )
        raise InputError(message)
    return _Fixed(_checked_repeats(render))


def _of_path(path: str | Path) -> Render:
    if is_exr(path):
        return _Fixed(_of_passes([path], str(path)))
    if is_store(path) or place_of(path).suffix == ".zarr":
        return _Fixed(samples_of(path))
    return _SceneRender(load_scene(path))


def _of_passes(passes: list[Any] | tuple[Any, ...], name: str) -> Samples:
    """Return the samples of passes: images, or files of them."""
    if passes and all(map(is_path, passes)):
        from chdstat.io import read

        with _refusing_repeats():
            return read(*passes)
    images = [_checked_pass(image, name, "a pass") for image in passes]
    shapes = {image.shape for image in images}
    if len(shapes) != 1:
        sizes = " and ".join(map(str, sorted(shapes))) or "no pass"
        message = f"expected passes of one shape (y, x, channel), got {sizes}"
        raise InputError(message)
    return _checked_repeats(np.concatenate(images, axis=-1))


@dataclass(frozen=True)
class _Fixed:
    """Samples that are there already."""

    samples: Samples
    again: ClassVar[bool] = False

    def compare(
        self,
        reference: Reference,
        spp: int | None,
        seeds: Iterator[int],  # noqa: ARG002
        **options: Any,
    ) -> Contrast:
        """Compare them, all in one look."""
        self._refuse(spp)
        return _compare(self.samples, reference, **options)

    def reference(self, spp: int | None, seeds: Iterator[int]) -> Reference:  # noqa: ARG002
        """Return a reference of them."""
        self._refuse(spp)
        return Reference.of_samples(self.samples)

    def _refuse(self, spp: int | None) -> None:
        if spp is not None:
            message = f"spp={spp} is for functions and scenes: here are {self.samples.spp} samples"
            raise InputError(message)


@dataclass(frozen=True)
class _SceneRender:
    """A scene that Mitsuba renders."""

    scene: Scene
    again: ClassVar[bool] = True

    def compare(
        self, reference: Reference, spp: int | None, seeds: Iterator[int], **options: Any
    ) -> Contrast:
        """Render it, and compare all samples in one look."""
        return _compare(self._samples(spp or 0, seeds), reference, **options)

    def reference(self, spp: int | None, seeds: Iterator[int]) -> Reference:
        """Render it with more samples."""
        return Reference.of_samples(self._samples(_of_reference(spp), seeds))

    def _samples(self, spp: int, seeds: Iterator[int]) -> Samples:
        from chdstat.rendering import render

        return render(self.scene, spp=spp, seed=next(seeds), progress=False)


@dataclass(frozen=True)
class _FunctionRender:
    """A function of a seed, which draws one or several samples of each pixel."""

    draw: Callable[[int], Any]
    name: str
    again: ClassVar[bool] = True

    def compare(
        self, reference: Reference, spp: int | None, seeds: Iterator[int], **options: Any
    ) -> Contrast:
        """Draw until the samples can tell, or until `spp` are drawn."""
        draw = partial(self._pass, seeds, reference.shape, "in the reference")
        with _refusing_repeats():
            return contrast(lambda _: draw(), reference, spp=spp, **options)

    def reference(self, spp: int | None, seeds: Iterator[int]) -> Reference:
        """Draw batch after batch, of which only means are kept."""
        total, means, bad = _of_reference(spp), list[Array](), list[Array]()
        shape: tuple[int, ...] = ()
        for _ in range(BATCHES):
            x = self._values(total // BATCHES, seeds, shape)
            shape = x.shape[:3]
            sums, number = sums_of_good(x)
            good = np.broadcast_to(number, shape[:2])
            with np.errstate(invalid="ignore"):
                means.append(sums / good[..., np.newaxis])
            bad.append(1 - good / x.shape[-1])
        batches, size = np.stack(means, axis=-1).astype(np.float32), total // BATCHES
        with _refusing_repeats():
            samples = Samples.from_array(batches, axes="yxcs", averaged=size)
        return replace(Reference.of_samples(samples), bad=np.mean(bad, axis=0), attrs={})

    def _values(self, spp: int, seeds: Iterator[int], shape: tuple[int, ...]) -> Image:
        """Return `spp` samples of each pixel, float32, shape (y, x, channel, sample)."""
        parts, drawn = list[Image](), 0
        while drawn < spp:
            x = self._pass(seeds, shape, "for another seed")[..., : spp - drawn]
            shape, drawn = x.shape[:3], drawn + x.shape[-1]
            parts.append(x)
        return np.concatenate(parts, axis=-1)

    def _pass(self, seeds: Iterator[int], shape: tuple[int, ...], where: str) -> Image:
        """Return what the function draws from the next seed; it must have the shape, if any."""
        x = _checked_pass(self.draw(next(seeds)), self.name, "what the function returned")
        if shape and x.shape[:3] != shape:
            raise InputError(unlike(f"{self.name}: the render has", x.shape, shape, where))
        return x


def unlike(one: str, shape: tuple[int, ...], other: tuple[int, ...], where: str) -> str:
    """Return what is said of two shapes that must be equal.

    Examples
    --------
    >>> unlike("the render has", (4, 6, 3), (4, 8, 3), "in the reference")
    'the render has 6 x 4 pixels and 3 channels, expected 8 x 4 and 3 as in the reference'
    """
    (height, width, channels), (rows, columns, bands) = shape[:3], other[:3]
    return (
        f"{one} {width} x {height} pixels and {channels} channels, expected {columns} x {rows} and "
        f"{bands} as {where}"
    )


def _compare(samples: Samples, reference: Reference, **options: Any) -> Contrast:
    if samples.shape[:3] != reference.shape:
        message = unlike("the render has", samples.shape, reference.shape, "in the reference")
        raise InputError(message)
    options.pop("finds", None)  # which ends the drawing
    return contrast(samples, reference, **options)


def _of_reference(spp: int | None) -> int:
    """Return the samples per pixel of the reference of a test: whole batches."""
    return BATCHES * max(1, -(-OF_TEST * (spp or 0) // BATCHES))


def _checked_pass(given: Any, name: str, what: str) -> Image:
    """Return samples of each pixel as (y, x, channel, sample), in single precision.

    Raises
    ------
    InputError
        If it is no image of linear radiance.
    """
    try:
        x = np.asarray(given)
    except Exception as error:  # such as of a tensor on a GPU
        message = f"{name}: {what} is no array: {brief(error).rstrip('.')}"
        raise InputError(message) from error
    if x.dtype.kind in "iub":
        message = (
            f"{name}: {what} holds whole numbers ({x.dtype}), as images for the screen do: return "
            "linear radiance as floats, before tone mapping"
        )
        raise InputError(message)
    if x.dtype.kind != "f" or x.ndim not in (3, 4) or 0 in x.shape:
        got = f"shape {x.shape} of {x.dtype}" if x.dtype != object else type(given).__name__
        message = (
            f"{name}: {what} must be one sample of each pixel, an array (y, x, channel) of floats, "
            f"or several, (y, x, channel, sample); got {got}"
        )
        raise InputError(message)
    x = single(x, name)
    if x.shape[2] > len(channel_names(3)) + 1 and x.shape[0] <= len(channel_names(3)):
        message = f"{name}: {what} has shape {x.shape[:3]}, expected (y, x, channel)"
        raise InputError(message)
    return x if x.ndim == 4 else x[..., np.newaxis]


class _refusing_repeats(warnings.catch_warnings):  # noqa: N801 - a context
    """Refuse samples that repeat each other: no test is right for them."""

    def __enter__(self) -> None:
        super().__enter__()
        warnings.simplefilter("error", InputWarning)

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        super().__exit__(kind, error, trace)
        if isinstance(error, InputWarning):
            raise InputError(str(error)) from None


def _checked_repeats(values: Any) -> Samples:
    """Return samples, or refuse those that repeat each other."""
    with _refusing_repeats():
        return samples_of(values)
