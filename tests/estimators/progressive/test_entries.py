"""Entries: comparisons train once for all that share a training, and features reach them."""

import numpy as np
import pytest

import chdstat as chd
from chdstat.estimators import Progressive

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


@pytest.mark.filterwarnings("ignore::chdstat.errors.OtherSceneWarning")
def test_a_model_at_hand_is_not_trained_again(quick, trained, image):
    samples = image(16, 32, seed=9).samples
    found = chd.compare(samples, ["mean", *NAMES], n=8, model=trained)
    assert quick == []
    expected = trained.predict(samples.read(ss=slice(0, 8)), loss_weight=1.0)
    assert found.estimates[3] == pytest.approx(expected, rel=0.05, abs=1e-3)


def test_features_reach_those_who_look_at_them(quick, image):
    samples = image(12, 32, seed=0).samples
    found = chd.compare(samples, ["mean", "progressive_features"], n=8)
    assert quick[0].with_features
    assert np.isfinite(found.estimates).all()
