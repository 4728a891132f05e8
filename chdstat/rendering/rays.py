"""Rays: one sample of a pixel, or of many lanes, from a ray of the sensor to linear sRGB."""

from __future__ import annotations

from typing import Any

__all__ = ["drawn", "sensed", "srgb"]


def sensed(mi: Any, position: Any, sensor: Any, sampler: Any) -> tuple[Any, Any]:
    """Return the ray through a position of the image, from 0 to 1, and its weight.

    The sampler draws the time within the shutter interval, the point on the lens and the
    wavelengths, where needed.
    """
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    wavelength = sampler.next_1d() if mi.is_spectral else 0.0
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, lens)
    return ray, weight


def drawn(
    mi: Any, position: Any, scene: Any, sensor: Any, integrator: Any, sampler: Any, medium: Any
) -> Any:
    """Return the radiance of a ray through a position of the image as linear sRGB.

    No method of a renderer: a kernel that held its renderer would keep the scene alive in a circle,
    and the next scene's kernel could not be frozen.
    """
    ray, weight = sensed(mi, position, sensor, sampler)
    if _is_differentiable(mi, integrator):  # Mitsuba's in Python take other arguments
        import drjit

        dr: Any = drjit
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
                active=mi.Bool(True),
            )
    else:
        color, _, _ = integrator.sample(scene, sampler, ray, medium, True)
    return srgb(mi, weight * color, ray)


def srgb(mi: Any, radiance: Any, ray: Any) -> Any:
    """Return the spectrum of a ray as linear sRGB, each sample as Mitsuba's film takes it."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(radiance, ray.wavelengths, True)
    return mi.Color3f(radiance[0]) if mi.is_monochromatic else radiance


def _is_differentiable(mi: Any, integrator: Any) -> bool:
    base = getattr(mi, "CppADIntegrator", None)
    return base is not None and isinstance(integrator, base)
