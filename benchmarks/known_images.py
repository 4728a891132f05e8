"""Made images whose truth and noise are known, for `test_refuted`: what a learned prior gets wrong.

An image is a sum of lights. A light has a radiance, and a law of its samples with mean 1; the
channels of a pixel share the draw of a light, as the paths of a renderer do. So the mean and the
covariance of a pixel's samples are known, and with them which pixels and channels are loud, quiet
(a fifth of the noise of the loud ones, or less) or exact. `pictures` yields the images: of each
kind several variants, placed anew by each seed.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage

SIZE = 64
RGB = np.array((1, 0.8, 0.6))
QUIET = 1 / 5
"""Noise of a quiet pixel and channel over that of the loud ones, at most."""
ALL_CHANNELS = slice(None)


# --- laws of samples with mean 1 ---


@dataclass(frozen=True)
class Law:
    """Samples of mean 1: their standard deviation (y, x), and a draw of shape (pixel, n)."""

    deviation: float | np.ndarray
    draw: Callable[[np.random.Generator, np.ndarray, tuple[int, int]], np.ndarray]


def exact() -> Law:
    return Law(0.0, lambda _rng, _s, shape: np.ones(shape, np.float32))


def exponential() -> Law:
    return Law(1.0, lambda rng, _s, shape: rng.standard_exponential(shape, np.float32))


def gamma(deviation: float | np.ndarray) -> Law:
    def draw(rng, s, shape):
        return rng.standard_gamma(np.broadcast_to(1 / s**2, shape), dtype=np.float32) * s**2

    return Law(deviation, draw)


def normal(deviation: float | np.ndarray) -> Law:
    return Law(deviation, lambda rng, s, shape: 1 + s * rng.standard_normal(shape, np.float32))


def laplace(deviation: float | np.ndarray) -> Law:
    """Return the law of 1 plus a difference of exponentials, as of a control variate."""

    def draw(rng, s, shape):
        one, other = (rng.standard_exponential(shape, np.float32) for _ in range(2))
        return 1 + s / np.sqrt(2) * (one - other)

    return Law(deviation, draw)


def lognormal(sigma: float) -> Law:
    def draw(rng, s, shape):
        return np.exp(sigma * rng.standard_normal(shape, np.float32) - sigma**2 / 2)

    return Law(np.sqrt(np.expm1(sigma**2)), draw)


def pareto(tail: float) -> Law:
    deviation = 1 / np.sqrt(tail * (tail - 2)) if tail > 2 else np.inf

    def draw(rng, s, shape):
        return (1 - rng.random(shape, np.float32)) ** (-1 / tail) * ((tail - 1) / tail)

    return Law(deviation, draw)


def with_nulls(share: float, law: Law | None = None) -> Law:
    of_light = law or exponential()

    def draw(rng, s, shape):
        light = of_light.draw(rng, np.asarray(of_light.deviation), shape)
        light *= rng.random(shape, np.float32) >= share
        return light / np.float32(1 - share)

    return Law(np.sqrt((1 + of_light.deviation**2) / (1 - share) - 1), draw)


# --- images as sums of lights ---


@dataclass(frozen=True)
class Light:
    """Radiance (y, x, channel) and the law of its samples, which the channels of a pixel share."""

    radiance: np.ndarray
    law: Law

    def added_to(self, x: np.ndarray, rng: np.random.Generator) -> None:
        lit = self.radiance.any(axis=-1)
        radiance = self.radiance[lit].astype(np.float32)[..., np.newaxis]
        deviation = np.broadcast_to(self.law.deviation, lit.shape)[lit][:, np.newaxis]
        light = self.law.draw(rng, deviation, (int(lit.sum()), x.shape[-1]))
        x[lit] += radiance * light[:, np.newaxis].astype(np.float32)


@dataclass(frozen=True)
class Picture:
    """A made image.

    Attributes
    ----------
    kind, variant
        What it is called; the same for each seed.
    lights
        The sum of these is the image.
    classes
        Parts of the image by name, shape (y, x), or (y, x, channel).
    features
        First-hit features.
    numbers
        Samples per pixel for which the kind is meant; empty for all.
    """

    kind: str
    variant: str
    lights: Sequence[Light]
    classes: Mapping[str, np.ndarray] = field(default_factory=dict)
    features: Mapping[str, np.ndarray] = field(default_factory=dict)
    numbers: tuple[int, ...] = ()

    @cached_property
    def truth(self) -> np.ndarray:
        """The radiance, shape (y, x, channel)."""
        return np.sum([light.radiance for light in self.lights], axis=0)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the channels of one sample, shape (y, x, channel, channel)."""
        outer = [
            light.radiance[..., np.newaxis]
            * light.radiance[..., np.newaxis, :]
            * np.broadcast_to(light.law.deviation, self.truth.shape[:2])[..., None, None] ** 2
            for light in self.lights
        ]
        return np.nansum(outer, axis=0)

    @cached_property
    def noise(self) -> np.ndarray:
        """Standard deviation of a sample, shape (y, x, channel)."""
        return np.sqrt(np.einsum("...cc->...c", self.covariance))

    @cached_property
    def groups(self) -> dict[str, np.ndarray]:
        """Parts of the image, of its channels and of its noise, by name: shape (y, x, channel).

        The noise of the loudest class, or of the loudest pixel where there are no classes, says
        what is quiet; whatever else varies is loud.
        """
        shape = self.truth.shape
        of = {
            name: np.broadcast_to(m if m.ndim == 3 else m[..., np.newaxis], shape)
            for name, m in self.classes.items()
        }
        noise = np.where(np.isinf(self.noise), 10 * self.truth, self.noise)
        varies = noise > 0
        parts = [noise[m & varies] for m in of.values()] or [noise.max()]
        limit = QUIET * max(np.median(part) for part in parts if np.size(part))
        noises = {"loud": noise > limit, "quiet": varies & (noise <= limit), "exact": ~varies}
        return {name: m for name, m in (noises | of).items() if m.any()}

    def sampler(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Return samples, shape (y, x, channel, n)."""
        x = np.zeros((*self.truth.shape, n), np.float32)
        for light in self.lights:
            light.added_to(x, rng)
        return x


def coloured(grey: np.ndarray, channels: int | slice | list[int] = ALL_CHANNELS) -> np.ndarray:
    """Return an image of usual colour, as samples hold it; of some channels, the others are 0."""
    image = np.zeros((*grey.shape, 3))
    image[..., channels] = (grey[..., np.newaxis] * RGB)[..., channels]
    return image.astype(np.float32).astype(np.float64)


def light(grey: np.ndarray, law: Law, where: np.ndarray | None = None) -> Light:
    return Light(coloured(grey if where is None else np.where(where, grey, 0)), law)


# --- shapes ---


def grid() -> np.ndarray:
    return np.indices((SIZE, SIZE))


def flat(value: float) -> np.ndarray:
    return np.full((SIZE, SIZE), value)


def gradient() -> np.ndarray:
    return np.outer(np.linspace(0.02, 1, SIZE), np.linspace(0.5, 1, SIZE))


def texture(rng: np.random.Generator, scale: float, mean: float = 0.3) -> np.ndarray:
    smooth = ndimage.gaussian_filter(rng.normal(size=(SIZE, SIZE)), scale, mode="wrap")
    return mean * np.exp(0.7 * smooth / smooth.std())


def white(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0.05, 1, (SIZE, SIZE))


def checker(edge: int) -> np.ndarray:
    y, x = grid()
    return (x // edge + y // edge) % 2 == 1


def text(step: int = 12) -> np.ndarray:
    """Return which pixels of a page are ink, as shares."""
    page = Image.new("L", (SIZE, SIZE), 255)
    for row in range(0, SIZE, step):
        ImageDraw.Draw(page).text((0, row), "samples of a pixel are draws", fill=0)
    return 1 - np.asarray(page) / 255


def lines(rng: np.random.Generator, number: int, width: float) -> np.ndarray:
    y, x = grid()
    lines = np.zeros(x.shape, bool)
    for angle, a, b in zip(*rng.uniform(0, (np.pi, SIZE, SIZE), (number, 3)).T, strict=True):
        lines |= abs((y - a) * np.cos(angle) + (x - b) * np.sin(angle)) < width / 2
    return lines


def strokes(rng: np.random.Generator, number: int, width: float) -> np.ndarray:
    """Return short straight strokes with round ends."""
    y, x = grid()
    found = np.zeros(x.shape, bool)
    for _ in range(number):
        (a, b), angle, reach = rng.uniform(0, SIZE, 2), rng.uniform(0, np.pi), rng.uniform(8, 20)
        along = np.clip((y - a) * np.sin(angle) + (x - b) * np.cos(angle), -reach, reach)
        apart = np.hypot(y - a - along * np.sin(angle), x - b - along * np.cos(angle))
        found |= apart < width / 2
    return found


def filaments(rng: np.random.Generator, number: int, width: float) -> np.ndarray:
    """Return curves across the image, as a caustic on a floor."""
    y, x = grid()
    found = np.zeros(x.shape, bool)
    for _ in range(number):
        middle, height = rng.uniform(0, SIZE), rng.uniform(3, 12)
        period, phase, slope = rng.uniform(20, 60), rng.uniform(0, 6), rng.uniform(-0.4, 0.4)
        turn = 2 * np.pi * x / period + phase
        curve = middle + slope * (x - SIZE / 2) + height * np.sin(turn)
        steep = slope + height * np.cos(turn) * 2 * np.pi / period
        found |= abs(y - curve) / np.hypot(1, steep) < width / 2
    return found


def square(rng: np.random.Generator, edge: int, margin: int = 8) -> np.ndarray:
    """Return a square, somewhere."""
    y, x = grid()
    a, b = rng.integers(margin, SIZE - margin - edge + 1, 2)
    return (y >= a) & (y < a + edge) & (x >= b) & (x < b + edge)


def squares(rng: np.random.Generator, edge: int, step: int) -> np.ndarray:
    """Return squares on a grid, each moved."""
    found = np.zeros((SIZE, SIZE), bool)
    for a, b in itertools.product(range(0, SIZE - step + 1, step), repeat=2):
        y, x = np.array((a, b)) + rng.integers(0, step - edge + 1, 2)
        found[y : y + edge, x : x + edge] = True
    return found


def about(mask: np.ndarray, distance: int) -> np.ndarray:
    """Return the pixels at most so far from a part of the image, and not in it."""
    return ndimage.binary_dilation(mask, np.ones((3, 3)), iterations=distance) & ~mask


# --- kinds: each yields variants as (name, lights, classes) ---

Variants = Iterator[tuple[str, list[Light], dict[str, np.ndarray]]]


def noisy_channel(rng: np.random.Generator) -> Variants:
    shapes = {
        "smooth": texture(rng, 6, 0.5),
        "textured": texture(rng, 1, 0.5),
        "flat": flat(0.5),
        "page": 0.1 + 0.9 * (1 - text()),
    }
    for name, channel, law, calm, shape in (
        ("B, 97 % nulls", 2, with_nulls(0.97), 0.03, "smooth"),
        ("R, gamma of 4", 0, gamma(4), 0.03, "textured"),
        ("G, 90 % nulls", 1, with_nulls(0.9), 0.1, "flat"),
        ("B, 99.5 % nulls", 2, with_nulls(0.995), 0.01, "page"),
        ("R, exponential", 0, exponential(), 0.05, "page"),
    ):
        others = [c for c in range(3) if c != channel]
        calm_ones = [Light(coloured(shapes[shape], c), gamma(calm)) for c in others]
        lights = [*calm_ones, Light(coloured(shapes[shape], channel), law)]
        noisy = np.broadcast_to(np.arange(3) == channel, (SIZE, SIZE, 3))
        yield name, lights, {"noisy": noisy, "calm": ~noisy}


def caustic(rng: np.random.Generator) -> Variants:
    for name, number, width, radiance, nulls, floor in (
        ("thin, x10, 98 % nulls, on exponential", 5, 1.5, 1.0, 0.98, exponential()),
        ("wide, x3, 95 % nulls, on exponential", 4, 4, 0.3, 0.95, exponential()),
        ("thin, x30, 99.5 % nulls, on noise of .1", 5, 2, 3.0, 0.995, gamma(0.1)),
        ("many, x5, 98 % nulls, on noise of .5", 14, 1.5, 0.5, 0.98, gamma(0.5)),
        ("one, x100, 99 % nulls, on lognormal", 1, 3, 10.0, 0.99, lognormal(0.8)),
    ):
        on = filaments(rng, number, width)
        ground = texture(rng, 10, 0.1)
        lights = [light(ground, floor), light(flat(radiance), with_nulls(nulls), on)]
        yield name, lights, {"filaments": on, "border": about(on, 6), "floor": ~on}


def fireflies(rng: np.random.Generator) -> Variants:
    y, x = grid()
    frame = ~((abs(x - SIZE // 2) < 14) & (abs(y - SIZE // 2) < 14))
    for name, part, share, of_light, calm, base in (
        ("left half", x < SIZE // 2, 0.002, 0.5, 0.05, flat(0.5)),
        ("around a square", frame, 0.005, 0.7, 0.02, texture(rng, 4, 0.5)),
        ("stripes of 8", (x // 8) % 2 == 0, 0.002, 0.5, 0.05, gradient()),
        ("checker of 16", checker(16), 0.01, 0.3, 0.1, texture(rng, 1)),
        ("upper third", y < SIZE // 3, 0.001, 0.8, 0.2, flat(0.2)),
    ):
        rare = light(base * of_light, with_nulls(1 - share), part)
        rest = light(np.where(part, 1 - of_light, 1) * base, gamma(calm))
        border = about(part, 8)
        yield name, [rest, rare], {"fireflies": part, "calm": ~part, "border": border}


def known_exactly(rng: np.random.Generator) -> Variants:
    y, x = grid()
    noisy = with_nulls(0.95)
    dots = squares(rng, 1, 8)
    blocks = squares(rng, 5, 16)
    sky = y < 20 + 6 * np.sin(x / 7)
    letters = text() > 0.5
    for name, part, value, ground, law in (
        ("pixels in 95 % nulls", dots, flat(2.0), flat(0.3), noisy),
        ("dark pixels in exponential", dots, flat(0.02), texture(rng, 3), exponential()),
        ("blocks of 5 in 98 % nulls", blocks, white(rng), flat(0.3), with_nulls(0.98)),
        ("sky", sky, 1 + y / SIZE, texture(rng, 2), noisy),
        ("letters in gamma of 2", letters, flat(1.0), gradient(), gamma(2)),
    ):
        lights = [light(value, exact(), part), light(ground, law, ~part)]
        yield name, lights, {"noisy": ~part, "border": about(part, 4)}
    ground = texture(rng, 2)
    parts = [
        Light(coloured(ground, 0), noisy),
        Light(coloured(ground, 1), exact()),
        Light(coloured(ground, 2), exponential()),
    ]
    yield "G", parts, {}


def quiet_texture(rng: np.random.Generator) -> Variants:
    y, x = grid()
    for name, detail, calm, law, part in (
        ("texture of 1, 3 %, gamma", texture(rng, 1), 0.03, gamma(2.5**0.5), x < SIZE // 2),
        ("white, 3 %, 90 % nulls", white(rng), 0.03, with_nulls(0.9), x < SIZE // 2),
        ("text, 10 %, lognormal", 0.05 + 0.95 * (1 - text()), 0.1, lognormal(1.5), y > SIZE // 3),
        ("checker of 2, 1 %, gamma", 0.1 + checker(2), 0.01, gamma(2.5**0.5), checker(16)),
        ("stripes, 5 %, exponential", 0.1 + (x % 4 < 2), 0.05, exponential(), y < SIZE // 2),
    ):
        loud = flat(detail.mean()) + 0.2 * gradient()
        lights = [light(detail, gamma(calm), part), light(loud, law, ~part)]
        yield name, lights, {"detail": part, "smooth": ~part}


def rare_patch(rng: np.random.Generator) -> Variants:
    for edge, share, radiance, floor in (
        (4, 0.02, 1.0, exponential()),
        (8, 0.01, 0.5, gamma(0.5)),
        (12, 0.004, 1.0, exponential()),
        (12, 0.001, 0.3, gamma(0.2)),
        (20, 0.002, 2.0, with_nulls(0.5)),
    ):
        on = square(rng, edge)
        lights = [light(flat(0.1), floor), light(flat(radiance), with_nulls(1 - share), on)]
        near = about(on, 6)
        classes = {"patch": on, "ring": near, "rest": ~on & ~near}
        yield f"{edge} x {edge}, {share:.1%} of samples", lights, classes


def brush(rng: np.random.Generator) -> Variants:
    for width, number, bright, dark, law in (
        (2, 12, 3.0, 0.1, exponential()),
        (4, 8, 3.0, 0.1, exponential()),
        (6, 6, 3.0, 0.1, with_nulls(0.7)),
        (8, 5, 1.0, 0.2, gamma(1.5)),
        (5, 7, 0.05, 0.8, exponential()),
    ):
        on = strokes(rng, number, width)
        lights = [light(np.where(on, bright, dark), law)]
        yield f"{width} px, {bright:g} on {dark:g}", lights, {"strokes": on, "ground": ~on}


def little_samples(rng: np.random.Generator) -> Variants:
    letters = text()
    yield "white, exponential", [light(white(rng), exponential())], {}
    yield "white, 50 % nulls", [light(white(rng), with_nulls(0.5))], {}
    own = coloured(np.ones((SIZE, SIZE))) * rng.uniform(0.05, 1, (SIZE, SIZE, 3))
    yield "white, each channel its own", [Light(own, gamma(1.2))], {}
    mixed = 0.1 + 0.9 * (1 - letters)
    yield "text on white", [light(mixed, exponential())], {"ink": letters > 0.5}
    yield "white text on black", [light(0.02 + letters, gamma(1))], {"ink": letters > 0.5}
    binary = np.where(rng.random((SIZE, SIZE)) < 0.5, 1.0, 0.2)
    yield "pixels of .2 and 1, lognormal", [light(binary, lognormal(1))], {"bright": binary == 1}


def brighter_is_noisier(rng: np.random.Generator) -> Variants:
    _, x = grid()
    rows = 0.1 + np.where(x % 16 < 8, x / SIZE, 0.3) * 3
    for name, image, k, law in (
        ("gradient, normal", 2 * gradient(), 1.0, normal),
        ("texture of 2, gamma", texture(rng, 2, 0.5), 2.0, gamma),
        ("steps, gamma", rows, 1.0, gamma),
        ("white, normal", 2 * white(rng), 1.5, normal),
    ):
        yield name, [light(image, law(k * image))], {}


def pareto_tails(rng: np.random.Generator) -> Variants:
    y, x = grid()
    images = {
        "gradient": gradient(),
        "texture of 2": texture(rng, 2),
        "blocks": 0.1 + ((x // 16 + y // 16) % 3) * 0.4,
    }
    for tail, (name, image) in itertools.product((1.6, 2.2), images.items()):
        yield f"{tail}, {name}", [light(image, pareto(tail))], {}


def signed(rng: np.random.Generator) -> Variants:
    smooth, detail = gradient(), texture(rng, 1)
    yield "normal of 3, texture of 1", [light(detail, normal(3.0))], {}
    yield "normal of .3 everywhere, gradient", [light(smooth, normal(0.3 / smooth))], {}
    yield "laplace of 2, texture of 4", [light(texture(rng, 4), laplace(2.0))], {}
    mixed = np.where(checker(8), 1.0, 0.1)
    yield "laplace of .5 everywhere, checker of 8", [light(mixed, laplace(0.5 / mixed))], {}


def stripes(rng: np.random.Generator) -> Variants:
    y, x = grid()
    for width, bright, law, along in (
        (1, 1.0, exponential(), x),
        (2, 1.0, gamma(1.5), y),
        (3, 3.0, with_nulls(0.5), x + y),
        (6, 0.5, exponential(), x),
    ):
        on = along // width % 2 == 0
        lights = [light(np.where(on, bright, 0.1), law)]
        yield f"{width} px, {bright:g} on .1", lights, {"bright": on, "dark": ~on}


def blinds(rng: np.random.Generator) -> Variants:
    y, x = grid()
    for width, step, bright, law, dark_law in (
        (2, 7, 2.0, with_nulls(0.6), with_nulls(0.6)),
        (3, 8, 5.0, exponential(), with_nulls(0.8)),
        (1, 5, 1.0, gamma(0.3), exponential()),
        (2, 10, 10.0, with_nulls(0.9), exponential()),
    ):
        on = y % step < width
        fall = 1 - 0.6 * x / SIZE
        lights = [light(bright * fall, law, on), light(flat(0.15), dark_law, ~on)]
        yield f"{width} of {step} px, {bright:g}", lights, {"slits": on, "slats": ~on}


def small_lamps(rng: np.random.Generator) -> Variants:
    for edge, step, bright, law in (
        (2, 16, 20.0, exponential()),
        (2, 10, 5.0, with_nulls(0.7)),
        (2, 32, 100.0, lognormal(1)),
        (2, 16, 3.0, gamma(0.5)),
        (3, 20, 30.0, exponential()),
    ):
        on = squares(rng, edge, step)
        lights = [light(np.where(on, bright, 0.1), law)]
        name = f"{edge} x {edge} in {step} px, {bright:g}"
        yield name, lights, {"lamps": on, "ground": ~on}


def mixtures(rng: np.random.Generator) -> Variants:
    y, x = grid()
    lamp, sky = square(rng, 3), (y < 14) & (x > 36)
    sun = (y > 30) & (x < 30) & ~lamp
    on = filaments(rng, 4, 1.5) & (y > 30) & (x >= 30) & ~lamp
    sky &= ~lamp
    rest = ~lamp & ~sky & ~sun
    lights = [
        light(flat(15.0), exact(), lamp),
        light(1 + y / SIZE, exact(), sky),
        light(texture(rng, 1, 0.8), gamma(0.05), sun),
        light(0.1 + 0.2 * gradient(), with_nulls(0.5), rest),
        light(flat(2.0), with_nulls(0.98), on),
    ]
    classes = {"sunlit wall": sun, "caustic": on, "dim": rest & ~on}
    yield "room: lamp, sky, sunlit wall, caustic", lights, classes

    letters = text() > 0.5
    left = x < SIZE // 2
    lights = [
        light(np.where(letters, 0.05, 0.8), gamma(0.1), left),
        light(np.where(letters, 0.05, 0.8), exponential(), ~left),
        light(flat(0.5), with_nulls(0.997), ~left),
    ]
    classes = {"quiet page": left, "page with fireflies": ~left}
    yield "pages: quiet, with fireflies", lights, classes

    ring = abs(np.hypot(y - SIZE / 2, x - SIZE / 2) - 16) < 5
    cast = about(ring, 8) & (y > SIZE / 2)
    lights = [
        light(flat(0.4), gamma(0.03), ~ring),
        light(texture(rng, 2), with_nulls(0.9), ring),
        light(flat(0.5), with_nulls(0.996), cast),
    ]
    classes = {"glass": ring, "caustic": cast, "background": ~ring & ~cast}
    yield "glass ring: background, glass, caustic", lights, classes

    grain, patch = squares(rng, 2, 16), square(rng, 10)
    ground = np.where(x % 12 < 4, 0.6, 0.15)
    lights = [
        light(ground, normal(2.0), y < SIZE // 2),
        light(ground, exponential(), y >= SIZE // 2),
        light(flat(8.0), exponential(), grain),
        light(flat(1.0), with_nulls(0.995), patch),
    ]
    classes = {"lamps": grain, "patch": patch, "signed": (y < SIZE // 2) & ~grain & ~patch}
    yield "stripes: signed half, lamps, rare patch", lights, classes

    window = (abs(x - 44) < 12) & (abs(y - 24) < 14) & (x % 8 < 6)
    beam = (abs(x - y) < 8) & ~window
    lights = [
        light(2 + gradient(), exact(), window),
        light(texture(rng, 0.5, 0.2), gamma(0.2), ~window),
        light(flat(0.6), pareto(2.2), beam),
        Light(coloured(np.where(window, 0, 0.3), 2), with_nulls(0.9)),
    ]
    yield "window, beam with a tail, noisy blue", lights, {"beam": beam, "wall": ~window & ~beam}


KINDS: dict[str, Callable[[np.random.Generator], Variants]] = {
    "one noisy channel": noisy_channel,
    "caustic on a calm floor": caustic,
    "fireflies beside calm": fireflies,
    "pixels known exactly": known_exactly,
    "quiet texture beside loud smooth": quiet_texture,
    "rare patch": rare_patch,
    "strokes": brush,
    "few samples of white": little_samples,
    "noise of squared brightness": brighter_is_noisier,
    "Pareto tails": pareto_tails,
    "signed samples": signed,
    "stripes": stripes,
    "blinds": blinds,
    "small lamps": small_lamps,
    "mixture": mixtures,
}
NUMBERS = {"few samples of white": (4, 5, 8, 16)}


# --- images of one law ---


def shapes(rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and truths, shape (y, x), of images with one law everywhere."""
    y, x = grid()
    for factor, share in ((3, 0.1), (3, 5), (30, 0.5), (300, 1), (1000, 0.1)):
        glint = rng.random(x.shape) < share / 100
        yield f"glints x{factor}, {share} %", np.where(glint, 0.1 * factor, 0.1)
    for edge in (1, 2, 4):
        yield f"checker of {edge}", np.where(checker(edge), 1.0, 0.1)
    for edge in (1, 3, 5, 10):
        near = (abs(x - SIZE // 2) < (edge + 1) // 2) & (abs(y - SIZE // 3) < (edge + 1) // 2)
        yield f"lamp of {edge} x {edge}", np.where(near, 30.0, 0.1)
    for scale in (0.5, 1, 2, 4):
        yield f"texture of {scale}", texture(rng, scale)
    yield "lines", np.where(lines(rng, 12, 1), 1.0, 0.1)
    yield "text", 0.05 + 1 - text()
    yield "white noise", white(rng)
    yield "gradient", gradient()
    yield "constant", flat(0.1)


LAWS = {
    "exponential": exponential(),
    "gamma, 50 % nulls": with_nulls(0.5, gamma(2**0.5)),
    "lognormal, 80 % nulls": with_nulls(0.8, lognormal(1)),
    "Pareto": pareto(2.5),
    "95 % nulls": with_nulls(0.95),
}


def of_one_law(seed: int) -> Iterator[Picture]:
    """Yield each shape with each law, without features and with an albedo that is unrelated."""
    for shape, grey in shapes(np.random.default_rng(seed)):
        for name, law in LAWS.items():
            lights = [light(grey, law)]
            albedo = np.random.default_rng(seed).random((SIZE, SIZE, 3), np.float32)
            yield Picture(f"one law: {shape}", name, lights)
            yield Picture(f"one law: {shape}", f"{name}, albedo", lights, {}, {"albedo": albedo})


def detail_beside_noise(seed: int) -> Iterator[Picture]:
    """Yield images whose left half has little noise and whose right half has much."""
    _, x = grid()
    left = x < SIZE // 2
    for shape, grey in shapes(np.random.default_rng(seed)):
        if shape in ("texture of 1", "white noise", "constant"):
            for noise in (0.01, 0.05, 0.2):
                lights = [light(grey, normal(noise), left), light(grey, exponential(), ~left)]
                classes = {"left": left, "right": ~left}
                yield Picture("detail beside noise", f"{shape}, {noise:.0%}", lights, classes)


def pictures(
    seed: int, kinds: Mapping[str, Callable[[np.random.Generator], Variants]] = KINDS
) -> Iterator[Picture]:
    """Yield all images of some kinds: of all, if none are named."""
    for kind, variants in kinds.items():
        rng = np.random.default_rng((seed, zlib.crc32(kind.encode())))
        for variant, lights, classes in variants(rng):
            yield Picture(kind, variant, lights, classes, {}, NUMBERS.get(kind, ()))
    if kinds is KINDS:
        yield from detail_beside_noise(seed)
        yield from of_one_law(seed)
