"""A path tracer of planes and spheres: `draw(seed)` returns one sample of each pixel.

A square lamp and a grey sky light three balls in the corner of a room. Surfaces are diffuse or
mirrors. Vectors are arrays of shape (3, ray), and all rays go one bounce further at once.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.intp]

SIZE = 64
CAMERA, TARGET, ANGLE = (3.4, 1.7, 4.6), (1.05, 0.75, 0.9), 39.0
SKY = np.array([0.15, 0.17, 0.2])
LAMP = np.array([16.0, 14.0, 11.0])
CENTRE, HALF = np.array([1.3, 2.4, 1.4]), 0.4  # of the lamp, which shines up and down
FIRST = 2  # bounces before roulette
NEAR = 1e-6

# normal, offset, albedo; the last one is the plane of the lamp, which ends paths
PLANES = [
    ((0, 1, 0), 0.0, (0.7, 0.7, 0.7)),
    ((0, 0, 1), 0.0, (0.65, 0.65, 0.6)),
    ((1, 0, 0), 0.0, (0.65, 0.12, 0.1)),
    ((0, 1, 0), CENTRE[1], (0, 0, 0)),
]
# centre, radius, albedo, whether it is a mirror
SPHERES = [
    ((0.75, 0.5, 0.8), 0.5, (0.9, 0.9, 0.9), True),
    ((1.85, 0.4, 1.0), 0.4, (0.2, 0.5, 0.3), False),
    ((1.3, 0.25, 1.9), 0.25, (0.75, 0.6, 0.25), False),
]
LIGHT = len(PLANES) - 1
NORMALS = np.array([normal for normal, _, _ in PLANES], float)
OFFSETS = np.array([offset for _, offset, _ in PLANES])
CENTRES = np.array([centre for centre, *_ in SPHERES])
RADII = np.array([radius for _, radius, *_ in SPHERES])
ALBEDO = np.array([a for *_, a in PLANES] + [a for *_, a, _ in SPHERES], float).T
MIRROR = np.array([False for _ in PLANES] + [mirror for *_, mirror in SPHERES])


def draw(seed: int) -> Floats:
    """Return one sample of each pixel, linear radiance, shape (y, x, channel)."""
    rng = np.random.default_rng(seed)
    origin, direction = camera_rays(rng)
    return radiance(origin, direction, rng).T.reshape(SIZE, SIZE, 3)


def camera_rays(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return a ray through a random point of each pixel."""
    forward = unit(np.subtract(TARGET, CAMERA))
    right = unit(np.cross(forward, (0, 1, 0)))
    axes = np.stack([right, np.cross(right, forward), forward], axis=-1)
    y, x = np.mgrid[:SIZE, :SIZE].reshape(2, -1) + rng.random((2, SIZE * SIZE))
    film = np.stack([2 * x / SIZE - 1, 1 - 2 * y / SIZE, 0 * x + 1 / np.tan(np.radians(ANGLE / 2))])
    return np.broadcast_to(np.array(CAMERA)[:, None], film.shape), unit(axes @ film)


def radiance(origin: Floats, direction: Floats, rng: np.random.Generator) -> Floats:
    """Return the radiance of one path for each ray."""
    found, throughput = np.zeros(direction.shape), np.ones(direction.shape)
    ray = np.arange(direction.shape[1])  # the rays whose paths go on
    seen = np.full(ray.size, True)  # whether the lamp, if hit, was not sampled before
    bounce = 0
    while ray.size:
        distance, surface = intersect(origin, direction)
        away, lamp = np.isinf(distance), surface == LIGHT
        glow = away * SKY[:, None] + (lamp & seen) * LAMP[:, None]
        found[:, ray] += throughput * glow

        survives = np.ones(ray.size)
        if bounce >= FIRST:  # Russian roulette
            survives = np.minimum(throughput.max(axis=0), 0.95)
        on = np.flatnonzero(~away & ~lamp & (rng.random(ray.size) < survives))
        ray, surface, direction = ray[on], surface[on], direction.take(on, 1)
        origin = origin.take(on, 1) + distance[on] * direction
        throughput = throughput.take(on, 1) / survives[on] * ALBEDO.take(surface, 1)

        normal, mirror = normal_of(surface, origin), MIRROR[surface]
        found[:, ray] += ~mirror * throughput * sample_lamp(origin, normal, rng)
        reflected = direction - 2 * (normal * direction).sum(axis=0) * normal
        direction = np.where(mirror, reflected, sample_cosine(normal, rng))
        seen, bounce = mirror, bounce + 1
    return found


def sample_lamp(point: Floats, normal: Floats, rng: np.random.Generator) -> Floats:
    """Return what a white diffuse surface reflects of the lamp, from one random point of it."""
    x, z = HALF * (2 * rng.random((2, point.shape[1])) - 1)
    to = CENTRE[:, None] + np.stack([x, 0 * x, z]) - point
    squared = (to * to).sum(axis=0)
    direction = to / np.sqrt(squared)
    here = np.maximum((normal * direction).sum(axis=0), 0)  # cosine at the surface
    there = np.abs(direction[1])  # cosine at the lamp
    distance, surface = intersect(point, direction)
    visible = (surface == LIGHT) & (distance**2 < squared * (1 + NEAR))
    return visible * here * there / squared * (2 * HALF) ** 2 / np.pi * LAMP[:, None]


def sample_cosine(normal: Floats, rng: np.random.Generator) -> Floats:
    """Return directions about normals with density cosine / pi."""
    z, angle = 2 * rng.random(normal.shape[1]) - 1, 2 * np.pi * rng.random(normal.shape[1])
    r = np.sqrt(1 - z * z)
    return unit(normal + np.stack([r * np.cos(angle), r * np.sin(angle), z]))


def intersect(origin: Floats, direction: Floats) -> tuple[Floats, Numbers]:
    """Return the distance to the first surface of each ray, infinite without one, and which."""
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = (OFFSETS[:, None] - NORMALS @ origin) / (NORMALS @ direction)
        x, _, z = origin + planes[LIGHT] * direction - CENTRE[:, None]
        planes[LIGHT, np.maximum(np.abs(x), np.abs(z)) > HALF] = np.inf

        along = CENTRES @ direction - (origin * direction).sum(axis=0)
        apart = (CENTRES**2).sum(axis=1)[:, None] - 2 * CENTRES @ origin + (origin**2).sum(axis=0)
        root = np.sqrt(along**2 - apart + RADII[:, None] ** 2)  # NaN for a miss
        spheres = np.where(along - root > NEAR, along - root, along + root)

        distances = np.concatenate([planes, spheres])
        distances[~(distances > NEAR)] = np.inf
    surface = distances.argmin(axis=0)
    return distances[surface, np.arange(surface.size)], surface


def normal_of(surface: Numbers, point: Floats) -> Floats:
    """Return unit normals at points of surfaces."""
    ball = surface > LIGHT
    plane, sphere = np.where(ball, 0, surface), np.where(ball, surface - LIGHT - 1, 0)
    from_centre = (point - CENTRES.T.take(sphere, 1)) / RADII[sphere]
    return np.where(ball, from_centre, NORMALS.T.take(plane, 1))


def unit(v: Floats) -> Floats:
    """Return vectors with length 1."""
    return v / np.sqrt((v * v).sum(axis=0))
