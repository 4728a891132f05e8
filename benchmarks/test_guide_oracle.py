"""What a guide is worth at the first bounce, against the best that its bins could know.

``--benchmark-only -s`` prints, for each scene, the median over visible diffuse points of the
relative variance of indirect light, cosine sampling being 1: by the guide that is trained, and by a
brute-force guide of that point alone; and which share of the latter's gain the former reaches. Both
draw the same share of directions from the BSDF. The brute-force guide is the mean radiance in each
of 2304 strata of the hemisphere, smoothed by one of them, made of one half of 96 paths a stratum
and judged on the other, both ways. A failure: a guide that reaches less than half of the gain over
all scenes. CHDSTAT_GUIDED names other scenes, CHDSTAT_SIZE the edge of the image that sets the
number of training paths, CHDSTAT_POINTS the points; real scenes are found in CHDSTAT_SCENES.
"""

from __future__ import annotations

import os
from typing import Any

import drjit as dr
import numpy as np

import chdstat as chd
from benchmarks.test_guiding import named
from chdstat.rendering import guiding
from chdstat.rendering.backend import activate, resolve
from chdstat.rendering.rays import sensed

SCENES = "cornell-box caustic night-room veach-bidir/scene.xml white-room/scene_night.xml"
POINTS, EDGE = (
    int(os.environ.get(f"CHDSTAT_{name}", number))
    for name, number in (("POINTS", 16), ("SIZE", 256))
)
STRATA, PER = 48, 96


def visible(mi: Any, scene: Any, sensor: Any) -> tuple[Any, Any]:
    """Return positions and normals of random visible points on diffuse surfaces, (n, 3) each."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1000, 256 * POINTS)
    ray, _ = sensed(mi, mi.Point2f(sampler.next_2d()), sensor, sampler)
    si = scene.ray_intersect(mi.Ray3f(ray))
    bsdf, kinds = si.bsdf(), mi.BSDFFlags
    is_good = si.is_valid() & mi.has_flag(bsdf.flags(), kinds.DiffuseReflection)
    is_good &= ~mi.has_flag(bsdf.flags(), kinds.Glossy) & ~mi.has_flag(bsdf.flags(), kinds.Delta)
    is_good &= dr.max(bsdf.eval_diffuse_reflectance(si)) > 0.02
    good = np.flatnonzero(np.array(is_good))[:POINTS]
    normal = mi.Vector3f(si.sh_frame.n) * dr.sign(si.wi.z)
    return np.array(si.p).T[good], np.array(normal).T[good]


def paths_from(mi: Any, scene: Any, lookup: Any, i: int, p: Any, n: Any) -> tuple[Any, Any]:
    """Return indirect radiance and guide's density over the cosine's, shape (stratum, path)."""
    count = STRATA**2 * PER
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(7000 + i, count)
    stratum = dr.arange(mi.UInt32, count) // PER
    corner = mi.Point2f(mi.Float(stratum % STRATA), mi.Float(stratum // STRATA))
    w = mi.warp.square_to_cosine_hemisphere((corner + sampler.next_2d()) / STRATA)
    position, normal = (kind(*map(float, v)) for kind, v in ((mi.Point3f, p), (mi.Vector3f, n)))
    direction = mi.Frame3f(normal).to_world(w)
    ray = mi.Ray3f(position + normal * (1e-4 * (1 + float(np.abs(p).max()))), direction)
    first = scene.ray_intersect(ray)
    integrator = mi.load_dict({"type": "path"})
    light, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
    light = dr.mean(light - first.emitter(scene).eval(first))
    of = lookup.at(position, normal)
    ratio = lookup.density(of, direction) * np.pi / w.z
    light, ratio = (np.array(x, np.float64).reshape(-1, PER) for x in (light, ratio))
    return np.maximum(np.nan_to_num(light), 0), ratio


def smoothed(strata: Any) -> Any:
    padded = np.pad(strata.reshape(STRATA, STRATA), 1, mode="edge")
    square = sum(padded[i : i + STRATA, j : j + STRATA] for i in range(3) for j in range(3))
    return square.reshape(-1, 1) / square.mean()


def relative_variance(light: Any, ratio: Any, square: float) -> float:
    share = guiding._SHARE
    return ((light**2 / (share + (1 - share) * ratio)).mean() - square) / (
        (light**2).mean() - square
    )


def test_first_bounce(as_benchmark):
    print(f"\n{POINTS} points, training for {EDGE} x {EDGE}, {guiding._SHARE} by the BSDF")
    print(f"{'scene':28} cosine  guide  brute force  of its gain")
    reached = []
    for name, where in named(SCENES):
        with activate(resolve("llvm")) as mi:
            scene = chd.load_scene(where).load()
            sensor = scene.sensors()[0]
            plain = chd.load_scene(where).load()
            guide = guiding.trained(mi, scene, sensor, (EDGE, EDGE), [1, 2, 3])
            lookup, found = guiding.Lookup(mi, guide), []
            for i, (p, n) in enumerate(zip(*visible(mi, plain, sensor), strict=True)):
                light, ratio = paths_from(mi, plain, lookup, i, p, n)
                square, halves = light.mean() ** 2, (light[:, ::2], light[:, 1::2])
                brute = [
                    relative_variance(judged, smoothed(taught.mean(axis=1)), square)
                    for taught, judged in (halves, halves[::-1])
                ]
                found.append((relative_variance(light, ratio, square), np.mean(brute)))
        ours, brute = np.median(found, axis=0)
        reached.append((1 - ours) / (1 - brute))
        print(f"{name:28}{1:7.2f}{ours:7.2f}{brute:13.2f}{reached[-1]:13.0%}", flush=True)
    assert np.mean(reached) > 0.5
