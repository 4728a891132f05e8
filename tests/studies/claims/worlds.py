"""Worlds in which a claim of the paper is true, or false, by construction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import xarray as xr

import chdstat as chd
from chdstat.comparison import Interval
from chdstat.rendering.recipes import Region
from chdstat.studies.claims import SceneData

World = Callable[[np.random.Generator, int], Sequence[SceneData]]

EDGE = 12
WHITE = np.ones(3)
BROWN = np.array([0.8, 0.4, 0.2])


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


def nulled(x: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(x.shape) < share, 0, x)


def size(spp: int, edge: int = EDGE) -> tuple[int, int, int]:
    return edge, edge, spp


# --- 1 to 5 -------------------------------------------------------------------------------------


def nulls(share: float) -> World:
    def world(rng, spp):
        return [evidence(image(nulled(rng.gamma(2, size=size(spp)), share, rng)), "indirect")]

    return world


def diffuse(shape: float) -> World:
    """Return a gamma distribution, whose logarithm has a skewness of about -shape**-0.5."""

    def world(rng, spp):
        return [evidence(image(rng.gamma(shape, size=size(spp))), "diffuse")]

    return world


def glossy(sigma: float) -> World:
    """Return brown gloss beside plaster of log-normal radiance with a deviation of 0.5."""

    def world(rng, spp):
        spread = np.where(np.arange(EDGE) < EDGE // 2, sigma, 0.5)[:, np.newaxis]
        x = image(rng.lognormal(0, spread, size=size(spp)), BROWN)
        return [evidence(x, "glossy", "diffuse")]

    return world


def reflection(*sigmas: float) -> World:
    """Return pixels whose log-normal radiance has one of the deviations, by chance."""

    def world(rng, spp):
        sigma = rng.choice(sigmas, size=(EDGE, EDGE, 1))
        bright = rng.uniform(0.5, 2, size=(EDGE, EDGE, 1))
        return [evidence(image(bright * rng.lognormal(0, sigma, size(spp))), "noisy-reflection")]

    return world


def indirect(rng, spp):
    """Return a long tail with many nulls, and dark samples that skew logarithms downwards."""
    dark = rng.random(size(spp)) < 0.25
    x = rng.lognormal(np.where(dark, -4, 0), 1.0)
    return [evidence(image(nulled(x, 0.6, rng)), "indirect")]


def bright(rng, spp):
    """Return a short tail, which starts slowly, without nulls."""
    return [evidence(image(rng.gamma(2, size=size(spp))), "indirect")]


# --- 6 to 10 ------------------------------------------------------------------------------------


def penumbra(follows: bool) -> World:
    """Return pixels that see the sun in a share of the samples: by position, or by chance."""

    def world(rng, spp):
        share = np.broadcast_to(np.linspace(0.02, 0.98, EDGE), (EDGE, EDGE))
        if not follows:
            share = rng.permutation(share.ravel()).reshape(share.shape)
        lit = rng.random(size(spp)) < share[..., np.newaxis]
        x = np.where(lit, rng.lognormal(0, 0.2, size(spp)), rng.lognormal(-3.5, 0.4, size(spp)))
        return [evidence(image(x), "penumbra")]

    return world


def lit_across(draw: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]) -> World:
    """Return a penumbra whose brightness varies by 25 across it, of draws of one mode or two."""

    def world(rng, spp):
        scale = np.linspace(0.2, 5, EDGE)[:, np.newaxis]
        return [evidence(image(scale * draw(rng, size(spp))), "penumbra")]

    return world


HARD_EDGES: dict[str, Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]] = {
    "1 + exponential": lambda rng, shape: 1 + rng.exponential(size=shape),
    "1 + Pareto(2)": lambda rng, shape: 1 + rng.pareto(2, shape),
    "1 + Pareto(3)": lambda rng, shape: 1 + rng.pareto(3, shape),
    "exp(exponential)": lambda rng, shape: np.exp(rng.exponential(size=shape)),
    "log-triangular": lambda rng, shape: np.exp(4 * rng.triangular(0, 0.2, 1, shape)),
    "log-semicircle": lambda rng, shape: np.exp(4 * rng.beta(1.5, 1.5, shape)),
    "beta(5, 1)": lambda rng, shape: rng.beta(5, 1, shape),
}
"""Draws of one mode whose density starts or ends at once."""


def texture(multiplies: bool) -> World:
    """Return light times albedo, or with the albedo added to noise that does not know of it."""

    def world(rng, spp):
        albedo = BROWN * rng.uniform(0.2, 1, size=(EDGE, EDGE, 1))
        light = rng.gamma(2, size=size(spp))
        x = image(light, albedo) if multiplies else 5 * albedo[..., np.newaxis] + image(light)
        return [evidence(x, "texture", features={"albedo": albedo.astype(np.float32)})]

    return world


def fireflies(
    rate: float = 1e-3, brightness: float = 1000, share: float = 1, edge: int = EDGE
) -> World:
    """Return CHDs of which a share of the pixels has samples that are so much brighter."""

    def world(rng, spp):
        rare = rng.random(size(spp, edge)) < np.where(rng.random((edge, edge, 1)) < share, rate, 0)
        return [evidence(image(rng.gamma(2, size=rare.shape) * np.where(rare, brightness, 1)))]

    return world


def glints(rng, spp):
    """Return rows that are brighter than those between them, in every sample."""
    row = np.where(np.arange(EDGE) % 2, 8, 1)[:, np.newaxis, np.newaxis]
    return [evidence(image(rng.gamma(2, size=size(spp)) * row))]


def path_lengths(short: float, long: float) -> World:
    """Return log-normal radiance with these deviations."""

    def world(rng, spp):
        x, y = (image(rng.lognormal(0, sigma, size(spp))) for sigma in (long, short))
        return [evidence(x, shorter=chd.Samples.from_array(y))]

    return world


def neighbours(ordered: bool) -> World:
    """Return two sides with a seam between, where every pixel sees both; or a jumble of them."""

    def world(rng, spp):
        shape = (36, 13, spp)
        column = np.arange(13)
        share = np.select([column < 6, column == 6], [0, 0.5], 1) * np.ones((36, 1))
        if not ordered:
            share = rng.random((36, 13))
        right = rng.random(shape) < share[..., np.newaxis]
        sides = rng.lognormal(-3, 0.5, shape), nulled(rng.gamma(2, size=shape), 0.4, rng)
        return [evidence(image(np.where(right, sides[1], sides[0])))]

    return world


# --- 11 to 15 -----------------------------------------------------------------------------------


def complexity(sign: int) -> World:
    """Return eight scenes of which ever more pixels have two modes, and their complexity."""

    def world(rng, spp):
        found = []
        for i in range(8):
            several = np.arange(12).reshape(3, 4, 1) < 1.5 * i
            high = (rng.random((3, 4, spp)) < 0.5) & several
            x = chd.Samples.from_array(image(rng.lognormal(np.where(high, 3, 0), 0.3)))
            found.append(SceneData(f"scene {i}", x, complexity=sign * i))
        return found

    return world


def more_light(rng, spp):
    """Return five scenes of one CHD, of which ever fewer samples are null."""
    found = []
    for i, share in enumerate((0.85, 0.8, 0.7, 0.5, 0.0)):
        high = rng.random((16, 16, spp)) < 0.5
        x = nulled(rng.lognormal(np.where(high, 1.2, -1.2), 0.55), share, rng)
        found.append(replace(evidence(image(x), name=f"scene {i}"), complexity=float(i)))
    return found


def scenes(*sigmas: float) -> World:
    """Return one scene for each deviation, the first also by an integrator of another shape."""

    def world(rng, spp):
        def one(sigma):
            return image(rng.lognormal(0, sigma, size(spp, 16)))

        other = chd.Samples.from_array(one(sigmas[-1]))
        return [
            evidence(one(s), name=f"scene {i}", integrator=other if i == 0 else None)
            for i, s in enumerate(sigmas)
        ]

    return world


def _features(rng, mean):
    features = {
        "albedo": rng.uniform(size=(*mean.shape, 3)),
        "normal": rng.normal(size=(*mean.shape, 3)),
        "depth": rng.uniform(1, 2, size=mean.shape),
    }
    return {name: values.astype(np.float32) for name, values in features.items()}


def broken_assumptions(rng, spp):
    """Return two patches of long-tailed multiplicative noise, features that say nothing of them."""
    mean = np.where(np.arange(24) < 12, 1.0, 30.0) * np.ones((24, 1))
    x = mean[..., np.newaxis] * rng.lognormal(0, 1.8, (24, 24, spp))
    return [evidence(image(x), features=_features(rng, mean))]


def kept_assumptions(rng, spp):
    """Return a gentle slope with additive Gaussian noise of a variance that albedo knows."""
    mean = np.linspace(2, 4, 24) * np.ones((24, 1))
    features = _features(rng, mean)
    deviation = 0.05 + 0.3 * features["albedo"][..., :1]
    x = np.maximum(mean[..., np.newaxis] + deviation * rng.normal(size=(24, 24, spp)), 0)
    return [evidence(image(x), features=features)]


def families(draw: str, *parameters: float) -> World:
    def world(rng, spp):
        return [evidence(image(getattr(rng, draw)(*parameters, size=(6, 6, spp))))]

    return world


def family_shares(*shares: float) -> World:
    """Return an analysis whose best families are drawn with these shares, gamma the first."""
    names = list(chd.fit.FAMILIES)
    flags = {"flag_values": np.arange(len(names)), "flag_meanings": " ".join(names)}

    def world(rng, spp):
        best = rng.choice(len(shares), p=shares, size=(24, 24, 1))
        given = xr.Dataset(
            {
                "best_family": (("y", "x", "channel"), best, flags),
                "gamma_like": (("y", "x"), np.zeros((24, 24), bool)),
            }
        )
        samples = chd.Samples.from_array(np.ones((24, 24, 1, spp)))
        return [SceneData("simulated", samples, given=given)]

    return world


def learned(good: bool, who: str = "elek2019") -> World:
    """Return a comparison with a model that keeps what the paper promises of it, or nothing."""

    def world(rng, spp):
        x = rng.gamma(2, size=(32, 32, spp)) * np.where(rng.random((32, 32, spp)) < 2e-3, 300, 1)
        scene = evidence(image(x))
        found = chd.compare(scene.samples, ["mean", "median_of_means"], progress=False)
        means = {"improved": (0.7, 0.3), "fireflies_left": (0.2, 1.1)}
        measures = dict(found.measures)
        for name, values in means.items():
            value = np.full((2, 4), values[0] if good else values[1])
            measures[name] = Interval(
                value, value - 0.04, value + 0.04, 0.95, np.full((2, 4), 0.02)
            )
        estimates = found.estimates.copy()
        estimates[1] = (2.6 if good else 8) * np.ones_like(estimates[1])
        model = SimpleNamespace(history=_history(rng, good))
        comparison = replace(
            found,
            estimators=("mean", who),
            measures=measures,
            over_batches=measures,
            estimates=estimates,
            models={who: model},
        )
        return [replace(scene, comparison=comparison)]

    return world


def _history(rng, good):
    iteration = np.arange(100, 10001, 100.0)
    gain = 1 - np.exp(-iteration / 300) if good else iteration / 1e4
    loss = 2 - gain + rng.normal(0, 0.01, len(iteration))
    return SimpleNamespace(
        iteration=iteration, validation_loss=loss, validation_baseline=np.full(len(loss), 2.0)
    )


def reduced(power: float) -> World:
    """Return a comparison with a model that says the mean to a power, which 1 leaves as it is."""

    def world(rng, spp):
        scene = evidence(image(rng.gamma(2, size=size(spp))))
        found = chd.compare(scene.samples, ["mean"], progress=False)
        model = SimpleNamespace(predict=lambda x: np.asarray(x.mean(axis=-1)) ** power)
        models = {"elek2019": model}
        comparison = replace(found, estimators=("mean", *models), models=models)
        return [replace(scene, comparison=comparison)]

    return world


def sequences(covariance: float, *, length: int = 16) -> World:
    """Return samples of which those of a sequence depend on each other.

    Their average lies nearer the mean than that of independent ones for a covariance below 0, and
    farther from it above; in between, they are independent.
    """

    def world(rng, spp):
        shape = (24, 24, 16, length)
        own = rng.gamma(2, size=shape)
        if covariance < 0:
            order = rng.permuted(np.broadcast_to(np.arange(length), shape), axis=-1)
            own = -np.log1p(-(order + rng.random(shape)) / length)  # exponential, stratified
        if covariance > 0:
            own = own + np.sqrt(covariance) * rng.gamma(2, size=(*shape[:-1], 1))
        x = image(own.reshape(24, 24, -1))
        told = {"sampler": "stratified", "sequence": length}
        scene = evidence(image(rng.gamma(2, size=(24, 24, spp))), "direct", "shadow")
        return [replace(scene, spread=chd.Samples.from_array(x, **told))]

    return world


# --- 18 to 28 -----------------------------------------------------------------------------------


def parts(*named: tuple[str, Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]],
          color: np.ndarray = BROWN) -> World:  # fmt: skip
    """Return regions side by side, each of draws of its own."""

    def world(rng, spp):
        x = np.concatenate([draw(rng, size(spp)) for _, draw in named], axis=1)
        return [evidence(image(x, color), *(name for name, _ in named))]

    return world


def lognormal(sigma: float, mean: float = 0.0):
    return lambda rng, shape: rng.lognormal(mean, sigma, shape)


def sun(tail: float, rest: float = 0.3):
    """Return a narrow peak of most of the samples, and a wide one far below it."""
    return lambda rng, shape: np.where(
        rng.random(shape) < rest, rng.lognormal(-3, tail, shape), rng.lognormal(2, 0.1, shape)
    )


def mostly_null(sigma: float):
    return lambda rng, shape: nulled(rng.lognormal(0, sigma, shape), 0.7, rng)


def leaning(scale: float):
    """Return radiance whose logarithms lean to the dark side."""
    return lambda rng, shape: np.exp(-rng.exponential(scale, shape))


def glowing_dust(rng, shape):
    """Return three peaks over six decades, the highest and rarest of which is the widest."""
    peak = rng.choice(3, p=[0.75, 0.22, 0.03], size=shape)
    return 10.0 ** (np.choose(peak, [-2.0, -0.5, 4.0]) + 0.15 * rng.normal(size=shape))


def bounces(sigmas: Sequence[float], color: np.ndarray = BROWN, low: float = -4) -> World:
    """Return two modes in each channel, with the deviations of the channels."""

    def world(rng, spp):
        high = rng.random(size(spp))[:, :, np.newaxis] < 0.5
        wide = np.asarray(sigmas)[:, np.newaxis]
        x = rng.lognormal(np.where(high, 0, low), wide, (EDGE, EDGE, 3, spp))
        return [evidence(x * color[:, np.newaxis], "multi-bounce")]

    return world


def mirrored(factor: float) -> World:
    """Return a symmetric view whose right half has a lower right quarter that is brighter."""

    def world(rng, spp):
        x = rng.lognormal(0, 1, size(spp, 2 * EDGE))
        x[EDGE:, EDGE:] *= factor
        flat = np.ones((2 * EDGE, 2 * EDGE), dtype=np.float32)
        features = {"depth": flat, "albedo": np.repeat(flat[..., None] / 2, 3, axis=-1)}
        return [evidence(image(x), features=features)]

    return world


def cost(brighter: float, seconds: float) -> World:
    def world(rng, spp):
        long, short = (
            chd.Samples.from_array(
                image(scale * rng.gamma(2, size=size(spp))), backend="scalar", render_seconds=s
            )
            for scale, s in ((brighter, seconds), (1, 1.0))
        )
        return [SceneData("simulated", long, shorter=short)]

    return world


def integrators(sigma: float, seconds: float) -> World:
    """Return an image, and it by sampling BSDFs alone, of another deviation and time."""

    def world(rng, spp):
        one, two = (
            chd.Samples.from_array(
                image(rng.lognormal(0, s, size(spp))), backend="scalar", render_seconds=time
            )
            for s, time in ((0.5, 1.0), (sigma, seconds))
        )
        return [SceneData("simulated", one, integrators={"BSDF sampling alone": two})]

    return world


TRUE: dict[int, World] = {
    1: nulls(0.6),
    2: diffuse(8),
    3: glossy(0.5),
    4: reflection(1.2),
    5: indirect,
    6: penumbra(True),
    7: texture(True),
    8: fireflies(),
    9: path_lengths(0.5, 1.0),
    10: neighbours(True),
    11: complexity(1),
    12: scenes(0.4, 1.5),
    13: broken_assumptions,
    14: families("gamma", 2),
    15: learned(True),
    16: reduced(1),
    17: sequences(-1),
    18: parts(("direct", glowing_dust)),
    19: parts(
        ("direct", lognormal(1.6)), ("indirect", mostly_null(1.5)), ("shadow", mostly_null(1.5))
    ),
    20: parts(("diffuse", lognormal(1)), ("direct", sun(0.5))),
    21: parts(("indirect", lognormal(1)), ("indirect", lognormal(1, 2)), ("direct", sun(0.2))),
    22: parts(("shadow", leaning(2)), ("direct", lognormal(0.5))),
    23: bounces((0.5, 0.5, 0.5)),
    24: parts(("virtual-source", leaning(3)), ("indirect", lognormal(2)), ("shadow", lognormal(2))),
    25: parts(("fireplace", glowing_dust), ("diffuse", lognormal(0.5))),
    26: parts(("indirect", glowing_dust)),
    27: mirrored(3),
    28: cost(1.5, 2),
    29: integrators(1.0, 1.0),
}
FALSE: dict[int, World] = {
    1: nulls(0.2),
    2: diffuse(1),
    3: glossy(1.5),
    4: reflection(0.5, 2.5),
    5: bright,
    6: penumbra(False),
    7: texture(False),
    8: glints,
    9: path_lengths(1.0, 0.5),
    10: neighbours(False),
    11: complexity(-1),
    12: scenes(0.8, 0.8),
    13: kept_assumptions,
    14: families("lognormal", 0, 0.8),
    15: learned(False),
    16: reduced(0.99),
    17: sequences(0.5),
    18: parts(("direct", lognormal(0.5)), color=WHITE),
    19: parts(
        ("direct", mostly_null(0.5)), ("indirect", lognormal(0.5)), ("shadow", lognormal(0.5))
    ),
    20: parts(("diffuse", sun(0.5)), ("direct", lognormal(1))),
    21: parts(("indirect", lognormal(0.5)), ("indirect", lognormal(1)), ("direct", lognormal(2))),
    22: parts(("shadow", lognormal(0.5)), ("direct", leaning(2))),
    23: bounces((0.5, 0.5, 1.5), WHITE, low=0),
    24: parts(("virtual-source", mostly_null(0.5)), ("indirect", lognormal(0.5))),
    25: parts(("fireplace", lognormal(0.5)), ("diffuse", glowing_dust)),
    26: parts(("indirect", lognormal(0.5))),
    27: mirrored(1),
    28: cost(1, 0.5),
    29: integrators(0.5, 0.25),
}

# --- one part false at a time -------------------------------------------------------------------


def diffuse_of(draw: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]) -> World:
    def world(rng, spp):
        return [evidence(image(draw(rng, size(spp))), "diffuse")]

    return world


def two_peaks(rng, shape):
    return rng.lognormal(np.where(rng.random(shape) < 0.5, -3, 3), 0.1)


def leaning_left(rng, shape):
    return 1 - rng.beta(1, 4, shape) / 2


def gray_gloss(rng, spp):
    return [evidence(image(rng.lognormal(0, 0.5, size(spp))), "glossy", "diffuse")]


def additive_gloss(rng, spp):
    color = 10 * BROWN[:, np.newaxis] + np.zeros((EDGE, EDGE, 3, 1))
    return [evidence(color + image(rng.gamma(2, size=size(spp))), "glossy", "diffuse")]


def lit_indirect(skewed: bool) -> World:
    """Return a long tail without nulls, or one whose logarithms lean upwards."""

    def world(rng, spp):
        x = np.exp(rng.gamma(1, 0.6, size(spp))) if skewed else rng.lognormal(0, 1.2, size(spp))
        return [evidence(image(x), "indirect")]

    return world


def one_mode(rng, spp):
    return [evidence(image(rng.gamma(2, size=size(spp))), "penumbra")]


def other_texture(color: np.ndarray, sigma: float) -> World:
    """Return a texture of grey, or one whose red channel has a shape of its own."""

    def world(rng, spp):
        albedo = color * rng.uniform(0.2, 1, size=(EDGE, EDGE, 1))
        x = image(rng.lognormal(0, 0.5, size(spp)), albedo)
        x[:, :, 0] **= sigma / 0.5
        return [evidence(x, "texture", features={"albedo": albedo.astype(np.float32)})]

    return world


def pair(sigma: float) -> World:
    """Return a texture, and beside it a pale and a dark surface, of which that has a spread."""

    def world(rng, spp):
        albedo = BROWN * rng.uniform(0.2, 1, size=(EDGE, 3 * EDGE, 1))
        albedo[:, EDGE : 2 * EDGE] = 0.8
        albedo[:, 2 * EDGE :] = 0.04
        light = rng.lognormal(0, 0.5, (EDGE, 3 * EDGE, spp))
        light[:, 2 * EDGE :] **= sigma / 0.5
        shown = "texture", "albedo-contrast", "albedo-contrast"
        features = {"albedo": albedo.astype(np.float32)}
        return [evidence(image(light, albedo), *shown, features=features)]

    return world


def moved_seam(rng, spp):
    """Return a seam whose CHD lies between those of both sides, and is none of them."""
    shape = (36, 13, spp)
    place = np.select([np.arange(13) < 6, np.arange(13) == 6], [-4.0, 0.0], 4.0)
    return [evidence(image(rng.lognormal(place[:, np.newaxis], 0.2, shape)))]


def same_integrator(rng, spp):
    return [
        evidence(image(rng.lognormal(0, s, size(spp, 16))), name=f"scene {s}", integrator=other)
        for s, other in (
            (0.4, chd.Samples.from_array(image(rng.lognormal(0, 0.4, size(spp, 16))))),
            (1.5, None),
        )
    ]


REFUTED: list[tuple[int, str, World]] = [
    (1, "share of nulls", nulls(0.9)),
    (2, "to a Gaussian", diffuse_of(two_peaks)),
    (2, "to a gamma", diffuse_of(two_peaks)),
    (2, "mode over mean", diffuse_of(leaning_left)),
    (3, "shift between channels", gray_gloss),
    (3, "slope", additive_gloss),
    (4, "deviation over mean", reflection(0.3)),
    (5, "quantile", bright),
    (5, "kurtosis", bright),
    (5, "skewness", lit_indirect(True)),
    (5, "share of nulls", lit_indirect(False)),
    (6, "bimodal", one_mode),
    (6, "rank correlation", penumbra(False)),
    (7, "shift between channels", other_texture(WHITE, 0.5)),
    (7, "shapes of channels", other_texture(BROWN, 1.5)),
    (7, "slope", texture(False)),
    (7, "dark and pale", pair(1.5)),
    (8, "distance", glints),
    (8, "mean radiance", fireflies(0.05, 80, share=0.05, edge=24)),  # the mean is 4.95 times
    (8, "mean radiance", fireflies(1, 12, share=0.05, edge=24)),
    *((9, part, path_lengths(1.0, 0.5)) for part in ("support", "tail", "skewness", "variance")),
    (10, "neighbours", neighbours(False)),
    (10, "blend", moved_seam),
    (12, "integrators", same_integrator),
    *((13, part, kept_assumptions) for part in ("slope", "skewness", "steps", "features")),
    *(
        (number, part, FALSE[number])
        for number, parts_ in {
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
        }.items()
        for part in parts_
    ),
    (23, "shift", bounces((0.5, 0.5, 0.5), WHITE)),
    *((15, part, learned(False)) for part in ("improved", "fireflies", "gain", "denoised")),
]
"""Claim, a part of it by words of its name, and a world in which that part is false."""
