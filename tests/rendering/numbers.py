"""Random numbers as radiance: what a sampler draws is what a render holds."""

from __future__ import annotations

from typing import Any

from chdstat.rendering.backend import activate, probe

ALPHA = 1e-3
NUMBERS: dict[str, Any] = {
    "type": "scene",
    "integrator": {"type": "random_numbers"},
    "sensor": {"type": "perspective"},
}
"""A scene whose radiance is the three random numbers that follow the film's, in every pixel."""


def register_numbers(backend: str) -> None:
    """Make the integrator of `NUMBERS` known to a backend."""
    with activate(probe(backend)) as mi:

        class RandomNumbers(mi.SamplingIntegrator):  # type: ignore[misc, name-defined]
            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Color3f(*(sampler.next_1d(active) for _ in range(3))), True, []

        mi.register_integrator("random_numbers", RandomNumbers)
