"""Pixels and regions: what they say equals what the functions say of their samples."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.viz.results import panel_of
from tests.viz.figures import texts


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


def test_a_figure_shows_both_scales(samples, pixel):
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
    assert "no positive samples" in dark.plot().axes[1].get_title(loc="right")
    assert "—" in repr(dark)


def test_two_channels_have_no_patterns_but_all_else():
    x = np.random.default_rng(1).gamma(2.0, size=(2, 2, 2, 64))
    pixel = chd.Samples.from_array(x).pixel(1, 1)
    assert pixel.channels == ("channel0", "channel1")
    assert "label" not in repr(pixel)


# --- regions --------------------------------------------------------------------------------------


X = np.random.default_rng(0).lognormal(size=(10, 12, 3, 128))
X[:, :6] *= np.random.default_rng(1).random((10, 6, 1, 128)) < 0.1
SAMPLES = chd.Samples.from_array(X, scene="hall")


def test_a_region_study_is_one_figure_and_one_table():
    study = SAMPLES.regions({"dark & old wall": (4, 2), "floor": (9, 11)})
    figure = study.plot(width="column", scales="log")
    assert figure.get_figwidth() == 3.4
    assert texts(figure) >= {"1 dark & old wall", "2 floor", "null-heavy", "1", "2"}
    begin, _, head, _, first, second, *_ = study.to_latex().splitlines()
    assert begin == r"\begin{tabular}{lrrrrrrr}"
    assert head.count(" & ") == first.replace(r"\&", "").count(" & ") == 7
    assert first.startswith(r"dark \& old wall & 4, 2 & null-heavy & ")
    pixel = study.pixels["floor"]
    mean = max(pixel.radiance.mean(axis=-1, dtype=float))
    assert f"& {mean:.2f} $\\pm$" in second


def test_without_places_there_is_one_for_each_pattern():
    labels = chd.classify(SAMPLES, progress=False)["label"]
    study = SAMPLES.regions()
    assert len(study.pixels) == len(np.unique(labels))


# --- curves ---------------------------------------------------------------------------------------


def pixel_of(*rows):
    """Return a pixel of rows of samples."""
    return chd.Samples.from_array(np.array(rows)[np.newaxis, np.newaxis]).pixel(0, 0)


def humps(rng, spp=512):
    """Return samples of two log-normal distributions far apart, 30 % of them at the bright one."""
    bright = rng.random(spp) < 0.3
    return np.exp(rng.normal(size=spp) * np.where(bright, 0.3, 0.5) + np.where(bright, 2.0, -3.0))


def test_two_humps_are_drawn_as_a_mixture_with_modes_there():
    pixel = pixel_of(humps(np.random.default_rng(5)))
    curve = pixel.curve(0)
    assert curve.family == "mixture"
    assert curve.name == "2 components"
    x = np.geomspace(1e-3, 1e2, 500)
    y = curve.density(x, 0.1, "log")
    peaks = x[1:-1][(y[1:-1] > y[:-2]) & (y[1:-1] > y[2:])]
    assert np.allclose(np.log(peaks), [-3.0, 2.0], atol=0.25)
    assert (
        curve.words == "2 components: 68\N{NO-BREAK SPACE}% at 0.050, 32\N{NO-BREAK SPACE}% at 7.4"
    )


def test_a_gamma_pixel_is_drawn_as_gamma():
    curve = pixel_of(np.random.default_rng(6).gamma(2.0, 0.5, 2048)).curve(0)
    assert (curve.family, curve.words.split(",")[0]) == ("gamma", "gamma (shape 2.0")
    shape, scale = (float(curve.fit.parameters[name]) for name in ("shape", "scale"))
    assert abs(shape - 2) < 0.25
    assert abs(scale - 0.5) < 0.08
    assert curve.misfit < 0.03


def test_without_a_curve_a_word_says_why():
    rng = np.random.default_rng(7)
    few = np.where(np.arange(64) < 12, rng.lognormal(size=64), 0)
    values = np.repeat([0.5, 0.75, 5.0], [30, 20, 14])
    rows = np.full(64, 0.3), np.zeros(64), few, values
    words = [pixel_of(row).curve(0).words for row in rows]
    assert words[:3] == ["constant samples", "no positive samples", "too few positive samples"]
    assert words[3] == "only a few values"


def test_a_curve_expects_what_a_histogram_counts():
    """Zeros of one channel are samples that it does not describe."""
    rng = np.random.default_rng(8)
    x = rng.lognormal(size=(2, 4096)) * np.array([[1.0], [5.0]])
    x[0, 0::4] = 0
    x[:, 1::4] = 0
    pixel = pixel_of(*x)
    for row, share in ((0, 2 / 3), (1, 1.0)):
        for scale in ("log", "linear"):
            counted = pixel.histograms[scale]
            width = counted.bin_width[row]
            density = pixel.curve(row).density(counted.centers[row], width, scale)
            assert np.abs(density - np.nan_to_num(counted.density[row])).sum() * width < 1.2 - share
            if scale == "log":  # all samples are in its bins
                assert density.sum() * width == pytest.approx(share, rel=0.01)


def test_curves_of_several_modes_are_mixtures():
    """For regions of a report and of a notebook alike; few positive samples have none."""
    rng = np.random.default_rng(1)
    x = rng.lognormal(size=(2, 2, 3, 256))
    x[0] *= np.where(rng.random((2, 1, 256)) < 0.5, 100, 1)
    x[1, 1, :, 12:] = 0
    samples = chd.Samples.from_array(x)
    pixels = [samples.pixel(*place) for place in ((0, 0), (1, 0), (1, 1))]
    assert [pixel.curve(-1).family for pixel in pixels] == ["mixture", "lognormal", ""]
    assert all(panel_of(pixel, "wall").select("luminance").fits[0].fit for pixel in pixels[:2])
    grey = chd.Samples.from_array(x[:, :, :1]).pixel(0, 0)
    assert "2 components" in panel_of(grey, "wall").told
