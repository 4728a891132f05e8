"""The network: it starts from the mean, its certainty mixes with it, gradients reach all of it."""

import numpy as np
import pytest
import torch

from chdstat.estimators.progressive.errors import LOSSES
from chdstat.estimators.progressive.inputs import Profile
from chdstat.estimators.progressive.network import Network

SHAPES = [
    {"channels": 3},
    {"channels": 1},
    {"channels": 3, "described": 5},
]


def given(shape, rows=20, n=16, seed=0):
    """Return the inputs of a network: profiles, and what is known beside."""
    rng = np.random.default_rng(seed)
    channels = shape["channels"]
    profile = Profile.of(rng.gamma(0.5, size=(rows, channels, n)), unit=0.5)
    known = "described" in shape
    return profile, rng.normal(size=(rows, shape["described"])) if known else None


def scrambled(shape, seed=0):
    torch.manual_seed(seed)
    network = Network(**shape).eval()
    torch.nn.init.normal_(network.answer.weight)
    return network


@pytest.fixture(autouse=True)
def own_random_state():
    with torch.random.fork_rng():
        yield


@pytest.mark.parametrize("channels", [1, 3])
def test_it_begins_near_the_mean(channels):
    estimate, mean, _ = Network(channels)(*given({"channels": channels}))
    difference = (estimate - mean[:, None]).abs().max()
    assert 0 < difference < 0.01


def test_the_estimate_lies_between_the_mean_and_the_proposal():
    profile, described = given({"channels": 3})
    estimate, mean, certainty = scrambled({"channels": 3})(profile, described)
    assert ((certainty > 0) & (certainty < 1)).all()
    assert (estimate >= 0).all()
    assert mean.detach().numpy() == pytest.approx(profile.mean() / profile.unit, rel=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_reach_every_weight(shape):
    network = scrambled(shape)
    network(*given(shape))[0].square().sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_shares_between_sizes_move_estimates_part_of_the_way():
    network, (profile, _) = scrambled({"channels": 3}), given({"channels": 3})
    whole, mean, certainty = network(profile, None)
    shares = np.zeros((2, len(LOSSES), 14))
    shares[1] = 1
    network.shrinkage = np.array([4.0, 64.0]), shares
    estimate, _, sure = network(profile, None)
    torch.testing.assert_close(estimate, (whole + mean[:, None]) / 2)
    torch.testing.assert_close(sure, certainty / 2)
