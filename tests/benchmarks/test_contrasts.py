"""Contrasts: levels of p-values on renders, power against a test that knows the place, and time.

Run with ``pytest tests/benchmarks/test_contrasts.py --benchmark-only -s``: about five minutes.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.scenes import load_scene

LEVELS = np.array([0.001, 0.01, 0.05, 0.1])
SCENES = ("cornell-box", "bathroom", "night-room", "gallery", "caustic", "many-lights")
SPP = (16, 64, 256, 1024)
KINDS = {
    "path, other seed": (False, 5),
    "roulette, other seed": (True, 7),
    "roulette, same seed": (True, 0),
}


def rendered(name, *, roulette=False, seed=0, spp=1024, edge=64):
    """Return samples in memory; with Russian roulette from the first segment on, or without."""
    scene = load_scene(name)
    if roulette:
        integrator = {**scene.source["integrator"], "rr_depth": 1}
        scene = replace(scene, source={**scene.source, "integrator": integrator})
    size = (edge, edge)
    return chd.render(scene, spp=spp, size=size, seed=seed, backend="scalar", progress=False)


@pytest.mark.parametrize("name", SCENES)
def test_levels_of_renders_with_equal_means(as_benchmark, name):
    """Shares of p-values up to a, of pixels and of verdicts; none above a + .01 for pixels."""
    path = rendered(name)
    print(f"\n{name:34} spp" + "".join(f"{f'p<={a}':>10}" for a in LEVELS) + "   verdicts p<=.05")
    for kind, (roulette, seed) in KINDS.items():
        other = rendered(name, roulette=roulette, seed=seed)
        for spp in SPP:
            parts = [slice(i, i + spp) for i in range(0, min(1024, 16 * spp), spp)]
            found = [chd.contrast(path.isel(sample=s), other.isel(sample=s)) for s in parts]
            p = np.concatenate([f.p_value.to_numpy().ravel() for f in found])
            shares = (p[np.isfinite(p), np.newaxis] <= LEVELS).mean(axis=0)
            verdicts = sum(f.outcome == "differ" for f in found)
            line = "".join(f"{share:10.4f}" for share in shares)
            print(f"{kind:34}{spp:4}{line}   {verdicts} of {len(found)}", flush=True)
            assert (shares <= LEVELS + 0.01).all()


def _best(mean, variance, block, spp):
    """Return the smallest loss that is found in 90 % by the best weighted sum over a known block.

    Weights are the mean over the variance, each smoothed a little or not, or the mean's inverse.
    """
    from scipy.ndimage import uniform_filter

    weights = [np.ones_like(mean), 1 / np.maximum(uniform_filter(mean, 3), 1e-9)]
    for edge in (3, 7, 13):
        near = uniform_filter(variance, edge)
        weights.append(uniform_filter(mean, edge) / np.maximum(near, near[near > 0].min()))
    noisy = block & (variance > 0)  # a lamp without noise shows any loss
    ratios = [(w * mean)[noisy].sum() / np.sqrt((w**2 * variance)[noisy].sum()) for w in weights]
    return (1.96 + 1.2816) / max(ratios) / np.sqrt(spp)


@pytest.mark.parametrize("kind", ["other seed", "same seed"])
@pytest.mark.parametrize("spp", [64, 256])
def test_power_in_a_tenth_of_the_bathroom(as_benchmark, kind, spp):
    """A loss of twice the size that the best test of a known block finds in 90 %."""
    path = rendered("bathroom").read()
    other = (
        rendered("bathroom", roulette=True) if kind == "same seed" else rendered("bathroom", seed=5)
    ).read()
    light = [np.asarray(chd.Samples.from_array(x)).mean(axis=2) for x in (path, other)]
    mean, variance = light[0].mean(axis=-1), (light[1] - light[0]).var(axis=-1)
    rng, factors = np.random.default_rng(1), (1.0, 1.5, 2.0, 2.5)
    hits, trials = np.zeros(len(factors)), 40
    for trial in range(trials):
        y, x = rng.integers(0, 64 - 20, 2)
        block = np.zeros((64, 64), bool)
        block[y : y + 20, x : x + 20] = True
        i = trial % (1024 // spp)
        j = i if kind == "same seed" else (trial // 4) % (1024 // spp)
        a, b = path[..., i * spp : (i + 1) * spp], other[..., j * spp : (j + 1) * spp]
        for k, factor in enumerate(factors):
            loss = min(1, factor * _best(mean, variance, block, spp))
            dark = np.where(block[:, :, np.newaxis, np.newaxis], b * np.float32(1 - loss), b)
            hits[k] += chd.contrast(a, dark).outcome == "differ"
    print(f"\n{kind}, {spp} spp: found, by the size of the loss over that of the best test:")
    print("  ".join(f"{f}: {h / trials:.2f}" for f, h in zip(factors, hits, strict=True)))
    assert hits[2] >= 0.75 * trials


def test_time_against_that_of_rendering(as_benchmark):
    start = time.process_time()
    a = rendered("bathroom", spp=256, edge=128)
    render = time.process_time() - start
    b = rendered("bathroom", spp=256, edge=128, seed=1)
    start = time.process_time()
    chd.contrast(a, b)
    ours = time.process_time() - start
    print(f"\n128 x 128 x 256: contrast {ours:.2f} s, one render {render:.1f} s of processor time")
    assert ours < 0.1 * render
