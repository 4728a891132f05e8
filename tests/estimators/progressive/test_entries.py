"""Entries: comparisons train once for all that share a training, and features reach them."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import Progressive, lookup, self_trained

NAMES = ("progressive", "progressive_mse", "progressive_relmse")


@pytest.fixture
def quick(monkeypatch):
    """Let those who train in comparisons do so for a moment, and count them."""
    made = []
    plain = Progressive.train

    def train(self, samples, **options):
        made.append(self)
        return plain(self, samples, **(options | {"iterations": 3}))

    monkeypatch.setattr(Progressive, "train", train)
    return made


def test_operating_points_share_one_model(quick, image):
    found = chd.compare(image(12, 32, seed=0).samples, ["mean", *NAMES], n=8)
    assert len(quick) == 1
    assert len({id(found.models[name]) for name in NAMES}) == 1
    mixed, first, last = (found.estimates[1 + i].astype(float) for i in range(3))
    assert mixed == pytest.approx((first + last) / 2, rel=1e-4, abs=1e-5)


def test_a_model_at_hand_is_not_trained_again(quick, trained, image):
    samples = image(16, 32, seed=9).samples
    found = chd.compare(samples, ["mean", *NAMES], n=8, model=trained)
    assert quick == []
    expected = trained.predict(samples.read(ss=slice(0, 8)), loss_weight=1.0)
    assert found.estimates[3] == pytest.approx(expected, rel=0.05, abs=1e-3)


def test_features_reach_those_who_look_at_them(quick, image):
    samples = image(12, 32, seed=0).samples
    found = chd.compare(samples, ["mean", "progressive_features"], n=8)
    assert quick[0].inputs.features
    assert np.isfinite(found.estimates).all()


def test_they_are_marked_for_what_they_look_at():
    for name in (*NAMES, "progressive_features"):
        entry = lookup(name)
        assert not entry.uses_neighbours
        assert entry.joint_channels
        assert entry.uses_features == (name == "progressive_features")
    entry = lookup("self_trained")
    assert entry.uses_neighbours
    assert entry.uses_features
    assert entry.minimum_samples == 4


def test_an_image_improves_itself(image):
    """Light that varies smoothly and comes seldom, so that much is to be gained: measured 0.5."""
    source = image(24, 16, seed=6, smooth=True)
    found = self_trained(source.x, features=source.samples.features, iterations=150)
    assert found.dtype == np.float32
    assert source.error(found) < 0.8
    assert source.error(found, relative=True) < 0.8


def test_it_repeats_with_its_seed(image):
    source = image(24, 16, seed=6, smooth=True)
    first, again, other = (self_trained(source.x, seed=seed, iterations=100) for seed in (0, 0, 1))
    assert (first == again).all()
    assert (first != other).any()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_features_are_optional_and_bad_samples_no_obstacle(image):
    x = image(8, 8, seed=6).x.copy()
    x[0, 0] = np.nan
    x[1, 1, 0, 0] = np.inf
    found = self_trained(x, iterations=2)
    assert np.isnan(found[0, 0]).all()
    assert np.isfinite(found[1:]).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize(
    ("x", "match"),
    [
        (np.ones((4, 4, 3, 3)), "at least 4 spp, got 3"),
        (np.ones((3, 8)), "(y, x, channel, sample)"),
        (np.full((4, 4, 3, 8), np.nan), "at least 2 pixels"),
    ],
)
def test_what_is_no_image_or_has_too_few_samples_is_refused(x, match):
    with pytest.raises(InputError, match=match):
        self_trained(x, iterations=1)


def test_self_training_wants_an_image_with_channels():
    with pytest.raises(InputError, match=r"\(y, x, channel, sample\), got \(4, 3, 8\)"):
        self_trained(np.ones((4, 3, 8)), iterations=1)
