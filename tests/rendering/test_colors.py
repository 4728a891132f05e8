"""Spectral and mono variants: their samples are those of Mitsuba's own film, one by one.

The statistical tests compare pixels with Mitsuba's own image in the same variant; seeds are fixed.
With new seeds each fails falsely with a probability below 2e-3: a mean of 512 samples of a pixel
and channel is over six standard errors of the difference off, of at most 192 values, whose
distributions have bounded tails; 0.1 % is left for their skewness.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import RenderError
from chdstat.rendering import backend as backends
from chdstat.rendering import render_pixels
from chdstat.rendering.backend import TriedBackend, activate, probe, resolve

CASES = [("scalar", "spectral"), ("llvm", "spectral"), ("llvm", "mono")]
SCENE: dict[str, Any] = {
    "type": "scene",
    "integrator": {"type": "direct"},
    "sensor": {
        "type": "perspective",
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
    },
    "lamp": {
        "type": "rectangle",
        "to_world": np.diag([0.4, 0.4, 1.0, 1.0]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 0.5]}},
    },
    "wall": {
        "type": "rectangle",
        "to_world": np.diag([3.0, 2.0, -1.0, 1.0]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.7, 0.2]}},
    },
}
SCENE["lamp"]["to_world"][2, 3], SCENE["wall"]["to_world"][2, 3] = 2.0, 4.0
SCENE["lamp"]["to_world"][0, 3] = 0.7


def used(backend: str, color: str) -> dict[str, Any]:
    if not probe(backend).works:
        pytest.skip(f"no {backend}")
    return {"backend": backend, "color": color}


def by_mitsuba(backend: str, color: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of renders by Mitsuba alone, and its standard error."""
    with activate(resolve(backend, color)) as mi:
        scene = chd.load_scene(SCENE)
        built = scene.load()
        images = [np.array(mi.render(built, spp=256, seed=10_000 + i)) for i in range(16)]
    stack = np.array(images, np.float64)
    assert stack.shape[1:] == (8, 8, 1 if color == "mono" else 3)
    return stack.mean(axis=0), stack.std(axis=0, ddof=1) / np.sqrt(len(stack))


@pytest.mark.parametrize(("backend", "color"), CASES)
def test_the_mean_of_samples_is_the_image_of_mitsuba(backend, color):
    samples = chd.render(SCENE, spp=512, progress=False, **used(backend, color))
    x = samples.read().astype(np.float64)
    mean, error = by_mitsuba(backend, color)
    own = x.std(axis=-1, ddof=1) / np.sqrt(x.shape[-1])
    scale = np.hypot(error, own) + 1e-4
    assert np.abs((x.mean(axis=-1) - mean) / scale).max() < 6
    # The order of the channels matters, where there are three.
    reversed_ = np.abs((x.mean(axis=-1)[..., ::-1] - mean) / scale).max()
    assert (reversed_ > 6) == (color != "mono")
    single = render_pixels(SCENE, [(3, 5)], spp=512, **used(backend, color))[0]
    mean, error = (np.broadcast_to(a, (8, 8, 3)) for a in (mean, error))
    near = np.abs(single.mean(axis=-1) - mean[3, 5])
    assert (near < 6 * (single.std(axis=-1) / np.sqrt(512) + error[3, 5]) + 1e-4).all()


@pytest.mark.parametrize(("backend", "color"), CASES)
def test_null_samples_are_zero_and_negative_ones_stay(backend, color):
    samples = chd.render(SCENE, spp=64, progress=False, **used(backend, color))
    x = samples.read()
    dark = (x == 0).all(axis=2)
    assert 0.05 < dark.mean() < 0.99
    assert ((x == 0).any(axis=2) == dark).all()
    assert (x.min() < 0) == (color == "spectral"), "single wavelengths are out of sRGB's gamut"
    assert samples.attrs["color"] == color
    assert samples.features["albedo"].shape == (8, 8, 3)


def test_colors_that_cannot_be_rendered_are_told(monkeypatch):
    scalar = {"scalar": True, "llvm": False, "cuda": False}
    monkeypatch.setattr(backends, "probe", lambda name: TriedBackend(name, scalar[name], "a test"))
    with pytest.raises(RenderError, match="'mono'.*llvm or cuda"):
        chd.render(SCENE, color="mono")
