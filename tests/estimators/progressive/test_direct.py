"""Direct and indirect light apart: profiles, training, estimates, streams, comparisons."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch

import chdstat as chd
from chdstat.comparison import denoised
from chdstat.errors import InputError, StoreError
from chdstat.estimators import Profile, Progressive, Stream, lookup
from chdstat.estimators.models import train_model
from chdstat.estimators.progressive.dataset import OCTAVES, SampleSplits
from chdstat.estimators.progressive.error_model import error_terms
from chdstat.estimators.progressive.network import Network
from chdstat.estimators.progressive.online import BatchProfiles, BatchSplits
from chdstat.estimators.training import read_model, write_model
from chdstat.estimators.validation import direct_of


@dataclass(frozen=True)
class Lit:
    """An image with its direct part, and its radiance, shape (y, x, channel)."""

    samples: chd.Samples
    radiance: npt.NDArray[np.float64]

    def error(self, estimate: npt.NDArray[np.float32]) -> float:
        """Return the MSE."""
        return float(((estimate - self.radiance) ** 2).mean())


def lit(size=32, spp=128, *, seed=0, none=False) -> Lit:
    """Simulate pixels of a constant direct light of their own and rare, strong indirect light.

    The mean of the indirect light is the same everywhere: who knows which light is direct takes
    that from the samples and this from experience. With `none`, all light counts as indirect.
    """
    rng = np.random.default_rng(seed)
    shape = (size, size, 1, spp)
    direct = np.broadcast_to(np.exp(rng.uniform(-2, 2, size=(size, size, 1, 1))), shape)
    rare = (rng.random(shape) < 0.1) * rng.gamma(1.0, 4.0, size=shape)
    samples = chd.Samples.from_array(direct + rare, direct=np.zeros(shape) if none else direct)
    return Lit(samples, direct[..., 0] + 0.4)


def halves(shape=(6, 5, 3, 40), seed=0):
    """Return samples and a direct part of theirs."""
    rng = np.random.default_rng(seed)
    x = rng.lognormal(0, 3, size=shape) * (rng.random((*shape[:-2], 1, shape[-1])) < 0.6)
    return x.astype(np.float32), (x * rng.choice([0, 0.5, 1], size=shape)).astype(np.float32)


@pytest.fixture(scope="module")
def model():
    return Progressive(inputs=["direct"]).train(
        lit(24, 64).samples, sizes=(8,), iterations=30, progress=False
    )


# --- profiles -----------------------------------------------------------------------------------


def test_parts_keep_the_mean_and_are_the_profiles_of_each():
    x, direct = halves()
    found = Profile.of(x, unit=0.7, direct=direct)
    assert found.parts == 2
    assert found.bins.shape == (6, 5, 2 * OCTAVES, 4)
    assert found.mean() == pytest.approx(Profile.of(x, unit=0.7).mean(), rel=1e-5)
    for part, light in enumerate((direct, x - direct)):
        bins = found.bins[..., part * OCTAVES : (part + 1) * OCTAVES, :]
        expected = Profile.of(light, unit=0.7).bins
        assert bins == pytest.approx(expected, rel=1e-4, abs=1e-5 * float(expected.max()))


def test_parts_of_many_rows_and_of_none():
    x, direct = halves((3000, 3, 40))
    whole = Profile.of(x, unit=1.0, direct=direct)
    one = Profile.of(x[2999], unit=1.0, direct=direct[2999])
    assert whole.bins[2999] == pytest.approx(one.bins, rel=1e-5)
    assert Profile.of(x[:0], unit=1.0, direct=direct[:0]).bins.shape == (0, 2 * OCTAVES, 4)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_sample_that_is_bad_in_either_is_left_out_of_both(value):
    x, direct = halves((4, 3, 8))
    expected = Profile.of(x[..., 2:], unit=1.0, direct=direct[..., 2:])
    x[..., 0, 0], direct[..., 1, 1] = value, value
    found = Profile.of(x, unit=1.0, direct=direct)
    assert (found.count == 6).all()
    assert found.bins == pytest.approx(expected.bins, rel=1e-5)


def test_negative_samples_are_kept_in_either_part():
    x, direct = halves((4, 3, 8))
    x[..., 0, 0], direct[..., 1, 1] = -1, -2
    found = Profile.of(x, unit=1.0, direct=direct)
    assert (found.count == 8).all()
    bins = found.bins.reshape(4, 2, OCTAVES, 4).sum(axis=2)[..., 1:]
    assert bins[:, 0] == pytest.approx(direct.sum(axis=-1), rel=1e-5)
    assert bins[:, 1] == pytest.approx((x - direct).sum(axis=-1), rel=1e-5)


@pytest.mark.parametrize(
    ("level", "dtype"), [(1e30, np.float32), (1e-42, np.float32), (1e200, float)]
)
def test_parts_of_extreme_radiance(level, dtype):
    x = np.full((2, 3, 4), level, dtype)
    found = Profile.of(x, unit=max(min(level, 1e30), 1e-30), direct=x)
    assert (found.count == 4).all()
    assert not found.bins[:, OCTAVES:].any()


def test_rounding_is_forgiven_and_more_is_not():
    x = np.ones((2, 3, 4), np.float32)
    found = Profile.of(x, unit=1.0, direct=x * np.float32(1 + 1e-6))
    assert not found.bins[:, OCTAVES:].any()
    with pytest.raises(InputError, match=r"of one it is 1\.001 and the whole 1;"):
        Profile.of(x, unit=1.0, direct=x * 1.001)
    with pytest.raises(InputError, match=r"shape of the samples, \(2, 3, 4\), got \(2, 3, 3\)"):
        Profile.of(x, unit=1.0, direct=x[..., :3])


def test_parts_add_up():
    x, direct = halves()
    kept = Profile.empty((6, 5), 3, unit=1.0, parts=2)
    for part in (slice(0, 7), slice(7, 40)):
        kept.add(Profile.of(x[..., part], unit=1.0, direct=direct[..., part]))
    expected = Profile.of(x, unit=1.0, direct=direct)
    assert kept.bins == pytest.approx(expected.bins, rel=1e-4, abs=1e-4)


# --- what learns from them ----------------------------------------------------------------------


def test_splits_and_buckets_hold_the_parts_of_the_samples_they_draw():
    x, direct = halves((50, 3, 24))
    splits = SampleSplits(samples=x, unit=0.5, direct=direct)
    rows, drawn = splits.draw(np.arange(50), 8, 20, np.random.default_rng(0))
    profile, _, target = splits.minibatch(rows, drawn)
    expected = Profile.of(
        x[rows][..., drawn] / 0.5, unit=1.0, direct=direct[rows][..., drawn] / 0.5
    )
    assert profile.parts == 2
    assert profile.bins == pytest.approx(expected.bins, rel=1e-4, abs=1e-4)
    plain = SampleSplits(samples=x, unit=0.5)
    assert (plain.minibatch(rows, drawn)[2] == target).all()
    kept = BatchProfiles(50, 3, unit=0.5, parts=2)
    for first in range(0, 24, 6):
        kept.add(x[..., first : first + 6], direct[..., first : first + 6])
    batches = BatchSplits(batches=kept, chosen=np.arange(50))
    found = batches.minibatch(*batches.draw(np.arange(50), 12, 20, np.random.default_rng(0)))
    assert found[0].parts == 2
    both = kept.bins.sum(axis=0)
    assert both == pytest.approx(Profile.of(x, unit=0.5, direct=direct).bins, rel=1e-4, abs=1e-3)


def terms(output, profile):
    """Return the error terms of the first loss."""
    estimate, mean, certainty = (tensor.numpy().astype(np.float64) for tensor in output)
    return error_terms(estimate[:, 0], mean, certainty[:, 0], profile.variance_of_mean())


def test_a_network_of_parts_begins_near_the_mean():
    x, direct = halves((20, 3, 16))
    with torch.random.fork_rng():
        network = Network(3, parts=2).requires_grad_(requires_grad=False)
    profile = Profile.of(x, unit=1.0, direct=direct)
    output = network(profile, {})
    assert output[1].numpy() == pytest.approx(x.mean(axis=-1), rel=1e-4)
    assert np.isfinite(terms(output, profile)).all()
    assert (terms(output, profile) >= 0).all()


def test_constant_parts_have_no_noise():
    x = np.full((5, 3, 16), 3.0)
    profile = Profile.of(x, unit=1.0, direct=x / 3)
    with torch.random.fork_rng(), torch.inference_mode():
        output = Network(3, parts=2)(profile, {})
    # Octaves tell a sample's luminance to 1 %: what is left of the variance is of that.
    assert terms(output, profile)[..., 3] == pytest.approx(0, abs=0.02)


def test_a_network_of_old_files_has_one_part():
    shape = {"channels": 3, "described": 0, "neighbours": False, "width": 8, "layers": 1}
    with torch.random.fork_rng():
        network = Network(**shape)
    assert network.shape["parts"] == 1
    assert network.hidden[0].in_features == OCTAVES * 4 + 1


def error(image: Lit, fresh: Lit, *, direct: bool) -> float:
    """Train, and return the MSE on a new image at 32 spp over that of the mean."""
    model = Progressive(inputs=["direct"] if direct else []).train(
        image.samples, sizes=(32,), iterations=150, progress=False
    )
    few = fresh.samples.first(32)
    found = model.predict(few.read(), direct=direct_of(few).read(), loss_weight=0.0)
    return fresh.error(found) / fresh.error(few.read().mean(axis=-1))


@pytest.mark.slow
def test_parts_tell_more_than_the_whole():
    """Rare indirect light of a known mean beside direct light: fixed seeds, no failure by chance.

    Where all light counts as indirect, nothing is gained. Measured with three pairs of seeds: 0.12,
    0.12, 0.10 without the parts; 0.08, 0.09, 0.08 with them; 0.12, 0.12, 0.10 with empty ones.
    """
    image, fresh = lit(seed=0), lit(seed=1)
    plain = error(image, fresh, direct=False)
    assert error(image, fresh, direct=True) < 0.8 * plain
    same = error(lit(seed=0, none=True), lit(seed=1, none=True), direct=True)
    assert same == pytest.approx(plain, rel=0.1)


def test_without_a_reference_it_learns_from_parts():
    image = lit(16, 16)
    model = Progressive(inputs=["direct", "neighbours"]).train(
        image.samples, reference=False, iterations=20, progress=False
    )
    assert model.provenance["inputs"] == ["neighbours", "direct"]
    found = model.estimate(image.samples.read(), direct=image.samples.direct.read())
    assert np.isfinite(found.radiance).all()
    assert np.isfinite(found.high).all()


def test_it_is_saved_with_all_it_looks_at(tmp_path, model):
    image = lit(8, 8, seed=2)
    model.save(tmp_path / "a.safetensors")
    again = Progressive.load(tmp_path / "a.safetensors")
    assert again.inputs.direct
    given = image.samples.read(), {"direct": image.samples.direct.read()}
    assert (again.predict(given[0], **given[1]) == model.predict(given[0], **given[1])).all()
    assert "direct" in repr(again)


def test_files_of_earlier_versions_are_refused(tmp_path, trained):
    """Nothing is known of how far they pay, and some counted in another unit of the image."""
    trained.save(tmp_path / "new.safetensors")
    arrays, about = read_model(tmp_path / "new.safetensors")
    del arrays["trust.shares"]
    write_model(tmp_path / "old.safetensors", arrays, about)
    with pytest.raises(StoreError, match="earlier version, .* train it again"):
        Progressive.load(tmp_path / "old.safetensors")


def test_pixels_of_several_images_train_together():
    model = Progressive(inputs=["direct"]).train(
        [lit(12, 32, seed=k).samples for k in range(2)], sizes=(8,), iterations=5, progress=False
    )
    assert model.provenance["pixels_used"] == 144


def test_a_pixel_of_which_the_direct_part_is_bad_trains_nothing():
    image = lit(16, 16)
    direct = image.samples.direct.read().copy()
    direct[3, 4, 0, 5] = np.nan
    samples = chd.Samples.from_array(image.samples.read(), direct=direct)
    rows, _ = np.divmod(np.arange(256), 16)
    pixels = np.stack([rows, np.arange(256) % 16], axis=-1)
    model = Progressive(inputs=["direct"]).train(
        samples, sizes=(4,), iterations=2, pixels=pixels, progress=False
    )
    assert model.provenance["pixels_excluded"] == 1
    alone = Progressive(inputs=["direct"]).train(
        samples, reference=False, iterations=2, progress=False
    )
    assert alone.provenance["pixels_excluded"] == 1
    found = alone.predict(samples.read(), direct=direct)
    assert np.isfinite(found).all()


# --- what is told of samples --------------------------------------------------------------------


def test_the_scale_of_radiance_does_not_matter(model):
    samples = lit(8, 8, seed=3).samples
    x, direct = samples.read(), samples.direct.read()
    found = model.predict(x, direct=direct)
    assert model.predict(4 * x, direct=4 * direct) == pytest.approx(4 * found, rel=1e-5)


def test_trust_halves_both(model):
    image = lit(24, 16, seed=4)
    given = {"direct": image.samples.direct.read()}
    share = model.trust(image.samples.read(), **given)
    assert 0 <= share <= 1
    found = model.predict(image.samples.read(), **given)
    assert found == pytest.approx(model.predict(image.samples.read(), **given, trust=share))


def test_a_stream_takes_both_and_says_the_same(model):
    image = lit(12, 24, seed=5)
    x, direct = image.samples.read(), image.samples.direct.read()
    unit = float(x.mean())
    stream = Stream(model, unit=unit)
    for first in range(0, 24, 8):
        stream.update(x[..., first : first + 8], direct[..., first : first + 8])
    expected = model.predict(x, direct=direct, unit=unit)
    varies = (x != x[..., :1]).any(axis=-1)  # samples tell constants, which keep their mean
    assert stream.estimate(trust=1.0).radiance[varies] == pytest.approx(expected[varies], rel=1e-3)
    learning = Stream(Progressive(inputs=["direct"]), learns=True)
    learning.update(x, direct)
    learning.learn(iterations=4)
    assert learning.model.provenance["inputs"] == ["direct"]
    assert np.isfinite(learning.estimate().radiance).all()


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda m, x: m.predict(x), "pass direct=, the direct part"),
        (lambda m, x: m.trust(x), "pass direct=, the direct part"),
        (lambda m, x: m.predict(x, direct=x[:4]), r"shape of the samples, \(8, 8, 1, 8\)"),
        (lambda m, x: m.predict(x, direct=2 * x), "must be part of the samples"),
        (lambda m, x: Stream(m).update(x), "pass direct=, the direct part"),
        (
            lambda m, x: m.train(chd.Samples.from_array(x), iterations=1),
            "direct light of all 8 samples is wanted, this image has none",
        ),
        (
            lambda m, x: m.train(chd.Samples.from_array(x), reference=False, iterations=1),
            "this image has none",
        ),
    ],
)
def test_what_is_no_direct_part_is_refused(model, call, match):
    with pytest.raises(InputError, match=match):
        call(model, lit(8, 8).samples.read())


def test_that_of_fewer_samples_is_refused():
    samples = lit(4, 8).samples
    fewer = SimpleNamespace(spp=8, direct=samples.direct.first(6))
    with pytest.raises(InputError, match="has that of 6; render it with direct=True"):
        direct_of(fewer)


def test_whoever_does_not_look_at_it_may_be_told(trained, image):
    x = image(8, 8, seed=0).x
    assert (trained.predict(x, direct=x) == trained.predict(x)).all()


# --- comparisons, and the calls around ----------------------------------------------------------


@pytest.fixture
def quick(monkeypatch):
    """Let those who train in comparisons do so for a moment."""
    plain = Progressive.train

    def train(self, samples, **options):
        return plain(self, samples, **(options | {"iterations": 3}))

    monkeypatch.setattr(Progressive, "train", train)


def test_a_comparison_tells_those_who_look_at_it(quick):
    samples = lit(12, 32).samples
    found = chd.compare(samples, ["mean", "progressive_direct"], n=8)
    first = samples.first(8)
    expected = found.models["progressive_direct"].predict(
        first.read(), direct=direct_of(first).read()
    )
    assert found.estimates[1] == pytest.approx(expected)
    assert lookup("progressive_direct").uses_direct
    assert not lookup("progressive").uses_direct


def test_before_a_denoiser_it_is_told_too(quick, monkeypatch):
    monkeypatch.setattr("chdstat.estimators.estimates.denoise", lambda x, **_: x)
    samples = chd.Samples.from_array(
        np.repeat(lit(12, 32).samples.read(), 3, axis=2),
        direct=np.repeat(lit(12, 32).samples.direct.read(), 3, axis=2),
    )
    for certainty in (False, True):
        names = ["progressive_direct", denoised("progressive_direct", with_certainty=certainty)]
        found = chd.compare(samples, names, n=8)
        assert found.estimates[1] == pytest.approx(found.estimates[0])
    curve = chd.comparison.error_curve(samples, ["mean", "progressive_direct"], sizes=[4, 8])
    assert np.isfinite(curve.measures["mse"].value).all()


def test_a_comparison_of_samples_without_it_says_what_is_missing():
    samples = chd.Samples.from_array(np.ones((8, 8, 3, 32)))
    with pytest.raises(InputError, match="direct light of all 32 samples is wanted"):
        chd.compare(samples, ["mean", "progressive_direct"], n=8)


def test_a_model_of_it_is_trained_and_asked_by_name(model):
    samples = lit(12, 16).samples
    alone = train_model(samples, inputs=["direct"], reference=False, iterations=2, progress=False)
    assert alone.inputs.direct
    found = chd.estimate(samples, alone)
    assert (found.radiance == alone.predict(samples.read(), direct=samples.direct.read())).all()
    with pytest.raises(InputError, match="inputs, and training without a reference, are for"):
        train_model(samples, "elek2019", inputs=["direct"])
