"""Samples written to stores: as they were, appended to, resumed, and with counts of their own."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError, LeftOutWarning, StoreError
from chdstat.samples.store import Store
from tests.stops import counted, stopped

RNG = np.random.default_rng(3)
RADIANCE = RNG.gamma(2.0, size=(70, 5, 3, 100)).astype(np.float32)
COUNTS = RNG.integers(0, 101, size=(70, 5))
COUNTS[3, 4] = 37


def test_provenance_is_kept_as_text_and_numbers(tmp_path):
    given = {
        "seed": np.int64(7),
        "integrator": "path",
        "notes": "dusk",
        "exposure": np.float32(0.5),
        "view": np.eye(2),
        "file": tmp_path,
        "gain": np.nan,
        "sequence": None,
    }
    kept = {
        "seed": 7,
        "integrator": {"type": "path"},
        "notes": ["dusk"],
        "exposure": 0.5,
        "view": [[1, 0], [0, 1]],
        "file": str(tmp_path),
        "gain": "NaN",
    }
    saved = chd.Samples.from_array(RADIANCE, **given).save(tmp_path / "own.zarr")
    assert {name: saved.attrs.get(name) for name in given} == {**kept, "sequence": None}
    assert "dusk" in saved._repr_html_()


def test_what_is_there_is_not_overwritten(tmp_path):
    samples = chd.Samples.from_array(RADIANCE)
    samples.save(tmp_path / "own.zarr")
    with pytest.raises(StoreError, match="already"):
        samples.save(tmp_path / "own.zarr")
    with pytest.raises(StoreError, match="other samples"):
        chd.Samples.from_array(RADIANCE * 2).save(tmp_path / "own.zarr")
    with pytest.raises(StoreError, match="imported"):
        chd.render("cornell-box", spp=4, size=(5, 70), out=tmp_path / "own.zarr", backend="scalar")
    with pytest.raises(StoreError, match="no store at"):
        samples.save(tmp_path / "none.zarr", append=True)
    assert np.array_equal(chd.open(tmp_path / "own.zarr").read(), RADIANCE)


def test_samples_are_appended_behind_others(tmp_path):
    first, second = (chd.Samples.from_array(x, seed=s) for s, x in enumerate((RADIANCE, -RADIANCE)))
    first.save(tmp_path / "own.zarr")
    found = second.save(tmp_path / "own.zarr", append=True)
    assert np.array_equal(found.read(), np.concatenate([RADIANCE, -RADIANCE], axis=-1))
    with pytest.raises(InputError, match="already"):
        second.save(tmp_path / "own.zarr", append=True)
    with pytest.raises(InputError, match="seed 1 already"):
        chd.Samples.from_array(RADIANCE + 1, seed=1).save(tmp_path / "own.zarr", append=True)
    with pytest.raises(InputError, match=r"\(y, x, channel\)"):
        chd.Samples.from_array(RADIANCE[:9]).save(tmp_path / "own.zarr", append=True)
    with pytest.raises(InputError, match="as many"):
        chd.Samples.from_array(RADIANCE, counts=COUNTS).save(tmp_path / "own.zarr", append=True)


def test_saving_again_repairs_what_is_damaged(tmp_path):
    samples = chd.Samples.from_array(RADIANCE)
    samples.save(tmp_path / "own.zarr")
    (tmp_path / "own.zarr/radiance/c/0/0/0/1").unlink()
    with pytest.raises(StoreError, match="import again"):
        chd.open(tmp_path / "own.zarr").read()
    assert np.array_equal(samples.save(tmp_path / "own.zarr").read(), RADIANCE)


@pytest.mark.parametrize("append", [False, True])
def test_what_was_interrupted_goes_on(tmp_path, append):
    path = tmp_path / "own.zarr"
    if append:
        chd.Samples.from_array(RADIANCE).save(path)
    samples = chd.Samples.from_array(RADIANCE[..., ::-1])
    with stopped(Store, "write", 2) as written:
        samples.save(path, append=append)
    with counted(Store, "write") as again:
        found = samples.save(path, append=append)
    expected = [RADIANCE, RADIANCE[..., ::-1]] if append else [RADIANCE[..., ::-1]]
    assert np.array_equal(found.read(), np.concatenate(expected, axis=-1))
    assert not {c.index for _, c, _ in again} & {c.index for _, c, _ in written}


def test_a_saved_part_of_a_render_is_not_paired_with_it(cornell, tmp_path):
    x = cornell.first(4)
    part = x.isel(y=slice(2, 6)).save(tmp_path / "part.zarr")
    assert not part.shares_numbers_with(x.isel(y=slice(4)))
    assert x.save(tmp_path / "whole.zarr").shares_numbers_with(x)


def test_a_pixel_has_the_samples_that_are_its_own(tmp_path):
    samples = chd.Samples.from_array(RADIANCE, counts=COUNTS)
    for found in (samples, samples.save(tmp_path / "own.zarr"), chd.open(tmp_path / "own.zarr")):
        assert np.array_equal(found.counts, COUNTS)
        assert np.array_equal(found[3, 4], RADIANCE[3, 4, :, : COUNTS[3, 4]])
        cut = found.isel(y=slice(10, 60, 2), sample=slice(7, 90, 3))
        assert cut.counts[4, 1] == len(range(7, min(90, COUNTS[18, 1]), 3))
        assert np.array_equal(np.isfinite(cut.read()[:, :, 0]).sum(axis=-1), cut.counts)
        assert found.to_dataset()["counts"].to_numpy().sum() == COUNTS.sum()
    assert "0 to 100 spp" in repr(samples)
    assert "biased" in samples._repr_html_()
    assert (samples.fewest, samples.spp_range) == (0, "0 to 100")
    with pytest.raises(InputError, match="64 spp, got 0"):
        chd.compare(samples)
    counts = np.full((70, 5), 100)
    assert not chd.Samples.from_array(RADIANCE, counts=counts).unequal
    counts[0, 0] = 30
    assert not chd.Samples.from_array(RADIANCE, counts=counts).first(30).unequal


def test_samples_that_a_pixel_lacks_are_not_bad(recwarn):
    samples = chd.Samples.from_array(RADIANCE, counts=COUNTS)
    found = chd.summarize(samples)
    assert not [w for w in recwarn if issubclass(w.category, LeftOutWarning)]
    assert np.array_equal(found["count"], COUNTS)
    assert not found["bad_count"].any()
    one = chd.summarize(RADIANCE[3:4, 4:5, :, : COUNTS[3, 4]])
    for name in ("mean", "variance", "standard_error", "maximum"):
        assert np.allclose(found[name][3, 4], one[name][0, 0], equal_nan=True), name


def test_a_pixel_is_described_as_if_it_were_alone():
    rng = np.random.default_rng(0)
    x = rng.gamma(2.0, size=(2, 3, 3, 400)) * (rng.random((2, 3, 1, 400)) < 0.8)
    counts = np.array([[400, 271, 316], [64, 0, 3]])
    samples = chd.Samples.from_array(x, counts=counts)
    functions = {
        "summarize": chd.summarize,
        "select": chd.fit.select,
        "tail": chd.fit.tail_index,
        "gaussianity": chd.gaussianity,
        "means": lambda s: chd.inference.gaussianity_of_means(s, sizes=[1, 2], n_means=32),
        "classify": chd.classify,
    }
    # What a pixel's neighbours decide, too, or the length of an axis.
    of_the_image = ("q_value", "q_exponential", "rejected", "n_needed", "agreement", "batch_means")
    of_the_image += ("tail_coverage", "tail_coverage_interval", "tail_variance_suspect")
    of_the_image += ("tail_variance_trusted", "tail_variance_unidentified")
    of_the_image += ("long_tail_statistic", "long_tail_se", "long_tail_interval", "long_tail")
    for name, function in functions.items():
        found = function(samples)
        for y, column in ((0, 0), (0, 1), (0, 2), (1, 0)):
            part = x[y : y + 1, column : column + 1, :, : counts[y, column]]
            one = function(chd.Samples.from_array(part, axes="yxcs"))
            for variable in one:
                if "y" not in one[variable].dims or str(variable).endswith(of_the_image):
                    continue
                here = found[variable].to_numpy()[y, column]
                alone = one[variable].to_numpy()[0, 0]
                same = (
                    np.array_equal(here, alone)
                    if alone.dtype.kind == "O"
                    else np.allclose(here, alone, rtol=1e-4, equal_nan=True)
                )
                assert same, (name, variable)


def test_attributes_of_another_store_are_not_taken_over(tmp_path):
    samples = chd.Samples.from_array(RADIANCE, appended=[{"first": 9}], manifest={}, scene_hash="a")
    attrs = samples.save(tmp_path / "own.zarr").attrs
    assert not {"appended", "scene_hash", "manifest"} & attrs.keys()
    chd.Samples.from_array(RADIANCE * 2).save(tmp_path / "own.zarr", append=True)
    assert chd.open(tmp_path / "own.zarr").spp == 200
