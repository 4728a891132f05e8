"""Errors of images: known ones come out, whatever noise the reference has.

Samples are exponential with the mean of their pixel, so the mean of n has 1 / n of its squared
radiance as variance.
"""

import re

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.display import number
from chdstat.comparison import image_errors
from chdstat.comparison.finished_images import flip_in_tiles
from chdstat.comparison.metrics import HAS_FLIP, exposures, flip
from chdstat.errors import InputError
from chdstat.inference.references import Reference

EDGE = 48
TRUTH = np.linspace(0.2, 2, EDGE)[:, None, None] * np.ones((EDGE, EDGE, 3))


def drawn(which, spp, factor=1.0, **attrs):
    x = np.random.default_rng(which).exponential(size=(*TRUTH.shape, spp))
    return chd.Samples.from_array((factor * TRUTH[..., None] * x).astype(np.float32), **attrs)


@pytest.mark.parametrize("spp", [16, 256])
def test_the_noise_of_the_reference_is_in_no_error(spp):
    """Four intervals of 95 %: other seeds miss one of them with a probability of a fifth."""
    images = {f"{k} x": drawn(k, 64, k).read().mean(axis=-1) for k in (1, 2)}
    found = image_errors(images, drawn(0, spp))
    for k in (1, 2):
        errors, square = found.errors[f"{k} x"], np.square(TRUTH)
        expected = (k**2 / 64 + (k - 1) ** 2) * square
        weights = 1 / (square + 0.01 * np.square(TRUTH.mean()))
        assert errors["mse"].low < expected.mean() < errors["mse"].high
        assert errors["relmse"].value == pytest.approx((weights * expected).mean(), rel=0.25)
        exact = image_errors(images, TRUTH).errors[f"{k} x"]["mse"]
        assert errors["mse"].value == pytest.approx(exact.value, rel=0.25)
    with_noise = np.square(images["1 x"] - drawn(0, spp).read().mean(axis=-1)).mean()
    assert with_noise > found.errors["1 x"]["mse"].high  # the control


@pytest.mark.skipif(not HAS_FLIP, reason="no flip-evaluator")
def test_flip_is_near_that_of_the_truth_or_not_told():
    images = {str(n): drawn(n, n).read().mean(axis=-1) for n in (4, 64)}
    for spp in (8, 64, 1024):
        found, told = image_errors(images, drawn(0, spp)), []
        for name, image in images.items():
            value = found.errors[name]["flip"].value
            told.append(np.isfinite(value))
            stops = found.exposures
            assert not told[-1] or value == pytest.approx(
                flip(image, TRUTH, stops=stops).mean(), 0.2
            )
        assert told == ([True, False] if spp == 8 else [True, True])
    assert "exposures from" in " ".join(found.notes)


@pytest.mark.parametrize("spp", [16, 256])
def test_exposures_hardly_move_with_noise(spp):
    """Pixels of 16 samples have an error of a quarter; the largest of them is brighter by half."""
    known = np.array(exposures(TRUTH))
    for seed in range(4):
        noisy = drawn(seed, spp).read().mean(axis=-1)
        noisy[3, 4] = 1e6  # a firefly
        np.testing.assert_allclose(exposures(noisy), known, atol=0.2 if spp == 16 else 0.06)


@pytest.mark.skipif(not HAS_FLIP, reason="no flip-evaluator")
def test_flip_of_tiles_is_that_of_the_image():
    rng = np.random.default_rng(0)
    image, reference = rng.exponential(size=(2, 70, 140, 3))
    *_, (share, found) = flip_in_tiles(image, reference, (-1.0, 2.0))
    whole = flip(image, reference, stops=(-1.0, 2.0))
    assert share == 1
    np.testing.assert_allclose(found, whole, atol=1e-5)


def test_what_cannot_be_told_says_so():
    reference = drawn(0, 64, seed=3)
    found = image_errors({"same numbers": drawn(1, 64, seed=3), "black": 0 * TRUTH}, reference)
    assert found.shown[0]["MSE"] == "cannot tell"
    assert "another seed" in found.notes[-1]
    assert found.to_dataframe()["mse"].isna().tolist() == [True, False]
    exact = image_errors({"itself": TRUTH}, Reference(TRUTH, name="truth.exr"))
    assert {text for name, text in exact.shown[0].items() if name != "image"} == {"0"}
    assert "truth.exr counts as the truth" in exact.notes[0]
    near = image_errors({"truth": TRUTH}, drawn(2, 16)).shown[0]["relMSE"]
    assert re.fullmatch(r"0\.00\d+ \(< 0\.00\d+\)", near)  # may be 0, and is shown
    firefly = TRUTH + 1e-3
    firefly[3, 4] = 1e3
    far = image_errors({"firefly": firefly}, TRUTH).shown[0]["MSE"]
    assert far == f"{number(np.square(firefly - TRUTH).mean())} (upper end unknown)"
    holes = TRUTH.copy()
    holes[:4, :4] = np.nan  # one bad value spreads to no other pixel
    part = image_errors({"holes": 1.1 * holes}, TRUTH).errors["holes"]
    assert part["mse"].value == pytest.approx((0.01 * np.square(TRUTH))[np.isfinite(holes)].mean())
    with pytest.raises(InputError, match="must have the shape of the reference"):
        image_errors({"small": TRUTH[:8]}, TRUTH)
    with pytest.raises(InputError, match="no pixel that is a number"):
        image_errors({"a": TRUTH}, np.full(TRUTH.shape, np.nan))
