"""Hand-over to Open Image Denoise: what goes in, what comes back, and what is refused.

The network itself is replaced by a blur where the law at hand is not about it.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.io import denoise


def noisy(shape=(32, 32, 3), seed=0):
    """Exponential noise around a ramp."""
    ramp = np.linspace(1, 3, shape[1])[:, np.newaxis]
    return ramp * np.random.default_rng(seed).exponential(size=shape)


@pytest.fixture
def calls(monkeypatch):
    """Replace the network by one that halves the radiance, and record what it is given."""
    seen = []

    def network(images, **options):
        color = images["color"]
        assert all(image.dtype == np.float32 for image in images.values())
        assert np.isfinite(color).all()
        seen.append((color, {**images, **options}))
        return color / 2

    monkeypatch.setattr("chdstat._core.denoiser.run_network", network)
    return seen


@pytest.mark.parametrize("factor", [1e-30, 7.0])
def test_the_network_sees_the_same_exposure_in_any_unit(calls, factor):
    x = noisy()
    found = denoise(factor * x)
    assert found == pytest.approx(factor * x / 2, rel=1e-6)
    assert np.exp(np.log(calls[0][0].mean(axis=-1)).mean()) == pytest.approx(0.18, rel=1e-5)


def test_display_values_are_handed_over_as_they_are(calls):
    x = noisy() / 100
    denoise(x, hdr=False)
    color, options = calls[0]
    assert color == pytest.approx(x, rel=1e-6)
    assert options.keys() == {"color", "hdr"}
    assert not options["hdr"]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 3])
def test_shape_and_dtype_stay(calls, dtype, channels):
    x = noisy((6, 5, channels)).astype(dtype)
    found = denoise(x)
    assert found.dtype == dtype
    assert found == pytest.approx(x / 2, rel=1e-5)
    assert calls[0][0].shape == (6, 5, 3)


def test_certainty_keeps_the_estimate_as_far_as_it_goes(calls):
    x = noisy((8, 8, 3))
    certainty = np.linspace(0, 1, 64).reshape(8, 8)
    keep = certainty[..., np.newaxis]
    assert denoise(x, certainty=certainty) == pytest.approx(x * (1 + keep) / 2, rel=1e-6)
    assert denoise(x, certainty=np.broadcast_to(keep, x.shape)) == pytest.approx(
        denoise(x, certainty=certainty)
    )
    assert denoise(x, certainty=np.ones((8, 8))) == pytest.approx(x, rel=1e-12)


def test_features_are_handed_over(calls):
    albedo = np.full((8, 8, 3), 0.5)
    albedo[0, 0], albedo[0, 1] = np.nan, 10.0
    normal = np.full((8, 8, 3), -1.0000001)
    denoise(noisy((8, 8, 3)), albedo=albedo, normal=normal)
    options = calls[0][1]
    assert options["albedo"][0, 0].tolist() == [0, 0, 0]
    assert options["albedo"][0, 1].tolist() == [1, 1, 1]
    assert options["albedo"][1, 1].tolist() == [0.5] * 3
    assert options["normal"].min() == -1


def test_bad_radiance_comes_back_nan(calls):
    x = noisy((8, 8, 3))
    spoilt = x.copy()
    spoilt[2, 2, 0], spoilt[5, 6, 1], spoilt[0, 0, 2] = np.nan, np.inf, -1.0
    found = denoise(spoilt, certainty=np.ones((8, 8)))
    bad = np.zeros((8, 8), bool)
    bad[[2, 5, 0], [2, 6, 0]] = True
    assert np.isnan(found[bad]).all()
    assert found[~bad] == pytest.approx(x[~bad], rel=1e-12)
    around = np.delete(x[1:4, 1:4].reshape(9, 3), 4, axis=0).mean(axis=0)
    unit = x[7, 7] / calls[0][0][7, 7]
    assert calls[0][0][2, 2] * unit == pytest.approx(around, rel=1e-5)


def test_a_black_image_stays_black(calls):
    assert not denoise(np.zeros((4, 4, 3))).any()
    assert np.isnan(denoise(np.full((4, 4, 3), np.nan))).all()


def test_without_the_denoiser_an_error_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match="pip install .*pyoidn"):
        denoise(noisy())


# --- the network itself ---------------------------------------------------------------------------


def test_noise_goes_and_the_image_stays():
    """Exponential noise: the image's mean has a standard error of 1 %; tolerated are 10 %."""
    x = noisy((64, 64, 3))
    truth = np.broadcast_to(np.linspace(1, 3, 64)[:, np.newaxis], x.shape)
    found = denoise(x)
    assert ((found - truth) ** 2).mean() < 0.1 * ((x - truth) ** 2).mean()
    assert found.mean() == pytest.approx(x.mean(), rel=0.1)


@pytest.mark.parametrize("factor", [1e-30, 1e20])
def test_scaling_the_radiance_scales_what_is_denoised(factor):
    x = noisy()
    assert denoise(factor * x) == pytest.approx(factor * denoise(x), rel=2e-3)


LAYOUTS = """
import json
import numpy as np
from chdstat.io import denoise

rng = np.random.default_rng(0)
whole = rng.exponential(size=(40, 56, 3)), rng.random((40, 56, 3)), rng.uniform(-1, 1, (40, 56, 3))
orders = [(0, 1, 2), (2, 1, 0), (1, 0, 2), (2, 0, 1)]

def laid_out(image, order):
    return np.ascontiguousarray(image.transpose(order)).transpose(np.argsort(order))

found = []
for channels in (1, 3):
    for order in orders:
        image, albedo, normal = (laid_out(x, order) for x in whole)
        image = laid_out(image[..., :channels], order)
        found.append(denoise(image, albedo=albedo, normal=normal).tolist())
print(json.dumps(found))
"""


def test_an_image_may_lie_in_memory_in_any_order():
    # The library is given addresses; those of copies that are gone would end the process.
    done = subprocess.run([sys.executable, "-c", LAYOUTS], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for of_channels in (found[:4], found[4:]):
        for other in of_channels[1:]:
            assert np.array_equal(of_channels[0], other)


def test_inputs_stay_as_they_are():
    x = noisy()
    before = x.copy()
    denoise(x, certainty=np.zeros(x.shape[:2]))
    assert np.array_equal(x, before)
