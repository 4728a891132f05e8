"""Worlds in which a claim of the paper is true, or false, by construction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

import chdstat as chd
from chdstat.comparison import Interval
from chdstat.samples.tiles import FILM, Region
from chdstat.studies.claims import SceneData

Rng = np.random.Generator
Scenes = Sequence[SceneData]
World = Callable[[Rng, int], Scenes]
Draw = Callable[[Rng, tuple[int, ...]], np.ndarray]

EDGE = 12
WHITE = np.ones(3)
BROWN = np.array([0.8, 0.4, 0.2])


def given_first(world: Callable[..., Scenes]) -> Callable[..., World]:
    """Let the parameters of a world be given first: ``nulls(0.5)(rng, spp)``."""
    return lambda *parameters, **more: lambda rng, spp: world(rng, spp, *parameters, **more)


def image(light: np.ndarray, color: np.ndarray = WHITE) -> np.ndarray:
    """Give luminance (y, x, sample) a colour, (channel,) or (y, x, channel)."""
    return light[:, :, np.newaxis] * np.broadcast_to(color, (*light.shape[:2], 3))[..., np.newaxis]


def evidence(
    x: np.ndarray, *phenomena: str, name: str = "simulated", features=None, **more
) -> SceneData:
    """Cut an image (y, x, channel, sample) from left to right into regions."""
    edges = np.linspace(0, 1, len(phenomena) + 1)
    regions = tuple(
        Region(f"{phenomenon}", phenomenon, (float(left), 0.0, float(right), 1.0))
        for phenomenon, left, right in zip(phenomena, edges, edges[1:], strict=False)
    )
    return SceneData(name, chd.Samples.from_array(x, features=features), regions, **more)


def nulled(x: np.ndarray, share: float, rng: Rng) -> np.ndarray:
    return np.where(rng.random(x.shape) < share, 0, x)


def size(spp: int, edge: int = EDGE) -> tuple[int, int, int]:
    return edge, edge, spp


def seen(draw: Draw, *phenomena: str, color: np.ndarray = WHITE) -> World:
    """Return an image of draws of luminance, with one region or several side by side."""
    return lambda rng, spp: [evidence(image(draw(rng, size(spp)), color), *phenomena)]


@given_first
def parts(rng: Rng, spp: int, *named: tuple[str, Draw], color: np.ndarray = BROWN) -> Scenes:
    """Return regions side by side, each of draws of its own."""
    x = np.concatenate([draw(rng, size(spp)) for _, draw in named], axis=1)
    return [evidence(image(x, color), *(name for name, _ in named))]


# --- draws --------------------------------------------------------------------------------------


def gamma(shape: float) -> Draw:
    """Return a gamma distribution, whose logarithm has a skewness of about -shape**-0.5."""
    return lambda rng, size: rng.gamma(shape, size=size)


def lognormal(sigma: float, mean: float = 0.0) -> Draw:
    return lambda rng, shape: rng.lognormal(mean, sigma, shape)


def with_nulls(share: float, draw: Draw) -> Draw:
    return lambda rng, shape: nulled(draw(rng, shape), share, rng)


def sun(tail: float) -> Draw:
    """Return a narrow peak of most of the samples, and a wide one far below it."""
    return lambda rng, shape: np.where(
        rng.random(shape) < 0.3, rng.lognormal(-3, tail, shape), rng.lognormal(2, 0.1, shape)
    )


def mostly_null(sigma: float) -> Draw:
    return with_nulls(0.7, lognormal(sigma))


def leaning(scale: float) -> Draw:
    """Return radiance whose logarithms lean to the dark side."""
    return lambda rng, shape: np.exp(-rng.exponential(scale, shape))


def glowing_dust(rng: Rng, shape: tuple[int, ...]) -> np.ndarray:
    """Return three peaks over six decades, the highest and rarest of which is the widest."""
    peak = rng.choice(3, p=[0.75, 0.22, 0.03], size=shape)
    return 10.0 ** (np.choose(peak, [-2.0, -0.5, 4.0]) + 0.15 * rng.normal(size=shape))


def long_and_dark(rng: Rng, shape: tuple[int, ...]) -> np.ndarray:
    """Return a long tail with many nulls, and dark samples that skew logarithms downwards."""
    dark = rng.random(shape) < 0.25
    return nulled(rng.lognormal(np.where(dark, -4, 0), 1.0), 0.6, rng)


def two_peaks(rng: Rng, shape: tuple[int, ...]) -> np.ndarray:
    return rng.lognormal(np.where(rng.random(shape) < 0.5, -3, 3), 0.1)


HARD_EDGES: dict[str, Draw] = {
    "1 + exponential": lambda rng, shape: 1 + rng.exponential(size=shape),
    "1 + Pareto(2)": lambda rng, shape: 1 + rng.pareto(2, shape),
    "1 + Pareto(3)": lambda rng, shape: 1 + rng.pareto(3, shape),
    "exp(exponential)": lambda rng, shape: np.exp(rng.exponential(size=shape)),
    "log-triangular": lambda rng, shape: np.exp(4 * rng.triangular(0, 0.2, 1, shape)),
    "log-semicircle": lambda rng, shape: np.exp(4 * rng.beta(1.5, 1.5, shape)),
    "beta(5, 1)": lambda rng, shape: rng.beta(5, 1, shape),
}
"""Draws of one mode whose density starts or ends at once."""


# --- regions ------------------------------------------------------------------------------------


def nulls(share: float) -> World:
    return seen(with_nulls(share, gamma(2)), "indirect")


def glossy(sigma: float) -> World:
    """Return brown gloss beside plaster of log-normal radiance with a deviation of 0.5."""
    spread = np.where(np.arange(EDGE) < EDGE // 2, sigma, 0.5)[:, np.newaxis]
    return seen(lambda rng, s: rng.lognormal(0, spread, size=s), "glossy", "diffuse", color=BROWN)


def additive_gloss(rng, spp):
    color = 10 * BROWN[:, np.newaxis] + np.zeros((EDGE, EDGE, 3, 1))
    return [evidence(color + image(rng.gamma(2, size=size(spp))), "glossy", "diffuse")]


def reflection(*sigmas: float) -> World:
    """Return pixels whose log-normal radiance has one of the deviations, by chance."""

    def draw(rng, shape):
        sigma = rng.choice(sigmas, size=(EDGE, EDGE, 1))
        return rng.uniform(0.5, 2, size=(EDGE, EDGE, 1)) * rng.lognormal(0, sigma, shape)

    return seen(draw, "noisy-reflection")


def penumbra(follows: bool) -> World:
    """Return pixels that see the sun in a share of the samples: by position, or by chance."""

    def draw(rng, shape):
        share = np.broadcast_to(np.linspace(0.02, 0.98, EDGE), (EDGE, EDGE))
        if not follows:
            share = rng.permutation(share.ravel()).reshape(share.shape)
        lit = rng.random(shape) < share[..., np.newaxis]
        return np.where(lit, rng.lognormal(0, 0.2, shape), rng.lognormal(-3.5, 0.4, shape))

    return seen(draw, "penumbra")


def lit_across(draw: Draw) -> World:
    """Return a penumbra whose brightness varies by 25 across it, of draws of one mode or two."""
    scale = np.linspace(0.2, 5, EDGE)[:, np.newaxis]
    return seen(lambda rng, shape: scale * draw(rng, shape), "penumbra")


@given_first
def texture(
    rng: Rng,
    spp: int,
    color: np.ndarray = BROWN,
    *,
    sigma: float = 0.5,
    multiplies: bool = True,
    pair: float = 0,
) -> Scenes:
    """Return light times albedo, or with the albedo added to noise that does not know of it.

    The red channel has a deviation of its own. With a `pair`, a pale and a dark surface lie beside
    the texture, and that is the deviation of the dark one.
    """
    shape = (EDGE, 3 * EDGE if pair else EDGE, spp)
    albedo, light = (
        color * rng.uniform(0.2, 1, size=(*shape[:2], 1)),
        rng.lognormal(0, 0.5, shape),
    )
    if pair:
        albedo[:, EDGE : 2 * EDGE], albedo[:, 2 * EDGE :] = 0.8, 0.04
        light[:, 2 * EDGE :] **= pair / 0.5
    x = image(light, albedo) if multiplies else 5 * albedo[..., np.newaxis] + image(light)
    x[:, :, 0] **= sigma / 0.5
    shown = ("texture", *("albedo-contrast", "albedo-contrast") * bool(pair))
    return [evidence(x, *shown, features={"albedo": albedo.astype(np.float32)})]


@given_first
def bounces(
    rng: Rng, spp: int, sigmas: Sequence[float], color: np.ndarray = BROWN, low: float = -4
) -> Scenes:
    """Return two modes in each channel, with the deviations of the channels."""
    high = rng.random(size(spp))[:, :, np.newaxis] < 0.5
    wide = np.asarray(sigmas)[:, np.newaxis]
    x = rng.lognormal(np.where(high, 0, low), wide, (EDGE, EDGE, 3, spp))
    return [evidence(x * color[:, np.newaxis], "multi-bounce")]


# --- whole images -------------------------------------------------------------------------------


@given_first
def fireflies(
    rng: Rng,
    spp: int,
    rate: float = 1e-3,
    brightness: float = 1000,
    share: float = 1,
    edge: int = EDGE,
) -> Scenes:
    """Return CHDs of which a share of the pixels has samples that are so much brighter."""
    rare = rng.random(size(spp, edge)) < np.where(rng.random((edge, edge, 1)) < share, rate, 0)
    return [evidence(image(rng.gamma(2, size=rare.shape) * np.where(rare, brightness, 1)))]


ROWS = np.where(np.arange(EDGE) % 2, 8, 1)[:, np.newaxis, np.newaxis]
glints = seen(lambda rng, shape: ROWS * rng.gamma(2, size=shape))
"""Rows that are brighter than those between them, in every sample."""


@given_first
def neighbours(rng: Rng, spp: int, ordered: bool) -> Scenes:
    """Return two sides with a seam between, where every pixel sees both; or a jumble of them."""
    shape = (36, 13, spp)
    column = np.arange(13)
    share = np.select([column < 6, column == 6], [0, 0.5], 1) * np.ones((36, 1))
    if not ordered:
        share = rng.random((36, 13))
    right = rng.random(shape) < share[..., np.newaxis]
    sides = rng.lognormal(-3, 0.5, shape), nulled(rng.gamma(2, size=shape), 0.4, rng)
    return [evidence(image(np.where(right, sides[1], sides[0])))]


def moved_seam(rng, spp):
    """Return a seam whose CHD lies between those of both sides, and is none of them."""
    place = np.select([np.arange(13) < 6, np.arange(13) == 6], [-4.0, 0.0], 4.0)
    return [evidence(image(rng.lognormal(place[:, np.newaxis], 0.2, (36, 13, spp))))]


@given_first
def mirrored(rng: Rng, spp: int, factor: float) -> Scenes:
    """Return a symmetric view whose right half has a lower right quarter that is brighter."""
    x = rng.lognormal(0, 1, size(spp, 2 * EDGE))
    x[EDGE:, EDGE:] *= factor
    flat = np.ones((2 * EDGE, 2 * EDGE), dtype=np.float32)
    features = {"depth": flat, "albedo": np.repeat(flat[..., None] / 2, 3, axis=-1)}
    return [evidence(image(x), features=features)]


@given_first
def assumptions(rng: Rng, spp: int, kept: bool) -> Scenes:
    """Return two patches of long-tailed multiplicative noise, features that say nothing of them.

    Or a gentle slope with additive Gaussian noise of a variance that albedo knows.
    """
    steps = np.linspace(2, 4, 24) if kept else np.where(np.arange(24) < 12, 1.0, 30.0)
    mean, shape = steps * np.ones((24, 1)), (24, 24, spp)
    features = {name: rng.uniform(-1, 1, size=(24, 24, 3)) for name in ("albedo", "normal")}
    features["depth"] = rng.uniform(1, 2, size=(24, 24))
    x = mean[..., np.newaxis] * rng.lognormal(0, 1.8, shape)
    if kept:
        features["albedo"] = np.abs(features["albedo"])
        deviation = 0.05 + 0.3 * features["albedo"][..., :1]
        x = np.maximum(mean[..., np.newaxis] + deviation * rng.normal(size=shape), 0)
    small = {name: values.astype(np.float32) for name, values in features.items()}
    return [evidence(image(x), features=small)]


def families(draw: Draw) -> World:
    return lambda rng, spp: [evidence(image(draw(rng, (6, 6, spp))))]


# --- several renders or scenes ------------------------------------------------------------------


def rendered(rng: Rng, draw: Draw, shape: tuple[int, ...], seconds: float = 1.0) -> chd.Samples:
    """Return the render of a scalar backend, which took so long."""
    x = image(draw(rng, shape))
    return chd.Samples.from_array(x, backend="scalar", render_seconds=seconds)


@given_first
def path_lengths(rng: Rng, spp: int, short: float, long: float) -> Scenes:
    """Return log-normal radiance with these deviations."""
    x, y = (image(rng.lognormal(0, sigma, size(spp))) for sigma in (long, short))
    return [evidence(x, shorter=chd.Samples.from_array(y))]


@given_first
def cost(rng: Rng, spp: int, brighter: float, seconds: float) -> Scenes:
    bright = rendered(rng, lambda r, s: brighter * r.gamma(2, size=s), size(spp), seconds)
    return [SceneData("simulated", bright, shorter=rendered(rng, gamma(2), size(spp)))]


@given_first
def integrators(rng: Rng, spp: int, sigma: float, seconds: float) -> Scenes:
    """Return an image, and it by sampling BSDFs alone, of another deviation and time."""
    one = rendered(rng, lognormal(0.5), size(spp))
    two = rendered(rng, lognormal(sigma), size(spp), seconds)
    return [SceneData("simulated", one, integrators={"BSDF sampling alone": two})]


@given_first
def guided(rng: Rng, spp: int, draw: Draw, by_guide: Draw) -> Scenes:
    """Return an image, and it by a guide, of draws of luminance."""
    one, two = (image(d(rng, size(spp, 16))) for d in (draw, by_guide))
    return [evidence(one, guided=chd.Samples.from_array(two))]


@given_first
def adaptive(rng: Rng, spp: int, power: float) -> Scenes:
    """Return pixels with ever larger relative errors, and counts that follow a power of these."""
    sigma = np.geomspace(0.1, 1, 2 * EDGE) * np.ones((2 * EDGE, 1))
    shape = sigma[..., np.newaxis] ** -2
    x = image(rng.gamma(shape, 1 / shape, size(spp, 2 * EDGE)))
    counts = np.round(1000 * (sigma / sigma.max()) ** power).astype(int)
    other = rng.random((*sigma.shape, 1, counts.max()))
    uneven = chd.Samples.from_array(other, counts=counts)
    return [evidence(x, adaptive=uneven)]


@given_first
def complexity(rng: Rng, spp: int, sign: int) -> Scenes:
    """Return eight scenes of which ever more pixels have two modes, and their complexity."""
    found = []
    for i in range(8):
        several = np.arange(12).reshape(3, 4, 1) < 1.5 * i
        high = (rng.random((3, 4, spp)) < 0.5) & several
        x = chd.Samples.from_array(image(rng.lognormal(np.where(high, 3, 0), 0.3)))
        found.append(SceneData(f"scene {i}", x, complexity=sign * i))
    return found


def more_light(rng, spp):
    """Return five scenes of one CHD, of which ever fewer samples are null."""
    found = []
    for i, share in enumerate((0.85, 0.8, 0.7, 0.5, 0.0)):
        high = rng.random((16, 16, spp)) < 0.5
        x = nulled(rng.lognormal(np.where(high, 1.2, -1.2), 0.55), share, rng)
        found.append(replace(evidence(image(x), name=f"scene {i}"), complexity=float(i)))
    return found


@given_first
def scenes(rng: Rng, spp: int, *sigmas: float, other: float | None = None) -> Scenes:
    """Return one scene for each deviation, the first also by an integrator of another shape."""

    def one(sigma):
        return image(rng.lognormal(0, sigma, size(spp, 16)))

    integrator = chd.Samples.from_array(one(sigmas[-1] if other is None else other))
    return [
        evidence(one(s), name=f"scene {i}", integrator=integrator if i == 0 else None)
        for i, s in enumerate(sigmas)
    ]


@given_first
def sequences(rng: Rng, spp: int, covariance: float, *, length: int = 16) -> Scenes:
    """Return samples of which those of a sequence depend on each other.

    Their average lies nearer the mean than that of independent ones for a covariance below 0, and
    farther from it above; in between, they are independent.
    """
    shape = (24, 24, 16, length)
    own = rng.gamma(2, size=shape)
    if covariance < 0:
        order = rng.permuted(np.broadcast_to(np.arange(length), shape), axis=-1)
        own = -np.log1p(-(order + rng.random(shape)) / length)  # exponential, stratified
    if covariance > 0:
        own = own + np.sqrt(covariance) * rng.gamma(2, size=(*shape[:-1], 1))
    x = image(own.reshape(24, 24, -1))
    told: dict[str, Any] = {"sampler": "stratified", "sequence": length}
    scene = evidence(image(rng.gamma(2, size=(24, 24, spp))), "direct", "shadow")
    return [replace(scene, spread=chd.Samples.from_array(x, **told))]


# --- models -------------------------------------------------------------------------------------


@given_first
def learned(rng: Rng, spp: int, good: bool, who: str = "elek2019") -> Scenes:
    """Return a comparison with a model that keeps what the paper promises of it, or nothing."""
    n = 4 * spp  # many fireflies leave much noise to what judges
    x = rng.gamma(2, size=(32, 32, n)) * np.where(rng.random((32, 32, n)) < 2e-3, 300, 1)
    scene = evidence(image(x))
    found = chd.compare(scene.samples, ["mean", "median_of_means"], progress=False)
    measures = dict(found.measures)
    for name, share in (
        ("improved", 0.7 if good else 0.3),
        ("fireflies_left", 1.1 - 0.9 * good),
    ):
        value = np.full((2, 4), share)
        error = np.full((2, 4), 0.02)
        measures[name] = Interval(value, value - 0.04, value + 0.04, 0.95, error)
    estimates = found.estimates.copy()
    estimates[1] = (2 + 2e-3 * 2 * 299 if good else 8) * np.ones_like(estimates[1])
    iteration = np.arange(100, 10001, 100.0)
    gain = 1 - np.exp(-iteration / 300) if good else iteration / 1e4
    history = SimpleNamespace(
        iteration=iteration,
        validation_loss=2 - gain + rng.normal(0, 0.01, len(iteration)),
        validation_baseline=np.full(len(iteration), 2.0),
    )
    comparison = replace(
        found,
        estimators=("mean", who),
        measures=measures,
        estimates=estimates,
        models={who: SimpleNamespace(history=history)},
    )
    return [replace(scene, comparison=comparison)]


@given_first
def reduced(rng: Rng, spp: int, power: float) -> Scenes:
    """Return a comparison with a model that says the mean to a power, which 1 leaves as it is."""
    scene = evidence(image(rng.gamma(2, size=size(spp))))
    found = chd.compare(scene.samples, ["mean"], progress=False)
    model = SimpleNamespace(predict=lambda x: np.asarray(x.mean(axis=-1)) ** power)
    models = {"elek2019": model}
    comparison = replace(found, estimators=("mean", *models), models=models)
    return [replace(scene, comparison=comparison)]


@given_first
def held(rng: Rng, spp: int, bias: float) -> Scenes:
    """Return a model that takes a quarter of the error off the mean, and adds a bias to it.

    Of guided samples, which vary less, the bias is more of the error.
    """
    x, y = (image(d(rng, size(spp, 24))) for d in (gamma(0.2), gamma(5)))
    scene = evidence(25 * x, guided=chd.Samples.from_array(y))
    found = chd.compare(scene.samples, ["mean"], progress=False)
    model = SimpleNamespace(
        predict=lambda x: 0.5 * np.asarray(x).mean(axis=-1) + 0.5 * 5 + bias,
        train_shape=(0, 0),
    )
    models = {"elek2019": model}
    comparison = replace(found, estimators=("mean", *models), models=models)
    return [replace(scene, comparison=comparison)]


@given_first
def edges(rng: Rng, spp: int, height: float) -> Scenes:
    """Return gamma noise of variance 1 and, through each pixel, an edge as high as this."""
    x, places = rng.gamma(1.0, size=size(spp)), rng.random((EDGE, EDGE, 2, spp))
    film = chd.Samples.from_array(places)
    x += height * (places[:, :, 0] > 0.5)
    return [SceneData("simulated", chd.Samples(image(x), attrs={}, parts={FILM: film}))]


WORLDS: dict[int, tuple[World, World]] = {
    1: (nulls(0.6), nulls(0.2)),
    2: (seen(gamma(8), "diffuse"), seen(gamma(1), "diffuse")),
    3: (glossy(0.5), glossy(1.5)),
    4: (reflection(1.2), reflection(0.5, 2.5)),
    5: (seen(long_and_dark, "indirect"), seen(gamma(2), "indirect")),
    6: (penumbra(True), penumbra(False)),
    7: (texture(), texture(multiplies=False)),
    8: (fireflies(), glints),
    9: (path_lengths(0.5, 1.0), path_lengths(1.0, 0.5)),
    10: (neighbours(True), neighbours(False)),
    11: (complexity(1), complexity(-1)),
    12: (scenes(0.4, 1.5), scenes(0.8, 0.8)),
    13: (assumptions(False), assumptions(True)),
    14: (families(gamma(2)), families(lognormal(0.8))),
    15: (learned(True), learned(False)),
    16: (reduced(1), reduced(0.99)),
    17: (sequences(-1), sequences(0.5)),
    18: (parts(("direct", glowing_dust)), parts(("direct", lognormal(0.5)), color=WHITE)),
    19: (
        parts(("direct", lognormal(1.6)), *((n, mostly_null(1.5)) for n in ("indirect", "shadow"))),
        parts(("direct", mostly_null(0.5)), *((n, lognormal(0.5)) for n in ("indirect", "shadow"))),
    ),
    20: (
        parts(("diffuse", lognormal(1)), ("direct", sun(0.5))),
        parts(("diffuse", sun(0.5)), ("direct", lognormal(1))),
    ),
    21: (
        parts(("indirect", lognormal(1)), ("indirect", lognormal(1, 2)), ("direct", sun(0.2))),
        parts(("indirect", lognormal(0.5)), ("indirect", lognormal(1)), ("direct", lognormal(2))),
    ),
    22: (
        parts(("shadow", leaning(2)), ("direct", lognormal(0.5))),
        parts(("shadow", lognormal(0.5)), ("direct", leaning(2))),
    ),
    23: (bounces((0.5, 0.5, 0.5)), bounces((0.5, 0.5, 1.5), WHITE, low=0)),
    24: (
        parts(("virtual-source", leaning(3)), *((n, lognormal(2)) for n in ("indirect", "shadow"))),
        parts(("virtual-source", mostly_null(0.5)), ("indirect", lognormal(0.5))),
    ),
    25: (
        parts(("fireplace", glowing_dust), ("diffuse", lognormal(0.5))),
        parts(("fireplace", lognormal(0.5)), ("diffuse", glowing_dust)),
    ),
    26: (parts(("indirect", glowing_dust)), parts(("indirect", lognormal(0.5)))),
    27: (mirrored(3), mirrored(1)),
    28: (cost(1.5, 2), cost(1, 0.5)),
    29: (integrators(1.0, 1.0), integrators(0.5, 0.25)),
    30: (guided(mostly_null(1.5), lognormal(0.5)), guided(lognormal(0.5), mostly_null(1.5))),
    31: (guided(lognormal(1.0), lognormal(0.7)), guided(lognormal(0.7), lognormal(1.0))),
    32: (held(0), held(0.3)),
    33: (adaptive(0.5), adaptive(-0.5)),
    34: (edges(0.45), edges(1.4)),
}
"""By number of the claim: a world in which it is true, and one in which it is false."""
TRUE, FALSE = ({number: pair[i] for number, pair in WORLDS.items()} for i in (0, 1))

FALSE_PARTS: dict[int, tuple[str, ...]] = {
    5: ("quantile", "kurtosis"),
    6: ("rank correlation",),
    7: ("slope",),
    8: ("distance",),
    9: ("support", "tail", "skewness", "variance"),
    10: ("neighbours",),
    13: ("slope", "skewness", "steps", "features"),
    15: ("improved", "fireflies", "gain", "denoised"),
    18: ("multimodal", "median", "channels"),
    19: ("noise", "1 % and", "median to"),
    20: ("fullest", "median"),
    21: ("largest", "deviation"),
    22: ("skewness", "deviation"),
    23: ("multimodal", "shapes of channels"),
    24: ("tail", "deviation"),
    25: ("modes less", "multimodal"),
    26: ("linear bin", "multimodal"),
    27: ("mirrored",),
    28: ("radiance", "time"),
    29: ("largest", "Gaussian"),
    30: ("nulls", "tail index"),
    31: ("Gaussian",),
    32: ("error",),
    33: ("spread",),
    34: ("image", "median"),
}
"""By words of their names, the parts of a claim that are false in the world where it is."""
PEAKS = seen(two_peaks, "diffuse")
REFUTED: tuple[tuple[int, tuple[str, ...], World], ...] = (
    *((number, words, FALSE[number]) for number, words in FALSE_PARTS.items()),
    (1, ("share of nulls",), nulls(0.9)),
    (2, ("to a Gaussian", "to a gamma"), PEAKS),
    (2, ("mode over mean",), seen(lambda rng, s: 1 - rng.beta(1, 4, s) / 2, "diffuse")),
    (3, ("shift between channels",), seen(lognormal(0.5), "glossy", "diffuse")),
    (3, ("slope",), additive_gloss),
    (4, ("deviation over mean",), reflection(0.3)),
    (5, ("skewness",), seen(lambda rng, s: np.exp(rng.gamma(1, 0.6, s)), "indirect")),
    (5, ("share of nulls",), seen(lognormal(1.2), "indirect")),
    (6, ("bimodal",), seen(gamma(2), "penumbra")),
    (7, ("shift between channels",), texture(WHITE)),
    (7, ("shapes of channels",), texture(sigma=1.5)),
    (7, ("dark and pale",), texture(pair=1.5)),
    (8, ("mean radiance",), fireflies(0.05, 80, share=0.05, edge=24)),  # the mean is 4.95 times
    (8, ("mean radiance",), fireflies(1, 12, share=0.05, edge=24)),
    (10, ("blend",), moved_seam),
    (12, ("integrators",), scenes(0.4, 1.5, other=0.4)),
    (23, ("shift",), bounces((0.5, 0.5, 0.5), WHITE)),
)
"""Claim, parts of it by words of their names, and a world in which these are false."""
