"""References of other programs: layers and files mean what their programs say."""

from __future__ import annotations

import re

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.arrays import LUMINANCE
from chdstat.errors import InputError, StoreError
from chdstat.inference import Reference
from chdstat.io import write_exr, write_image, write_maps
from chdstat.io.exr import from_xyz
from tests.io.writers import exr, planes_of

SPP = 4096


def samples(seed=1, shape=(6, 8), spp=SPP):
    """Return samples (y, x, channel, sample), in each pixel of one colour."""
    rng = np.random.default_rng(seed)
    colour = rng.uniform(0.2, 1, (*shape, 3, 1))
    return colour * rng.gamma(0.7, size=(*shape, 1, spp))


def to_xyz(x):
    return np.einsum("ij,yxj...->yxi...", np.linalg.inv(from_xyz()), x)


def of_moment(path, x, kind=np.float32, name="nested", **more):
    """Write what Mitsuba's integrator ``moment`` does."""
    xyz = to_xyz(x)
    planes = planes_of(x.mean(axis=-1))
    planes |= planes_of(xyz.mean(axis=-1), "XYZ", f"{name}.")
    planes |= planes_of((xyz**2).mean(axis=-1), "XYZ", f"m2_{name}.")
    planes |= more
    return exr(path, {n: p.astype(kind) for n, p in planes.items()}, generatedBy="Mitsuba 3.9.1")


def test_an_image_alone_says_nothing_of_its_noise(tmp_path):
    x = samples().mean(axis=-1)
    found = Reference.read(write_exr(tmp_path / "a.exr", x))
    assert (found.known, found.spp, found.variance) == ("exact", None, None)
    assert "no noise" in found.cannot_show[0]
    assert any("filter" in sentence for sentence in found.cannot_show)


@pytest.mark.parametrize("name", ["samplesPerPixel", "cycles.View Layer.samples"])
def test_a_header_says_of_how_many_samples_an_image_is(tmp_path, name):
    value = 512 if name == "samplesPerPixel" else "512"
    x = samples().mean(axis=-1).astype(np.float32)
    path = exr(tmp_path / "a.exr", planes_of(x), **{name: value})
    found = Reference.read(path)
    assert (found.spp, found.known) == (512, "spp")
    assert Reference.read(path, spp=64).spp == 64


def test_a_pfm_file_is_an_image(tmp_path):
    x = samples().mean(axis=-1).astype(np.float32)
    for image in (x, x[..., :1]):
        path = write_image(tmp_path / "a.pfm", image)
        np.testing.assert_array_equal(Reference.read(path).mean, image)
    big = b"PF\n8 6\n1.0\n" + x[::-1].astype(">f4").tobytes()
    (tmp_path / "b.pfm").write_bytes(big)
    np.testing.assert_array_equal(Reference.of(tmp_path / "b.pfm").mean, x)


@pytest.mark.parametrize("content", [b"", b"PF\n8 6\n", b"PF\n8 6\n-1.0\n1234", b"P6\n1 1\n255\n"])
def test_damaged_pfm_files_are_refused(tmp_path, content):
    (tmp_path / "a.pfm").write_bytes(content)
    with pytest.raises(StoreError, match=r"a\.pfm"):
        Reference.read(tmp_path / "a.pfm")


def test_layers_of_variances_are_those_of_a_sample(tmp_path):
    x = samples()
    mean, variance = x.mean(axis=-1), x.var(axis=-1, ddof=1)
    path = write_exr(tmp_path / "a.exr", mean, extra={"variance": variance})
    found = Reference.read(path)
    np.testing.assert_allclose(found.variance, variance, rtol=1e-6)
    assert found.known == "variance"
    assert "number of samples" in found.cannot_show[0]
    assert Reference.read(path, spp=SPP).spp == SPP


def test_maps_of_a_summary_are_a_reference(tmp_path):
    x = samples(spp=64).astype(np.float32)
    path = write_maps(chd.summarize(chd.Samples.from_array(x)), tmp_path / "a.exr")
    found = Reference.read(path)
    np.testing.assert_allclose(found.mean, x.mean(axis=-1), rtol=1e-5)
    np.testing.assert_allclose(found.variance, x.var(axis=-1, ddof=1), rtol=1e-4)


def test_moments_of_mitsuba_give_variances(tmp_path):
    x = samples()
    found = Reference.read(of_moment(tmp_path / "a.exr", x))
    np.testing.assert_allclose(found.mean, x.mean(axis=-1), rtol=1e-6)
    np.testing.assert_allclose(found.variance, x.var(axis=-1), rtol=1e-3)
    assert (found.precision, found.attrs) == (0, {"renderer": "Mitsuba 3.9.1"})
    assert any("covariances" in sentence for sentence in found.cannot_show)


def test_variances_of_changing_colours_are_not_too_small(tmp_path):
    """Luminance is exact; R, G and B that vary apart from each other are the worst case."""
    rng = np.random.default_rng(2)
    x = rng.gamma(0.7, size=(6, 8, 3, SPP))
    found = Reference.read(of_moment(tmp_path / "a.exr", x))
    assert (found.variance > x.var(axis=-1) / 4).all()
    light = np.einsum("yxcs,c->yxs", x, LUMINANCE.astype(float)).var(axis=-1)
    assert (found.variance[..., 1] >= 0.9 * light).all()


def test_moments_of_several_integrators_are_those_of_the_image(tmp_path):
    x, other = samples(1), to_xyz(samples(2))
    more = planes_of(other.mean(axis=-1), "XYZ", "a.")
    more |= planes_of((other**2).mean(axis=-1), "XYZ", "m2_a.")
    found = Reference.read(of_moment(tmp_path / "a.exr", x, **more))
    np.testing.assert_allclose(found.variance, x.var(axis=-1), rtol=1e-3)


def test_rounded_moments_make_no_variance_too_small(tmp_path):
    rng = np.random.default_rng(1)
    x = 1 + 1e-3 * rng.normal(size=(6, 8, 1, SPP)) * np.ones((1, 1, 3, 1))
    exact = x.var(axis=-1)
    found = Reference.read(of_moment(tmp_path / "a.exr", x, np.float16))
    assert (found.variance >= exact).all()
    assert found.precision == 2.0**-11
    assert any("rounding errors" in sentence for sentence in found.cannot_show)


def test_moments_without_their_means_are_refused(tmp_path):
    planes = planes_of(samples().mean(axis=-1)) | {"m2_a.Y": np.ones((6, 8), np.float32)}
    with pytest.raises(StoreError, match="X, Y, Z"):
        Reference.read(
            exr(tmp_path / "a.exr", {n: p.astype(np.float32) for n, p in planes.items()})
        )


def of_pbrt(path, x, kind=np.float16):
    """Write what a gbuffer film of pbrt-v4 does, whose sensor measures X, Y and Z."""
    variance = to_xyz(x).var(axis=-1, ddof=1)
    planes = planes_of(x.mean(axis=-1)) | planes_of(variance, "RGB", "Variance.")
    planes |= planes_of(variance, "RGB", "RelativeVariance.")
    planes |= planes_of(np.zeros((6, 8, 3)), "XYZ", "N.")
    return exr(path, {n: p.astype(kind) for n, p in planes.items()}, samplesPerPixel=SPP)


def test_variances_of_pbrt_are_those_of_its_sensor(tmp_path):
    x = samples()
    found = Reference.read(of_pbrt(tmp_path / "a.exr", x))
    np.testing.assert_allclose(found.variance, x.var(axis=-1), rtol=2e-2)
    assert (found.spp, found.known) == (SPP, "variance")
    assert any("hit no surface" in sentence for sentence in found.cannot_show)


@pytest.mark.parametrize("kind", ["rgb", "mono", "spectral"])
def test_variances_of_mitsubas_tests_are_of_xyz(tmp_path, kind):
    x = samples()
    xyz = np.repeat(x[:, :, :1], 3, axis=2) if kind == "mono" else to_xyz(x)
    for name, values in (("", xyz.mean(axis=-1)), ("_var", xyz.var(axis=-1))):
        write_exr(tmp_path / f"a_ref_{kind}{name}.exr", values @ from_xyz().T)
    path = tmp_path / f"a_ref_{kind}.exr"
    for found in (Reference.read(path), Reference.read(path, variance=f"{path}"[:-4] + "_var.exr")):
        expected = x if kind != "mono" else x[:, :, :1]
        np.testing.assert_allclose(found.mean, expected.mean(axis=-1), rtol=1e-4)
        assert (found.variance >= 0.999 * expected.var(axis=-1)).all()
        np.testing.assert_allclose(found.variance, expected.var(axis=-1), rtol=1e-2)
        assert found.spp is None


def test_differences_of_halves_do_not_say_that_nothing_varies(tmp_path):
    write_exr(tmp_path / "a_ref_rgb_var.exr", np.zeros((6, 8, 3)))
    found = Reference.read(write_exr(tmp_path / "a_ref_rgb.exr", np.ones((6, 8, 3))))
    assert (found.variance >= 2.0**-12).all()


def test_opposite_primaries_add_variance(tmp_path):
    """Where only Y varies, R varies by 1.54 times as much, downwards."""
    rng = np.random.default_rng(5)
    xyz = np.ones((6, 8, 3, SPP)) * [[[[1.0], [1.0], [1.0]]]]
    xyz[:, :, 1] += rng.normal(size=(6, 8, SPP))
    x = np.einsum("ij,yxj...->yxi...", from_xyz(), xyz)
    found = Reference.read(of_moment(tmp_path / "a.exr", x))
    assert (found.variance >= 0.99 * x.var(axis=-1)).all()


def test_a_file_of_variances_beside_an_image_is_taken(tmp_path):
    x = samples()
    path = write_exr(tmp_path / "a.exr", x.mean(axis=-1))
    write_exr(tmp_path / "a_var.exr", x.var(axis=-1))
    np.testing.assert_allclose(Reference.read(path).variance, x.var(axis=-1), rtol=1e-6)
    other = write_exr(tmp_path / "other.exr", 2 * x.var(axis=-1))
    found = Reference.read(path, variance=other)
    np.testing.assert_allclose(found.variance, 2 * x.var(axis=-1), rtol=1e-6)


def test_negative_and_unknown_variances_stay_in_their_pixel(tmp_path):
    x = samples().mean(axis=-1)
    variance = np.ones_like(x)
    variance[1, 2], variance[3, 4] = -1, np.nan
    write_exr(tmp_path / "a_var.exr", variance)
    found = Reference.read(write_exr(tmp_path / "a.exr", x)).variance
    assert not found[1, 2].any()
    assert np.isnan(found[3, 4]).all()
    assert np.isnan(found).sum() == 3


def test_variances_of_another_size_are_refused(tmp_path):
    path = write_exr(tmp_path / "a.exr", np.ones((6, 8, 3)))
    write_exr(tmp_path / "a_var.exr", np.ones((6, 7, 3)))
    with pytest.raises(InputError, match=r"\(6, 8, 3\).*\(6, 7, 3\).*a_var"):
        Reference.read(path)


def test_variances_are_not_given_twice(tmp_path):
    path = of_pbrt(tmp_path / "a.exr", samples())
    with pytest.raises(InputError, match="variances itself"):
        Reference.read(path, variance=path)


def statmc(folder, x, suffix, count=None):
    n = np.full((*x.shape[:2], 1), float(x.shape[-1])) if count is None else count
    mean = x.mean(axis=-1)
    squares = ((x - mean[..., np.newaxis]) ** 2).sum(axis=-1)
    for name, values in (("film-mean", mean), ("film-m2", squares), ("n", n)):
        write_image(folder / f"box-64-t0-b0-{name}{suffix}", values.astype(np.float32))
    return folder / f"box-64-t0-b0-film-mean{suffix}"


@pytest.mark.parametrize("suffix", [".exr", ".pfm"])
def test_moments_of_statmc_give_variances(tmp_path, suffix):
    x = samples(spp=64)
    found = Reference.read(statmc(tmp_path, x, suffix))
    np.testing.assert_allclose(found.variance, x.var(axis=-1, ddof=1), rtol=1e-5)
    assert (found.spp, found.precision) == (64, 0)


def test_pixels_of_more_samples_have_less_noise(tmp_path):
    x = samples(spp=64)
    count = np.full((6, 8, 1), 64.0)
    count[2, 3] = 256
    found = Reference.read(statmc(tmp_path, x, ".pfm", count))
    squares = x.var(axis=-1) * 64
    assert found.spp == 64
    np.testing.assert_allclose(found.variance[2, 3] / 64, squares[2, 3] / 255 / 256, rtol=1e-5)


def test_moments_of_statmc_are_needed_together(tmp_path):
    path = statmc(tmp_path, samples(spp=64), ".pfm")
    (tmp_path / "box-64-t0-b0-n.pfm").unlink()
    with pytest.raises(StoreError, match=re.escape("b0-n.pfm")):
        Reference.read(path)
    write_image(tmp_path / "box-64-t0-b0-n.pfm", np.ones((6, 8, 1), np.float32))
    with pytest.raises(InputError, match="at least 2 samples"):
        Reference.read(path)


def test_passes_in_a_folder_are_batches(tmp_path):
    x = samples(spp=12 * 16).astype(np.float32)
    means = x.reshape(6, 8, 3, 12, 16).mean(axis=-1)
    for k in range(12):
        exr(tmp_path / f"{k:02}.exr", planes_of(means[..., k]), samplesPerPixel=16)
    found = Reference.read(tmp_path)
    assert (found.spp, found.known) == (12 * 16, "batches")
    np.testing.assert_allclose(found.batches, means, rtol=1e-5)
    for k in range(7, 12):
        (tmp_path / f"{k:02}.exr").unlink()
    with pytest.raises(InputError, match="at least 8"):
        Reference.read(tmp_path)


def test_an_image_without_pixels_is_refused(tmp_path):
    (tmp_path / "a.pfm").write_bytes(b"PF\n0 0\n-1.0\n")
    with pytest.raises(InputError, match=r"\(0, 0, 3\)"):
        Reference.read(tmp_path / "a.pfm")
