"""Files of references: what is written is read again, and sums over windows stay right."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.inference import Reference
from chdstat.io import read_exr, write_exr, write_reference
from chdstat.io.exr import _read_planes
from tests.io.writers import exr

ABOUT = {
    "scene": "box 1.2",
    "scene_hash": "12",
    "seed": 7,
    "integrator": {"type": "path", "max_depth": 6},
    "filter": "box",
}


def heavy(shape=(24, 32, 3, 48), seed=1):
    """Return batches whose brightest samples decide, beside dim pixels and null ones."""
    rng = np.random.default_rng(seed)
    light = 10 ** rng.uniform(-4, 2, (*shape[:2], 1, 1))
    return light * rng.pareto(1.5, shape) * (rng.random((*shape[:2], 1, shape[3])) < 0.3)


def made(batches, **options):
    return Reference.of_samples(chd.Samples.from_array(batches, **ABOUT), **options)


def through(reference, tmp_path):
    return Reference.read(write_reference(reference, tmp_path / "reference.exr"))


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_reference_is_read_as_it_was_written(tmp_path, channels):
    reference = made(heavy((6, 5, channels, 96)))
    found = through(reference, tmp_path)
    np.testing.assert_array_equal(found.mean, reference.mean.astype(np.float32))
    assert (found.spp, found.known, found.precision) == (96, "batches", reference.precision)
    assert found.attrs == ABOUT
    assert not found.bad.any()
    assert found.batches.dtype == np.float32


def test_deviations_keep_seven_bits(tmp_path):
    reference = made(heavy())
    found = through(reference, tmp_path)
    exact = reference.batches - reference.mean[..., np.newaxis]
    moved = found.batches - reference.batches
    size = np.abs(exact)
    usual = size.mean(axis=-1, keepdims=True)
    assert (np.abs(moved) <= 2.0**-7 * (size + usual) + 2.0**-20 * usual).all()
    spread = np.sqrt((moved**2).mean() / (exact**2).mean())
    assert spread < 1 / 150
    # The mean of the batches is exact.
    np.testing.assert_allclose(found.batches.mean(axis=-1, dtype=float), found.mean, rtol=3e-6)


@pytest.mark.parametrize("edge", [1, 2, 4, 8, 24])
def test_sums_over_windows_stay_right(tmp_path, edge):
    """Over batches, their error varies by less than a hundredth of what they vary by.

    Negative control: rounded down, deviations of many pixels move a sum together.
    """
    reference = made(heavy())
    found = through(reference, tmp_path)

    def sums(x):
        rows, columns = (size // edge for size in x.shape[:2])
        x = x[: rows * edge, : columns * edge]
        return x.reshape(rows, edge, columns, edge, *x.shape[2:]).sum(axis=(1, 3), dtype=float)

    exact = sums(reference.batches)
    spread = exact.std(axis=-1)

    def errors(batches):
        moved = np.sqrt(((sums(batches) - exact) ** 2).mean(axis=-1))
        return float((moved[spread > 0] / spread[spread > 0]).max())

    assert errors(found.batches) < 0.01
    mantissa, exponent = np.frexp(reference.batches - reference.mean[..., np.newaxis])
    down = np.ldexp(np.floor(mantissa * 2**7) / 2**7, exponent)
    assert errors(reference.mean[..., np.newaxis] + down) > 0.01


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**40])
def test_the_unit_of_radiance_does_not_matter(tmp_path, unit):
    one, other = (through(made(heavy() * factor), tmp_path) for factor in (1.0, unit))
    np.testing.assert_array_equal(one.batches * np.float32(unit), other.batches)
    kinds = {n: p.dtype for n, p in _read_planes(tmp_path / "reference.exr").channels.items()}
    assert kinds["R"] == np.float32
    assert kinds["batch.00.R"] == kinds["batch.47.B"] == np.float16


def test_what_half_floats_cannot_hold_is_float(tmp_path):
    batches = heavy()
    batches[0, 0, 0, 0] = 1e15
    reference = made(batches)
    found = through(reference, tmp_path)
    planes = _read_planes(tmp_path / "reference.exr").channels
    assert {p.dtype for p in planes.values()} == {np.dtype(np.float32)}
    one, other = ((x.batches - x.mean[..., np.newaxis])[5:] for x in (reference, found))
    assert one == pytest.approx(other, rel=2**-6, abs=2**-10 * np.abs(one).max())


def test_bad_samples_stay_in_their_pixel(tmp_path):
    samples = heavy((6, 5, 3, 96))
    samples[2, 3, 1, :2] = np.nan  # a batch
    samples[4, 4] = np.inf  # a pixel
    reference = made(samples)
    found = through(reference, tmp_path)
    np.testing.assert_array_equal(np.isnan(found.batches), np.isnan(reference.batches))
    np.testing.assert_array_equal(found.bad, reference.bad.astype(np.float32))
    assert found.bad[2, 3] == np.float32(2 / 96)
    assert np.argwhere(np.isnan(found.mean).any(axis=-1)).tolist() == [[4, 4]]


def test_samples_that_a_pixel_lacks_are_not_bad():
    samples = heavy((2, 3, 3, 96))
    samples[0, 1, 0, 5] = np.nan
    counts = np.full((2, 3), 96)
    counts[1, 2] = 48
    found = Reference.of_samples(chd.Samples.from_array(samples, counts=counts))
    assert found.bad[0, 1] == pytest.approx(1 / 96)
    assert found.bad.sum() == pytest.approx(1 / 96)
    assert np.isnan(found.batches[1, 2, 0]).sum() == 24


def test_equal_references_are_equal_files(tmp_path):
    files = [write_reference(made(heavy()), tmp_path / name) for name in ("a.exr", "b.exr")]
    assert files[0].read_bytes() == files[1].read_bytes()
    slow = chd.Samples.from_array(heavy(), **ABOUT, render_seconds=3.0)
    other = write_reference(Reference.of_samples(slow), tmp_path / "c.exr")
    assert other.read_bytes() == files[0].read_bytes()


def test_any_viewer_shows_the_mean(tmp_path):
    reference = made(heavy())
    found = read_exr(write_reference(reference, tmp_path / "a.exr"))
    np.testing.assert_array_equal(found.image, reference.mean.astype(np.float32))
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert file.header()["integrator"] == '{"max_depth": 6, "type": "path"}'


@pytest.mark.parametrize("spp", [None, 64])
@pytest.mark.parametrize("varies", [False, True])
def test_references_without_batches_are_written_too(tmp_path, spp, varies):
    mean, variance = np.random.default_rng(1).gamma(2.0, size=(2, 4, 5, 3))
    reference = Reference(mean, variance if varies else None, spp)
    found = through(reference, tmp_path)
    assert (found.spp, found.known, found.precision) == (spp, reference.known, reference.precision)
    if varies:
        np.testing.assert_array_equal(found.variance, variance.astype(np.float32))


def test_the_variance_of_a_sample_is_that_of_batches(tmp_path):
    reference = made(heavy((4, 5, 3, 96)))
    expected = 2 * reference.batches.var(axis=-1, ddof=1)
    np.testing.assert_allclose(reference.variance, expected)
    np.testing.assert_allclose(through(reference, tmp_path).variance, expected, rtol=2.0**-6)


def test_infinite_batches_are_unknown_ones(tmp_path):
    batches = heavy((4, 5, 3, 48))
    batches[1, 2, 0, 3] = np.inf
    mean = np.where(np.isfinite(batches), batches, 0).mean(axis=-1)
    found = through(Reference(mean, spp=48, batches=batches), tmp_path)
    assert np.argwhere(~np.isfinite(found.batches)).tolist() == [[1, 2, 0, 3]]
    assert np.isnan(found.batches[1, 2, 0, 3])


def test_the_dimmest_batches_are_written(tmp_path):
    dim = np.zeros((4, 5, 3, 48))
    dim[..., ::3] = 1e-310
    found = through(Reference(dim.mean(axis=-1), spp=48, batches=dim), tmp_path)
    assert np.isfinite(found.batches).all()


def test_black_batches_are_black_again(tmp_path):
    found = through(made(np.zeros((4, 5, 3, 48))), tmp_path)
    assert not found.batches.any()


def damaged(tmp_path, *, without=(), **texts):
    """Write a reference, and write it again with other texts and layers."""
    held = read_exr(write_reference(made(heavy((4, 5, 3, 48))), tmp_path / "a.exr"))
    extra = {n: x for n, x in held.extra.items() if n not in without}
    about = {n: t for n, t in (held.attributes | texts).items() if t is not None}
    return write_exr(tmp_path / "b.exr", held.image, extra=extra, attributes=about)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"without": ["batch.07"]}, "batch.07"),
        ({"spp": None}, "spp"),
        ({"spp": "many"}, "many"),
        ({"spp": "-48"}, "-48"),
        ({"spp": "47"}, "47"),
        ({"batches": "0"}, "batches"),
        ({"batches": "3"}, "3"),
        ({"batches": "1000000000"}, "batch.48"),
        ({"batches": "[]"}, "batches"),
        ({"batchScale": None}, "batchScale"),
        ({"batchScale": "0"}, "batchScale"),
        ({"batchScale": "NaN"}, "batchScale"),
        ({"batchScale": "[1]"}, "list"),
        ({"precision": "7"}, "precision"),
        ({"precision": "null"}, "NoneType"),
        ({"chdstatReference": "2"}, "layout 2"),
    ],
)
def test_damaged_references_are_refused(tmp_path, changes, named):
    path = damaged(tmp_path, **changes)
    with pytest.raises(StoreError, match=rf"b\.exr.*{named}"):
        Reference.read(path)


def test_layers_of_other_channels_are_refused(tmp_path):
    path = damaged(tmp_path)
    held = {n: np.asarray(p) for n, p in _read_planes(path).channels.items()}
    held["batch.03.Q"] = held.pop("batch.03.G")
    about = read_exr(path).attributes
    with pytest.raises(StoreError, match=r"batch\.03"):
        Reference.read(exr(tmp_path / "c.exr", held, **about))


def test_what_a_file_says_is_not_given_again(tmp_path):
    path = damaged(tmp_path)
    for options in ({"spp": 48}, {"variance": path}):
        with pytest.raises(InputError, match=next(iter(options))):
            Reference.read(path, **options)


def test_a_contrast_with_a_file_is_that_in_memory(tmp_path):
    """Rounded batches move p-values by less than the permutations themselves do."""
    rng = np.random.default_rng(4)
    samples = rng.gamma(0.3, size=(16, 16, 3, 384)).astype(np.float32)
    reference = Reference.of_samples(samples[..., 96:])
    for light in (1, 0.8):
        one = chd.contrast(light * samples[..., :96], reference)
        other = chd.contrast(light * samples[..., :96], through(reference, tmp_path))
        assert other.outcome == one.outcome
        assert other.image_p_value == pytest.approx(one.image_p_value, rel=0.2)
        assert other.detectable == pytest.approx(one.detectable, rel=0.02)
        np.testing.assert_allclose(other.p_value, one.p_value, atol=0.02, rtol=0.05)
