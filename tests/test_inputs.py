"""Input: axes by name, masks, integers and precision; whatever array is taken, the same holds."""

import contextlib
import functools
import inspect
import warnings
from dataclasses import replace

import dask.array
import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat import estimators, fit
from chdstat.errors import InputError, LeftOutWarning, StoreError
from chdstat.estimators import MLP, PRESETS, train_model
from chdstat.inference import gaussianity_of_means
from chdstat.samples import Samples
from chdstat.summary.histograms import StreamingHistogram
from chdstat.summary.statistics import Summary

HEIGHT, WIDTH, SPP = 4, 6, 32
DIMS = ("y", "x", "channel", "sample")
FILMS = {"bench", "render", "render_batches", "render_pixels", "report", "study", "explore"}
"""What renders, and takes a size."""


@pytest.fixture(scope="module")
def x():
    rng = np.random.default_rng(8)
    return rng.gamma(0.9, size=(HEIGHT, WIDTH, 3, SPP)).astype(np.float32)


@pytest.fixture(scope="module")
def large():
    return np.random.default_rng(2).gamma(0.9, size=(12, 12, 3, SPP)).astype(np.float32)


# --- names --------------------------------------------------------------------------------------


def test_sizes_are_films_and_shapes_images():
    """(width, height) in what renders, and (height, width) as of an array elsewhere."""
    modules = [value for name in chd.__all__ if inspect.ismodule(value := getattr(chd, name))]
    functions = {
        function.__name__: inspect.signature(function).parameters
        for owner in (chd, *modules)
        for function in (getattr(owner, name) for name in dir(owner))
        if inspect.isfunction(function)
    }
    sized = {
        name
        for name, taken in functions.items()
        if "size" in taken or any("RenderSettings" in str(of.annotation) for of in taken.values())
    }
    assert sized == FILMS
    assert chd.simulate("gamma", shape=(2, 3), spp=8).shape == (2, 3, 3, 8)
    rendered = chd.render("cornell-box", size=(3, 2), spp=8, backend="scalar", progress=False)
    assert rendered.shape == (2, 3, 3, 8)


# --- axes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", ["yxcs", "yxsc", "syxc", "scyx", "cyxs", "xycs"])
def test_axes_are_what_the_caller_says(x, axes):
    order = ["yxcs".index(letter) for letter in axes]
    found = Samples.from_array(x.transpose(order), direct=x.transpose(order) / 2, axes=axes)
    np.testing.assert_array_equal(found.read(), x)
    np.testing.assert_array_equal(found.direct.read(), x / 2)


def test_samples_of_one_channel_have_axes_too(x):
    found = Samples.from_array(x[:, :, 0].transpose(2, 0, 1), axes="syx")
    np.testing.assert_array_equal(found.read(), x[:, :, :1])


def test_odd_shapes_are_taken_with_their_axes(x):
    for shape in ((4, 6, 3, 2), (4, 6, 31, 64)):
        with pytest.raises(InputError, match="'yxcs'"):
            Samples.from_array(np.ones(shape))
        assert Samples.from_array(np.ones(shape), axes="yxcs").shape == shape
    with pytest.raises(InputError, match="image"):
        Samples.from_array(x[..., 0])
    assert Samples.from_array(x[..., 0], axes="yxs").shape == (4, 6, 1, 3)


def test_names_of_dims_decide(x):
    named = xr.DataArray(x, dims=DIMS)
    for order in (DIMS, DIMS[::-1], ("sample", "y", "channel", "x")):
        found = Samples.from_array(named.transpose(*order), direct=named.transpose(*order) / 2)
        np.testing.assert_array_equal(found.read(), x)
        np.testing.assert_array_equal(found.direct.read(), x / 2)
    one = named.isel(channel=0, drop=True).transpose("sample", "x", "y")
    np.testing.assert_array_equal(Samples.from_array(one).read(), x[:, :, :1])
    # Names say that there are 5 channels, or fewer samples than channels.
    assert Samples.from_array(xr.DataArray(np.ones((2, 2, 5, 2)), dims=DIMS)).shape == (2, 2, 5, 2)


# --- precision ----------------------------------------------------------------------------------


def test_what_single_precision_holds_is_kept():
    values = np.array([0, -0.0, 1e-45, 1e-38, 3e38, np.nan, np.inf, -np.inf])
    found = Samples.from_array(values.reshape(1, 1, 1, -1)).read()
    np.testing.assert_array_equal(found.ravel(), values.astype(np.float32))


# --- what all functions of arrays share ---------------------------------------------------------

ROWS = {
    "fit.gamma": lambda x: fit.gamma(x).parameters["shape"],
    "fit.select": lambda x: fit.select(x).margin,
    "fit.mixture": lambda x: fit.mixture(x, k=1).log_likelihood,
    "fit.tail_index": lambda x: fit.tail_index(x).n,
    "fit.goodness": lambda x: fit.goodness(x, "gamma", resamples=9).statistic,
    "modality": lambda x: chd.modality(x).dip,
    "gaussianity": lambda x: chd.gaussianity(x).p_value,
    "gaussianity_of_means": lambda x: gaussianity_of_means(x, n_means=8).p_value,
    "histogram": lambda x: chd.histogram(x, scale="log").counts,
    "streaming histogram": lambda x: StreamingHistogram(scale="log").update(x).read().counts,
}
PIXELS = {
    "classify": lambda x: chd.classify(x).label,
    "summary": lambda x: Summary(support=(0, 4)).update(x).read().mean,
    "Samples": lambda x: Samples.from_array(x).read(),
}


@functools.cache
def _trained():
    image = np.random.default_rng(3).gamma(0.9, size=(12, 12, 3, 64)).astype(np.float32)
    return train_model(image, iterations=3, progress=False)


LEARNED = {"elek2019": lambda x: _trained().predict(x)}
FIXED = {n: estimators.lookup(n) for n in ("mean", "karis2013", "shared_patches")}
"""One for each set of axes that estimators look at: all others check their input the same way."""
TAKING = {**ROWS, **PIXELS, **LEARNED, **FIXED}


def _warned(name, given):
    """Return what a function makes of samples of which 2 % are bad, and tells so."""
    if name in ("Samples", "summary", "streaming histogram"):
        return TAKING[name](given)  # leave nothing out, or are a part of what does
    with pytest.warns(
        LeftOutWarning, match=r"[12]\.\d % of the samples .* are bad and were left out"
    ):
        return TAKING[name](given)


@pytest.mark.parametrize("name", TAKING)
def test_masked_samples_are_bad(x, name):
    hidden = np.random.default_rng(1).random((HEIGHT, WIDTH, 1, SPP)) < 0.02
    masked = np.ma.masked_array(x, np.broadcast_to(hidden, x.shape))
    expected, found = (_warned(name, given) for given in (np.where(hidden, np.nan, x), masked))
    np.testing.assert_array_equal(np.asarray(found), np.asarray(expected))
    assert not isinstance(found, np.ma.MaskedArray)


@pytest.mark.parametrize("name", TAKING)
def test_unsigned_integers_are_images_for_a_display(x, name):
    for dtype in (np.uint8, np.uint16):
        with pytest.raises(InputError, match="unsigned integers"):
            TAKING[name]((20 * x).astype(dtype))


@pytest.mark.parametrize("name", TAKING)
def test_dims_may_come_in_any_order(x, name):
    named = xr.DataArray(x, dims=DIMS).transpose("sample", "channel", "x", "y")
    np.testing.assert_array_equal(np.asarray(TAKING[name](named)), np.asarray(TAKING[name](x)))


# --- images in every form ------------------------------------------------------------------------

OF_IMAGES = {
    "summarize": lambda s: chd.summarize(s)["mean"],
    "classify": lambda s: chd.classify(s).label,
    "gaussianity": lambda s: chd.gaussianity(s).p_value,
    "gaussianity_of_means": lambda s: gaussianity_of_means(s, n_means=8).p_value,
    "modality": lambda s: chd.modality(s).modes,
    "difference": lambda s: chd.difference(s, s).p_value,
    "atlas": lambda s: chd.atlas(s, clusters=1).labels,
    "analyze": lambda s: chd.analyze(s, held_out=False, progress=False)["label"],
    "compare": lambda s: chd.compare(s, ["mean"], n=4).measures["mse"].value,
}


@pytest.fixture(scope="module")
def stored(x, tmp_path_factory):
    return Samples.from_array(x).save(tmp_path_factory.mktemp("stores") / "s.zarr").path


@pytest.mark.parametrize("name", OF_IMAGES)
def test_images_are_samples_arrays_or_stores(x, stored, name):
    expected = np.asarray(OF_IMAGES[name](Samples.from_array(x)))
    for given in (x, xr.DataArray(x, dims=DIMS), dask.array.from_array(x), stored):
        np.testing.assert_array_equal(np.asarray(OF_IMAGES[name](given)), expected)


@pytest.mark.parametrize("name", OF_IMAGES)
def test_what_is_no_image_is_refused(name):
    with pytest.raises(StoreError, match="nowhere.zarr"):
        OF_IMAGES[name]("nowhere.zarr")
    with pytest.raises(InputError):
        OF_IMAGES[name]({})


# --- seeds ---------------------------------------------------------------------------------------

SEEDED = {
    "difference": lambda s, seed: chd.difference(s.read(), s.read() ** 1.02, seed=seed).p_value,
    "analyze": lambda s, seed: chd.analyze(s, held_out=False, resamples=9, seed=seed)[
        "best_goodness_p_value"
    ],
    "atlas": lambda s, seed: chd.atlas(s, clusters=2, seed=seed).stability,
    "goodness": lambda s, seed: fit.goodness(s, "gamma", resamples=9, seed=seed)[
        "gamma_goodness_p_value"
    ],
    "compare": lambda s, seed: (
        chd.compare(s, ["mean", "jung2015"], n=8, seed=seed).measures["mse"].value
    ),
    "simulate": lambda _, seed: chd.simulate("gamma", shape=(2, 2), spp=4, seed=seed).read(),
    "train_model": lambda s, seed: train_model(
        np.concatenate([s.read(), 2 * s.read()], axis=-1), iterations=2, seed=seed, progress=False
    ).predict(s.read()),
}


@pytest.mark.parametrize("name", SEEDED)
def test_seeds_are_numbers_generators_or_none(large, name):
    image, run = Samples.from_array(large[:6, :6]), SEEDED[name]
    np.testing.assert_array_equal(run(image, 3), run(image, np.int64(3)))
    drawn = [np.asarray(run(image, np.random.default_rng(3))) for _ in range(2)]
    np.testing.assert_array_equal(*drawn)
    assert np.shape(run(image, None)) == drawn[0].shape
    for wrong in (-1, 0.5, "x"):
        with pytest.raises(InputError, match="seed must be"):
            run(image, wrong)


# --- what is left out ---------------------------------------------------------------------------

IMAGE = {
    "summarize": chd.summarize,
    "classify": chd.classify,
    "fit.gamma": fit.gamma,
    "fit.tail_index": fit.tail_index,
    "modality": chd.modality,
    "gaussianity": chd.gaussianity,
    "gaussianity_of_means": lambda s: gaussianity_of_means(s, n_means=8),
    "histogram": chd.histogram,
    "compare": lambda s: chd.compare(s, ["mean"], n=4),
    "analyze": lambda s: chd.analyze(s, progress=False),
    "train": lambda s: MLP(replace(PRESETS["elek2019"], inputs=4)).train(s, iterations=2),
}
LOGARITHMIC = ("classify", "fit.gamma", "fit.tail_index", "modality", "gaussianity", "analyze")


@pytest.mark.parametrize("name", IMAGE)
def test_what_is_left_out_is_told(large, name):
    bad = large.copy()
    bad[:, 0, 0, :12], bad[0, :, 1, 20], bad[1, :, 2, 20] = np.nan, np.inf, -np.inf
    with warnings.catch_warnings(record=True, action="always") as caught:
        IMAGE[name](Samples.from_array(bad))
    told = {str(w.message) for w in caught if w.category is LeftOutWarning}
    (said,) = told
    assert said == (
        "3.6 % of the samples (168 of 4608) are bad and were left out: "
        "144 NaN or masked, 24 infinite"
    )
    assert {w.filename for w in caught if w.category is LeftOutWarning} == {__file__}


@pytest.mark.parametrize("name", IMAGE)
def test_a_hundredth_is_tolerated(large, name):
    few = large.copy()
    few[:11, :4, 0, 3] = np.nan  # 44 of 4608
    few[:12, 8:, 1, 1] *= -1  # 48 of 13824 values
    IMAGE[name](Samples.from_array(few))


@pytest.mark.parametrize("name", IMAGE)
def test_logarithms_leave_negatives_out(large, name):
    signed = large.copy()
    signed[..., 2, ::8] *= -1
    image = Samples.from_array(signed)
    if name not in LOGARITHMIC:
        IMAGE[name](image)
        return
    said = r"4\.2 % of the samples \(576 of 13824\) are negative and were left out"
    with pytest.warns(LeftOutWarning, match=said):
        IMAGE[name](image)


def test_arrays_tell_negative_samples_too(x):
    signed = np.where(np.arange(SPP) % 8 == 0, -x, x)
    for name in ("fit.gamma", "fit.mixture", "fit.tail_index", "modality", "gaussianity"):
        with pytest.warns(LeftOutWarning, match=r"12\.5 % of the samples .* are negative"):
            ROWS[name](signed)
    with pytest.warns(LeftOutWarning, match="negative"):
        chd.classify(signed)
    ROWS["gaussianity_of_means"](signed)
    estimators.mean(signed)


@pytest.mark.filterwarnings("default::chdstat.errors.LeftOutWarning")
def test_a_command_prints_one_line_of_it(large, tmp_path, run):
    bad = large.copy()
    bad[:, :, :, :8] = np.inf
    code, _, err = run("analyze", Samples.from_array(bad).save(tmp_path / "s.zarr").path)
    assert code == 0
    assert [line for line in err.splitlines() if line.startswith("chdstat:")] == [
        "chdstat: 25.0 % of the samples (1152 of 4608) are bad and were left out: "
        "0 NaN or masked, 1152 infinite"
    ]


# --- arrays of nothing --------------------------------------------------------------------------


@pytest.mark.parametrize("name", TAKING)
def test_no_pixels_have_no_results(name):
    for shape in ((0, 3, 16), (0, 2, 3, 16), (2, 3, 0, 16), (2, 3, 3, 0)):
        with contextlib.suppress(InputError):
            assert np.size(TAKING[name](np.zeros(shape))) == 0


@pytest.mark.parametrize("name", TAKING)
def test_what_is_no_array_is_refused_in_words(x, name):
    for nothing in (None, "x", [[1, 2], [3]], x > 1, x * 1j, xr.Dataset({"x": (DIMS, x)}), 3.0):
        if isinstance(nothing, xr.Dataset) and name.startswith("fit."):
            continue  # takes log histograms of an image
        with pytest.raises((InputError, StoreError)):  # a string may be the path of a store
            TAKING[name](nothing)
