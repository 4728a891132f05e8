"""Rays: one sample of a pixel, or of many lanes, from a ray of the sensor to linear sRGB."""

from __future__ import annotations

from typing import Any

__all__ = ["drawn"]


def drawn(
    mi: Any, position: Any, scene: Any, sensor: Any, integrator: Any, sampler: Any, medium: Any
) -> Any:
    """Return the radiance of a ray through a position of the image, from 0 to 1, as linear sRGB.

    The sampler draws the time within the shutter interval, the point on the lens and the
    wavelengths, where needed.

    No method of a renderer: a kernel that held its renderer would keep the scene alive in a circle,
    and the next scene's kernel could not be frozen.
    """
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    wavelength = sampler.next_1d() if mi.is_spectral else 0.0
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, lens)
    color, _, _ = integrator.sample(scene, sampler, ray, medium, True)
    radiance = weight * color
    if mi.is_spectral:  # each sample, as Mitsuba's film takes it
        return mi.spectrum_to_srgb(radiance, ray.wavelengths, True)
    return mi.Color3f(radiance[0]) if mi.is_monochromatic else radiance
