"""A pixel as an object: what it says equals what the functions say of its samples."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    radiance = rng.lognormal(size=(6, 5, 3, 300)) * (rng.random((6, 5, 1, 300)) < 0.3)
    radiance[3, 2, 1, 7] = np.inf
    return chd.Samples.from_array(radiance, scene="wall")


@pytest.fixture(scope="module")
def pixel(samples):
    return samples.pixel(3, 2)


def test_it_is_the_pixel_that_was_asked_for(samples, pixel):
    assert (pixel.y, pixel.x, pixel.scene, pixel.spp) == (3, 2, "wall", 300)
    assert np.array_equal(pixel.radiance, samples[3, 2])
    last = samples.pixel(-1, -1)
    assert (last.y, last.x) == (5, 4)
    with pytest.raises(InputError, match="-6 to 5"):
        samples.pixel(6, 0)


def test_nulls_and_bad_samples_are_whole_samples(samples, pixel):
    assert pixel.bad.nonzero()[0].tolist() == [7]
    assert np.array_equal(pixel.null, (samples[3, 2] == 0).all(axis=0))
    assert pixel.null_share == pixel.null.sum() / 299


def test_it_says_what_the_functions_say(samples, pixel):
    whole = chd.summarize(samples, progress=False).isel(y=3, x=2)
    assert np.array_equal(pixel.statistics["mean"], whole["mean"])
    assert np.array_equal(pixel.statistics["standard_error"], whole["standard_error"])
    fits = chd.fit.select(samples, progress=False).isel(y=3, x=2)
    codes = fits["best_family"]
    words = codes.attrs["flag_meanings"].split()
    named = dict(zip(np.atleast_1d(codes.attrs["flag_values"]).tolist(), words, strict=True))
    assert [*pixel.families.values()] == [named[int(code)] for code in codes]
    tails = chd.fit.tail_index(samples, progress=False).isel(y=3, x=2)
    assert np.allclose(pixel.tail.xi, tails["tail_index"], rtol=1e-12)
    modes = chd.modality(samples, progress=False).isel(y=3, x=2)
    assert np.array_equal(pixel.modality.modes, modes["modes"])
    label = chd.classify(samples.read())
    assert pixel.patterns.label == label.label[3, 2]
    assert pixel.histogram().counts.sum() + pixel.histogram().underflow.sum() == 3 * (
        300 - pixel.null.sum() - 1
    )


def test_its_figure_shows_both_scales_and_a_notebook_shows_it(samples, pixel):
    figure = samples.plot(3, 2)
    linear, log = figure.axes
    assert (linear.get_xscale(), log.get_xscale()) == ("linear", "log")
    assert linear.get_title(loc="left") == "wall, y 3, x 2"
    assert "null, log-normal" in log.get_title(loc="right")
    assert pixel._repr_html_().count("<img") == 1


def test_a_pixel_without_light_has_no_fit_and_is_drawn(samples):
    dark = chd.Samples.from_array(np.zeros((2, 2, 3, 64))).pixel(0, 0)
    assert set(dark.families.values()) == {""}
    assert dark.null_share == 1
    assert "no fit" in dark.plot().axes[1].get_title(loc="right")
    assert "—" in repr(dark)


def test_two_channels_have_no_patterns_but_all_else():
    x = np.random.default_rng(1).gamma(2.0, size=(2, 2, 2, 64))
    pixel = chd.Samples.from_array(x).pixel(1, 1)
    assert pixel.channels == ("channel0", "channel1")
    assert "label" not in repr(pixel)
