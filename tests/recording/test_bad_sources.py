"""Bad sources: what each does wrong is named, and what was drawn before is kept."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, InputWarning, RenderError
from chdstat.recording import DrawnPass
from chdstat.recording.pass_checks import findings
from chdstat.recording.pass_sources import seed_of_pass
from chdstat.scenes.builtin import BUILTIN

SHAPE, SPP = (24, 24, 3), 64


def right(seed: int) -> Any:
    """Draw null and heavy-tailed samples, and a lamp whose rim is seen in part."""
    random = np.random.default_rng(seed)
    light = random.random(SHAPE[:2]) < np.linspace(0.2, 1, 24)
    image = (light * random.lognormal(0, 1.2, SHAPE[:2]))[..., np.newaxis] * [1.0, 0.6, 0.2]
    image[4:8, 4:8] = 17
    image[4:8, 3] = np.where(random.random((4, 1)) < 0.4, 17, image[4:8, 3])
    return image


def colored(seed: int) -> Any:
    return right(seed) * np.random.default_rng(seed + 1).uniform(0.3, 1, SHAPE)


def blurred(image: Any, weights: tuple[float, ...]) -> Any:
    for axis in (0, 1):
        image = sum(w * np.roll(image, i, axis) for i, w in enumerate(weights, -1))
    return image


def accumulating() -> Callable[[int], Any]:
    total, number = np.zeros(SHAPE), 0

    def draw(seed: int) -> Any:
        nonlocal total, number
        total, number = total + right(seed), number + 1
        return total / number

    return draw


def counted(change: Callable[[Any, int], Any]) -> Callable[[int], Any]:
    """Return a source whose passes depend on how many came before."""
    number = -1

    def draw(seed: int) -> Any:
        nonlocal number
        number += 1
        return change(right(seed), number)

    return draw


def spread(seed: int, numbers: dict[int, int] | None = None) -> Any:
    """Draw one sequence that is spread over all passes."""
    numbers = {seed_of_pass(0, i): i for i in range(SPP)}
    start = np.random.default_rng(0).random(SHAPE)
    x = (start + numbers[seed] * (5**0.5 - 1) / 2) % 1
    return -np.log(1 - 0.999 * x)


def gamma(image: Any) -> Any:
    return np.round(255 * np.clip(image, 0, 1) ** (1 / 2.2))


def clamped(image: Any) -> Any:
    return image * np.minimum(1, 3 / np.maximum(image.sum(axis=2, keepdims=True), 1e-9))


def with_bad(seed: int) -> Any:
    image = right(seed)
    image[3, seed % 24] = np.nan
    return image


def averaged(seed: int) -> Any:
    return np.random.default_rng(seed).gamma(64, 0.1, SHAPE)


BAD: dict[str, tuple[Callable[[int], Any], str]] = {
    "ignores its seed": (lambda _: right(7), "are equal"),
    "repeats some passes": (lambda seed: right(seed % 8), "copies among"),
    "averages": (averaged, "one sample per pixel and pass"),
    "accumulates": (accumulating(), "clear its image"),
    "spreads a sequence": (spread, "independent random numbers"),
    "filters": (lambda seed: blurred(right(seed), (0.25, 0.5, 0.25)), "box filter"),
    "has a filter with lobes": (lambda seed: blurred(right(seed), (-0.2, 1.4, -0.2)), "negative"),
    "clamps": (lambda seed: np.minimum(colored(seed), 2), "clamped at 2"),
    "clamps grey": (lambda seed: np.minimum(right(seed)[..., :1], 2), "clamped at 2"),
    "clamps the sum": (
        lambda seed: (
            (i := colored(seed)) * np.minimum(1, 3 / np.maximum(i.sum(2), 1e-9))[..., None]
        ),
        "sum of channels is clamped at 3",
    ),
    "draws for a display": (lambda seed: gamma(right(seed)) / 255, "8 bits"),
    "draws levels": (lambda seed: gamma(right(seed)), "8 bits"),
    "has alpha": (lambda seed: np.dstack([right(seed), np.ones((24, 24))]), "alpha"),
    "gives NaN": (with_bad, "0.0017 of the samples are NaN"),
    "is black": (lambda _: np.zeros(SHAPE), "black"),
    "is animated": (counted(lambda image, n: image * 1.02**n), "the frame"),
    "shares random numbers": (
        lambda seed: np.ones(SHAPE) * np.random.default_rng(seed).gamma(1),
        "pixel to",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_passes_show_is_named(name):
    draw, named = BAD[name]
    with pytest.warns(InputWarning) as caught:
        samples = chd.record(draw, spp=SPP)
    said = [str(warning.message) for warning in caught]
    assert any(named in text for text in said), said
    assert len(said) <= 1 + (name == "has a filter with lobes"), said
    assert any(named in note for note in samples.attrs["notes"])
    assert samples.spp == SPP


def raised(seed: int) -> Any:
    message = "out of memory on the device"
    raise MemoryError(message)


def changed(new: Callable[[Any], Any], *, after: int = 20) -> Callable[[int], Any]:
    """Return a source whose passes become others."""
    return counted(lambda image, number: image if number <= after else new(image))


BROKEN: dict[str, tuple[Callable[[Any], Any], str]] = {
    "raises": (raised, "MemoryError: out of memory"),
    "changes its size": (lambda image: image[:20], "(20, 24, 3)"),
    "changes its channels": (lambda image: image[..., :1], "(24, 24, 1)"),
    "gains features": (lambda image: (image, {"albedo": image}), "['albedo']"),
    "gains parts": (lambda image: DrawnPass(image, {}, {2: image}), "parts ["),
    "returns nothing": (lambda _: None, "NoneType"),
    "returns text": (lambda _: "image.exr", "str"),
    "returns bytes": (lambda image: (255 * image).astype(np.uint8), "unsigned"),
    "returns complex numbers": (lambda image: image + 1j, "complex"),
    "dies": (lambda _: (_ for _ in ()).throw(RenderError("it was killed")), "it was killed"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_breaks_midway_is_named_and_earlier_passes_are_kept(name, tmp_path):
    new, named = BROKEN[name]
    out = tmp_path / "x.zarr"
    with pytest.raises(RenderError, match=f"pass 20 .*{re.escape(named)}.*20 passes before"):
        chd.record(changed(new), spp=SPP, out=out, name="scene")
    kept = chd.open(out)
    assert kept.spp == 20
    assert kept.attrs["spp"] == 20
    whole = chd.record(right, spp=SPP)
    assert np.array_equal(kept, np.asarray(whole)[..., :20])


def test_a_first_pass_that_is_no_image_is_refused(tmp_path):
    for draw, named in (
        (lambda seed: np.moveaxis(right(seed), 2, 0), "channels last"),
        (lambda seed: right(seed).ravel(), "(y, x, channel)"),
        (lambda seed: (right(seed), 1), "dict of features"),
        (lambda seed: (right(seed), {"colour": right(seed)}), "albedo, normal"),
        (lambda seed: (right(seed), {"depth": right(seed)}), "feature depth"),
        (lambda seed: DrawnPass(right(seed), {}, {"lamp": right(seed)[:3]}), "part 'lamp'"),
    ):
        with pytest.raises(InputError, match=re.escape(named)):
            chd.record(draw, spp=4, out=tmp_path / "x.zarr")
        assert not (tmp_path / "x.zarr").exists()


@pytest.mark.parametrize("seed", range(5))
def test_right_sources_are_not_warned_of(seed):
    laws: list[Callable[[np.random.Generator], Any]] = [
        lambda r: r.exponential(size=SHAPE),
        lambda r: r.pareto(1.1, size=SHAPE),
        lambda r: r.random(SHAPE),
        lambda r: (r.random(SHAPE[:2]) < 0.02)[..., np.newaxis] * r.lognormal(0, 3, SHAPE),
        lambda r: np.where(r.random(SHAPE) < 0.5, 1.0, 0.0),
        lambda _: np.linspace(0, 1, 24)[:, np.newaxis, np.newaxis] * np.ones(SHAPE),
        lambda r: 3 - (r.random(SHAPE[:2]) < 0.3)[..., np.newaxis] * r.random(SHAPE),
    ]
    for law in laws:
        for spp in (4, SPP):
            with warnings.catch_warnings(action="error"):
                chd.record(lambda s, law=law: law(np.random.default_rng(s)), spp=spp, seed=seed)
    assert chd.record(right, spp=SPP, seed=seed).attrs["notes"] == []
    assert chd.record(lambda s: right(s)[:1, :2], spp=SPP, seed=seed).attrs["notes"] == []


def test_many_samples_lie_at_one_level_by_chance():
    random = np.random.default_rng(0)
    samples = chd.Samples.from_array(random.gamma(0.5, size=(64, 64, 3, 256)).astype(np.float32))
    assert findings(samples) == []


@pytest.mark.parametrize("scene", [*BUILTIN][:8])
def test_scenes_of_mitsuba_are_not_warned_of(scene):
    samples = chd.render(scene, spp=SPP, size=(24, 24), backend="scalar")
    assert findings(samples) == []


def half(x):
    return x.astype(np.float16).astype(np.float32)


def shared_exponent(x):
    """Return values as RGBE files hold them, with 8 bits each."""
    exponent = np.ceil(np.log2(np.maximum(x.max(axis=-1, keepdims=True), 1e-30)))
    return (np.floor(x * 2 ** (8 - exponent)) / 2 ** (8 - exponent)).astype(np.float32)


@pytest.mark.parametrize("store", [half, shared_exponent])
@pytest.mark.parametrize("law", ["exponential", "lognormal", "uniform"])
def test_files_of_few_bits_are_no_clamp(law, store):
    def draw(seed):
        return store(getattr(np.random.default_rng(seed), law)(size=(32, 32, 3)))

    assert chd.record(draw, spp=64).attrs["notes"] == []


@pytest.mark.parametrize("level", [1e-30, 1e-4, 2e-3])
def test_dim_light_is_not_8_bits(level):
    def draw(seed):
        return level * np.random.default_rng(seed).exponential(size=(24, 24, 3))

    assert chd.record(draw, spp=64).attrs["notes"] == []


def test_sums_over_passes_accumulate():
    total = np.zeros((24, 24, 3))

    def draw(seed):
        nonlocal total
        total = total + np.random.default_rng(seed).exponential(size=total.shape)
        return total

    with pytest.warns(chd.errors.InputWarning, match="each pass holds those before it"):
        chd.record(draw, spp=64)


def test_passes_of_nan_are_not_black():
    with pytest.warns(chd.errors.InputWarning, match="NaN or infinite"):
        notes = chd.record(lambda _: np.full((8, 8, 3), np.nan), spp=16).attrs["notes"]
    assert not any("black" in note for note in notes)


def test_a_lamp_in_mirrors_is_no_clamp():
    """Rare paths of all pixels end at a lamp, whose colour they keep; others reach half of it."""
    lamp = np.array([9.3, 8.45, 7.3])

    def draw(seed):
        random = np.random.default_rng(seed)
        rest = random.uniform(0, 0.9, size=(24, 24, 1)) ** 2 * lamp
        color = random.uniform(0.8, 1, size=(24, 24, 3))
        return np.where(random.random((24, 24, 1)) < 0.01, lamp, rest * color)

    assert chd.record(draw, spp=128).attrs["notes"] == []
