"""Rays: the radiance or the first-hit features of a ray through a position of the image.

First-hit features are albedo, shading normal, depth and position of what the samples see. A ray
passes through lamps that the integrator hides, and through materials that let it pass in a straight
line (null, mask, thin glass), as often as these do. In a participating medium, it ends where the
medium first scatters it; the albedo is then that of the medium, and the normal is 0. The normal is
also 0 where nothing is hit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit
import numpy as np

from chdstat._core.arrays import Image
from chdstat.rendering.backend import one_thread

FEATURES = {"albedo": 3, "normal": 3, "depth": 1, "position": 3}
"""Channels of each feature, in order."""
_AOVS = "albedo:albedo,normal:sh_normal,depth:depth,position:position"
"""Names of the features in Mitsuba's aov integrator."""
_FEATURE_SPP = 16
BLOCK = 32
"""Edge in pixels of the blocks of an integrator; Mitsuba's default depends on the cores."""
dr: Any = drjit
_VOLUMETRIC = ("volpath", "volpathmis", "prbvolpath")
"""Mitsuba's integrators for participating media."""
_LEAST = 1e-30
"""Least extinction that a medium is divided by: dividing scalars by 0 is an error."""


def wavefront(
    mi: Any,
    objects: Sequence[Any],
    size: tuple[int, int],
    run: int,
    number: Any,
    left: Any,
    top: Any,
    width: Any,
    pixels: Any,
    lanes: int,
    active: Any = True,
) -> Any:
    """Return the radiance of all lanes, which run over the samples of a run, then over pixels.

    This is not a method of a renderer: a kernel that held its renderer would keep the scene alive
    in a circle, and the next scene's kernel could not be frozen.

    Parameters
    ----------
    objects
        As for `drawn`; without an integrator, only where in its pixel each sample falls is drawn.
    size
        (width, height) of the image.
    run
        Samples of a pixel in neighbouring lanes.
    number
        Seed of the sampler.
    left, top, width, pixels
        The rectangle of the image to draw, and its number of pixels.
    active
        Whether each lane is drawn at all; its random numbers do not depend on that.
    """
    scene, sensor, integrator, source, medium = objects
    sampler = source.clone()
    sampler.seed(number, lanes)
    place = sampler.next_2d()
    if integrator is None:
        return place
    index = dr.arange(mi.UInt32, lanes) // run % pixels
    pixel = mi.Point2f(mi.Float(index % width + left), mi.Float(index // width + top))
    position = (pixel + place) / mi.Point2f(*map(float, size))
    return drawn(mi, position, (scene, sensor, integrator, sampler, medium), active)


def drawn(mi: Any, position: Any, objects: Sequence[Any], active: Any = True) -> Any:
    """Return the radiance of a ray through a position of the image, from 0 to 1, as linear sRGB.

    The `objects` are scene, sensor, integrator, sampler and the medium in which rays start.
    """
    scene, sensor, integrator, sampler, medium = objects
    ray, weight = sensed(mi, position, sensor, sampler)
    differentiable = getattr(mi, "CppADIntegrator", ())
    if isinstance(integrator, differentiable):  # Mitsuba's in Python take other arguments
        with dr.suspend_grad():
            color, *_ = integrator.sample(
                mode=dr.ADMode.Primal,
                scene=scene,
                sampler=sampler,
                ray=ray,
                depth=mi.UInt32(0),
                δL=None,
                δaovs=None,
                state_in=None,
                active=mi.Bool(active),
            )
    else:
        color, _, _ = integrator.sample(scene, sampler, ray, medium, active)
    return _srgb(mi, weight * color, ray)


def sensed(mi: Any, position: Any, sensor: Any, sampler: Any) -> tuple[Any, Any]:
    """Return the ray through a position of the image, and its weight.

    The sampler draws the time within the shutter interval, the point on the lens and the
    wavelengths, if they are needed.
    """
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    wavelength = sampler.next_1d() if mi.is_spectral else 0.0
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, lens)
    return ray, weight


def _srgb(mi: Any, radiance: Any, ray: Any) -> Any:
    """Return the spectrum of a ray as linear sRGB, each sample as Mitsuba's film takes it."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(radiance, ray.wavelengths, True)
    return mi.Color3f(radiance[0]) if mi.is_monochromatic else radiance


# --- first-hit features -------------------------------------------------------------------------


@dataclass
class _Path:
    """A ray that is followed: its remaining throughput, its length, and where it was scattered."""

    ray: Any
    medium: Any
    length: Any
    ends: Any
    albedo: Any
    place: Any
    is_fresh: Any
    goes_on: Any


class FirstHits:
    """Rays of a sensor that are followed to the first thing that shows.

    Parameters
    ----------
    medium
        The medium in which they start, or None.
    integrator
        Mitsuba's name of the integrator.
    hides
        Whether the integrator hides lamps.
    """

    def __init__(
        self, mi: Any, scene: Any, sensor: Any, medium: Any, *, integrator: str, hides: bool
    ) -> None:
        self.mi, self.scene, self.sensor, self.medium = mi, scene, sensor, medium
        self.hides, self.volumetric = hides, integrator in _VOLUMETRIC
        self.aov = mi.load_dict({"type": "aov", "aovs": _AOVS, "block_size": BLOCK})
        self.sampler = mi.load_dict({"type": "independent"})

    def features(self, width: int, height: int, *, as_it_is: bool) -> dict[str, Image]:
        """Return the first-hit features of an image by name, shape (y, x) or (y, x, channel).

        `as_it_is` says that the film of the sensor cannot be changed, so that Mitsuba cannot render
        to it.
        """
        if as_it_is or not self._end_at_once():
            stack = self._means(width, height)
        else:
            # Mitsuba copies the list of shapes for each sample: threads wait for its counters.
            with one_thread() if self.mi.Bool is bool else contextlib.nullcontext():
                image = self.aov.render(self.scene, self.sensor, seed=0, spp=_FEATURE_SPP)
                stack = np.array(image, np.float32)[..., -sum(FEATURES.values()) :]
        ends = np.cumsum(list(FEATURES.values()))[:-1]
        parts = zip(FEATURES, np.split(stack, ends, axis=-1), strict=True)
        return {name: p[..., 0] if p.shape[-1] == 1 else p for name, p in parts}

    def _end_at_once(self) -> bool:
        """Return whether the first surface that a ray meets always shows."""
        mi = self.mi
        held = mi.traverse(self.scene).hierarchy  # instances do not say what they are made of
        materials = [part for part in held if isinstance(part, mi.BSDF)]
        passing = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in materials)
        hidden = self.hides and any(shape.is_emitter() for shape in self.scene.shapes())
        inside = self.volumetric and self.sensor.get_medium() is not None
        return not (passing or hidden or inside)

    def _means(self, width: int, height: int) -> Image:
        """Return the mean features of many rays of each pixel, shape (y, x, number)."""
        mi, sampler = self.mi, self.sampler

        def hit(x: Any, y: Any) -> list[Any]:
            dx, dy = sampler.next_2d()
            position = mi.Point2f((x + dx) / width, (y + dy) / height)
            ray, _ = sensed(mi, position, self.sensor, sampler)
            return self._first_hit(ray)

        if mi.Bool is bool:
            sampler.seed(0, 1)
            pixels = np.ndindex(height, width)
            means = [np.mean([hit(x, y) for _ in range(_FEATURE_SPP)], axis=0) for y, x in pixels]
            return np.array(means, np.float32).reshape(height, width, -1)
        lanes = width * height * _FEATURE_SPP
        sampler.seed(0, lanes)
        index = dr.arange(mi.UInt32, lanes) // _FEATURE_SPP
        found = hit(mi.Float(index % width), mi.Float(index // width))
        stack = np.stack([np.broadcast_to(np.array(v), lanes) for v in found], axis=-1)
        stack = stack.reshape(height, width, _FEATURE_SPP, -1)
        return np.asarray(stack.mean(axis=2), np.float32)

    def _first_hit(self, ray: Any) -> list[Any]:
        """Return the 10 numbers of the features of a ray, or of many lanes."""
        mi, origin, medium = self.mi, self.mi.Point3f(ray.o), self.medium
        if mi.Bool is not bool:  # as variables of kernels hold it
            medium = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        start = _Path(
            ray=mi.Ray3f(ray),
            medium=medium,
            length=mi.Float(0),
            ends=mi.Bool(False),
            albedo=mi.Color3f(0),
            place=mi.Point3f(0),
            is_fresh=mi.Bool(True),
            goes_on=mi.Bool(True),
        )
        path = _followed(self, start, self.sampler)
        _, _, found = self.aov.sample(
            self.scene, self.sampler, mi.RayDifferential3f(path.ray), None, True
        )
        values = [mi.Float(value) for value in found[-10:]]
        values[6] = dr.select(values[6] > 0, path.length + values[6], 0)
        scattered = [*path.albedo, 0, 0, 0, dr.norm(path.place - origin), *path.place]
        return [dr.select(path.ends, s, v) for s, v in zip(scattered, values, strict=True)]

    def continued(self, path: _Path, sampler: Any) -> _Path:
        """Return a path after its next event: a surface, or in a medium a collision."""
        mi = self.mi
        si = self.scene.ray_intersect(path.ray, path.goes_on)
        collides = scatters = mi.Bool(False)
        t, place, albedo = mi.Float(0), path.place, path.albedo
        if self.volumetric and path.medium is not None:
            inside = path.goes_on & (True if mi.Bool is bool else path.medium != None)  # noqa: E711
            event, t, scattered = self._collision(path, sampler, inside)
            collides = inside & event.is_valid() & (t < si.t)
            scatters = collides & scattered
            share = event.sigma_s / dr.maximum(event.sigma_t, _LEAST)
            albedo = dr.select(scatters, _srgb(mi, _flat(mi, share, path.ray), path.ray), albedo)
            place = dr.select(scatters, event.p, place)
        lamp = passes = mi.Bool(False)
        surface = path.goes_on & (collides ^ True) & si.is_valid()
        medium = path.medium
        if mi.Bool is not bool or surface:
            lamp = surface & path.is_fresh & self.hides & si.shape.is_emitter()
            sample, _ = si.bsdf().sample(
                mi.BSDFContext(), si, sampler.next_1d(surface), sampler.next_2d(surface), surface
            )
            passes = surface & (lamp ^ True) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
            if self.volumetric:
                crosses = (lamp | passes) & si.is_medium_transition()
                inner = si.target_medium(path.ray.d)
                if mi.Bool is bool:
                    medium = inner if crosses else medium
                else:
                    medium = dr.select(crosses, inner, medium)
        onward, ray = lamp | passes, mi.Ray3f(path.ray)
        ray.o = dr.select(collides, path.ray(t), ray.o)
        ray = dr.select(onward, si.spawn_ray(path.ray.d), ray)
        return _Path(
            ray=ray,
            medium=medium,
            length=path.length + dr.select(onward, si.t, dr.select(collides, t, 0)),
            ends=path.ends | scatters,
            albedo=albedo,
            place=place,
            # Passing through a material counts as a reflection, except for integrators of media.
            is_fresh=path.is_fresh & ((passes ^ True) | self.volumetric),
            goes_on=onward | (collides & (scatters ^ True)),
        )

    def _collision(self, path: _Path, sampler: Any, inside: Any) -> tuple[Any, Any, Any]:
        """Return where a medium meets a ray next, at which distance, and if it scatters there."""
        mi = self.mi
        channel = mi.UInt32(dr.minimum(3 * sampler.next_1d(inside), 2)) if mi.is_rgb else 0
        event = path.medium.sample_interaction(path.ray, sampler.next_1d(inside), channel, inside)
        real = dr.mean(event.sigma_t / dr.maximum(event.combined_extinction, _LEAST))
        return event, event.t, sampler.next_1d(inside) < real


@dr.syntax  # type: ignore[untyped-decorator]
def _followed(rays: FirstHits, path: _Path, sampler: Any) -> Any:
    """Follow a path until it meets a surface that shows, a medium scatters it, or it leaves.

    The sampler is a variable of the loop; otherwise, each turn would draw the same random numbers.
    """
    while path.goes_on:
        path = rays.continued(path, sampler)
    return path


def _flat(mi: Any, spectrum: Any, ray: Any) -> Any:
    """Return a spectrum of reflectances over the density with which wavelengths are drawn."""
    if not mi.is_spectral:
        return spectrum
    density = mi.pdf_rgb_spectrum(ray.wavelengths)
    return spectrum * dr.select(density > 0, dr.rcp(density), 0)
