"""Trust without a reference: a network that learned nothing of use leaves the means alone."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive
from chdstat.estimators.progressive.doubt import warranted_share
from chdstat.estimators.progressive.trials import Trial


def trials(rng, share, *, pixels=300, draws=4):
    """Return trials whose moves from the mean have `share` of their length for their best one."""
    mean = rng.lognormal(size=(pixels, 3))
    move = 0.5 * mean * rng.normal(size=mean.shape)
    found = []
    for _ in range(draws):
        noise = 0.5 * mean * rng.normal(size=mean.shape)
        found.append(
            Trial(
                size=8,
                rows=np.arange(pixels),
                estimate=np.stack([np.maximum(mean + move, 0)] * 2),
                mean=mean,
                target=mean + share * move + noise,
                noise=np.zeros_like(mean),
                causes=np.zeros((2, pixels, 3, 6)),
            )
        )
    return found


def test_what_pays_is_believed_and_what_does_not_is_not():
    rng = np.random.default_rng(0)
    assert warranted_share(trials(rng, 1.0)) == 1
    assert warranted_share(trials(rng, 0.4)) == pytest.approx(0.45, abs=0.2)
    assert warranted_share(trials(rng, 0.0)) == 0
    assert warranted_share(trials(rng, -1.0)) == 0


def test_one_pixel_and_no_move_are_no_evidence():
    rng = np.random.default_rng(1)
    assert warranted_share(trials(rng, 1.0, pixels=1)) == 0
    still = [
        Trial(t.size, t.rows, np.stack([t.mean] * 2), t.mean, t.target, t.noise, t.causes)
        for t in trials(rng, 1.0)
    ]
    assert warranted_share(still) == 0


@pytest.fixture(scope="module")
def unrelated():
    """Return a picture whose pixels tell nothing of each other, and its radiance."""
    rng = np.random.default_rng(2)
    radiance = rng.lognormal(sigma=1.5, size=(16, 16, 1))
    x = radiance[..., np.newaxis] * rng.gamma(2.0, 0.5, size=(16, 16, 1, 16))
    return x.astype(np.float32), radiance


@pytest.fixture(scope="module")
def doubted(unrelated):
    samples = chd.Samples.from_array(unrelated[0])
    return Progressive(inputs=["neighbours"]).train(
        samples, reference=False, iterations=150, progress=False
    )


def errors(found, radiance):
    return [(((found - radiance) ** 2) / (radiance**2 + 1e-2) ** p).mean() for p in (0, 1)]


def test_unrelated_pixels_are_not_worse_than_their_means(unrelated, doubted):
    """They are hardly moved, as what a network makes of the pixels around does not pay."""
    x, radiance = unrelated
    of_mean = errors(x.mean(axis=-1), radiance)
    for found, mean in zip(errors(doubted.predict(x), radiance), of_mean, strict=True):
        assert found < 1.05 * mean
    trust = doubted.provenance["trust"]
    assert 0 <= trust < 1


def test_trust_is_saved_and_said(doubted, unrelated, tmp_path):
    x, _ = unrelated
    doubted.save(tmp_path / "model.safetensors")
    again = Progressive.load(tmp_path / "model.safetensors")
    assert again.provenance["trust"] == doubted.provenance["trust"] == doubted._state.trust
    first, second = doubted.estimate(x), again.estimate(x)
    for name in ("radiance", "certainty", "low", "high"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_pixel_of_one_light_keeps_it(alone, picture):
    source = picture(24, 32, seed=1, smooth=True)
    x = source.x.copy()
    x[3, 4], x[5, 6] = np.array([7.0, 8.0, 0.0])[:, np.newaxis], 0.0
    x[7, 8], x[7, 8, :, 0] = 2.0, 3.0
    found = alone.estimate(x, features=source.samples.features)
    assert found.radiance[3, 4].tolist() == [7, 8, 0]
    assert found.certainty[3, 4] == 0
    assert (found.low[3, 4] <= [7, 8, 0]).all()
    assert (found.high[3, 4] >= [7, 8, 0]).all()
    assert (found.radiance[5, 6] != 0).any()
    assert (found.radiance[7, 8] != x[7, 8].mean(axis=-1)).any()


def test_the_fewest_samples_that_can_train(picture):
    source = picture(12, 4, seed=3)
    model = Progressive(inputs=["neighbours"])
    model.train(chd.Samples.from_array(source.x), reference=False, iterations=2, progress=False)
    found = model.estimate(source.x)
    assert np.isfinite(found.radiance).all()
    assert (found.low <= found.high).all()
