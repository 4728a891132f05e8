"""First-hit features: albedo, shading normal, depth and position of what each pixel shows.

They are those of what the samples see. A ray passes through lamps that the integrator hides, and
through materials that let it pass in a straight line (null, mask, thin glass), as often as these
do; in a participating medium it ends where the medium scatters it first. There the albedo is that
of the medium, and the normal is 0, as it is where nothing is hit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit

from chdstat.rendering.rays import srgb

__all__ = ["AOVS", "FEATURES", "first_hit", "is_plain"]

FEATURES = {"albedo": 3, "normal": 3, "depth": 1, "position": 3}
"""Channels of each feature, in order."""
AOVS = "albedo:albedo,normal:sh_normal,depth:depth,position:position"
"""What Mitsuba's aov integrator calls them."""
dr: Any = drjit
_VOLUMETRIC = ("volpath", "volpathmis", "prbvolpath")
"""Mitsuba's integrators that see participating media."""
_LEAST = 1e-30
"""Extinction that a medium is divided by at least: scalars divided by 0 are an error."""


def is_plain(mi: Any, scene: Any, sensor: Any, name: str, *, hides: bool) -> bool:
    """Return whether the first surface that a ray of the sensor meets is what a sample shows.

    Parameters
    ----------
    name
        Mitsuba's name of the integrator.
    hides
        Whether it hides lamps.
    """
    held = mi.traverse(scene).hierarchy  # instances do not say what they are made of
    materials = [part for part in held if isinstance(part, mi.BSDF)]
    passing = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in materials)
    hidden = hides and any(shape.is_emitter() for shape in scene.shapes())
    return not (passing or hidden or (name in _VOLUMETRIC and sensor.get_medium() is not None))


def first_hit(
    mi: Any, scene: Any, aov: Any, ray: Any, sampler: Any, medium: Any, name: str, *, hides: bool
) -> list[Any]:
    """Return the 10 numbers of the features of a ray, or of many lanes.

    Parameters
    ----------
    aov
        Mitsuba's integrator of `AOVS`.
    medium
        The medium that the ray starts in, or None.
    name, hides
        As for `is_plain`.
    """
    origin = mi.Point3f(ray.o)
    path = _followed(mi, scene, ray, sampler, _pointer(mi, medium), hides, name in _VOLUMETRIC)
    _, _, found = aov.sample(scene, sampler, mi.RayDifferential3f(path.ray), None, True)
    values = [mi.Float(value) for value in found[-10:]]
    values[6] = dr.select(values[6] > 0, path.length + values[6], 0)
    scattered = [*path.albedo, 0, 0, 0, dr.norm(path.place - origin), *path.place]
    return [dr.select(path.ends, s, v) for s, v in zip(scattered, values, strict=True)]


@dataclass
class _Path:
    """A ray that is followed: what is left of it, how far it came, and where it was scattered."""

    ray: Any
    medium: Any
    length: Any
    ends: Any
    albedo: Any
    place: Any
    is_fresh: Any
    goes_on: Any


@dr.syntax  # type: ignore[untyped-decorator]
def _followed(
    mi: Any, scene: Any, ray: Any, sampler: Any, medium: Any, hides: bool, volumetric: bool
) -> Any:
    """Follow a ray until it meets a surface that shows, a medium scatters it, or nothing is met."""
    path = _Path(
        ray=mi.Ray3f(ray),
        medium=medium,
        length=mi.Float(0),
        ends=mi.Bool(False),
        albedo=mi.Color3f(0),
        place=mi.Point3f(0),
        is_fresh=mi.Bool(True),
        goes_on=mi.Bool(True),
    )
    while path.goes_on:
        path = _continued(mi, scene, path, sampler, hides, volumetric)
    return path


def _continued(
    mi: Any, scene: Any, path: _Path, sampler: Any, hides: bool, volumetric: bool
) -> _Path:
    """Return a path after its next event: a surface, or in a medium a collision."""
    si = scene.ray_intersect(path.ray, path.goes_on)
    collides = scatters = mi.Bool(False)
    t, place, albedo = mi.Float(0), path.place, path.albedo
    if volumetric and path.medium is not None:
        inside = path.goes_on & (True if mi.Bool is bool else path.medium != None)  # noqa: E711
        event, t, scattered = _collision(mi, path, sampler, inside)
        collides = inside & event.is_valid() & (t < si.t)
        scatters = collides & scattered
        share = event.sigma_s / dr.maximum(event.sigma_t, _LEAST)
        albedo = dr.select(scatters, srgb(mi, _flat(mi, share, path.ray), path.ray), albedo)
        place = dr.select(scatters, event.p, place)
    lamp = passes = mi.Bool(False)
    surface = path.goes_on & (collides ^ True) & si.is_valid()
    medium = path.medium
    if mi.Bool is not bool or surface:
        lamp = surface & path.is_fresh & hides & si.shape.is_emitter()
        sample, _ = si.bsdf().sample(
            mi.BSDFContext(), si, sampler.next_1d(surface), sampler.next_2d(surface), surface
        )
        passes = surface & (lamp ^ True) & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        if volumetric:
            crosses = (lamp | passes) & si.is_medium_transition()
            medium = _selected(mi, crosses, si.target_medium(path.ray.d), medium)
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
        # What passes through a material counts as a reflection, but for integrators of media.
        is_fresh=path.is_fresh & ((passes ^ True) | volumetric),
        goes_on=onward | (collides & (scatters ^ True)),
    )


def _collision(mi: Any, path: _Path, sampler: Any, inside: Any) -> tuple[Any, Any, Any]:
    """Return where a medium interacts with a ray next, how far away, and if it scatters there."""
    channel = mi.UInt32(dr.minimum(3 * sampler.next_1d(inside), 2)) if mi.is_rgb else 0
    event = path.medium.sample_interaction(path.ray, sampler.next_1d(inside), channel, inside)
    real = dr.mean(event.sigma_t / dr.maximum(event.combined_extinction, _LEAST))
    return event, event.t, sampler.next_1d(inside) < real


def _flat(mi: Any, spectrum: Any, ray: Any) -> Any:
    """Return a spectrum of reflectances over the density with which wavelengths are drawn."""
    if not mi.is_spectral:
        return spectrum
    density = mi.pdf_rgb_spectrum(ray.wavelengths)
    return spectrum * dr.select(density > 0, dr.rcp(density), 0)


def _pointer(mi: Any, medium: Any) -> Any:
    """Return a medium, or none, as variables of kernels hold it."""
    if mi.Bool is bool:
        return medium
    return dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)


def _selected(mi: Any, mask: Any, new: Any, old: Any) -> Any:
    if mi.Bool is bool:
        return new if mask else old
    return dr.select(mask, new, old)
