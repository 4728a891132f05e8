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


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_of_what_comes_out(shape):
    estimate, mean, certainty = scrambled(shape)(*given(shape))
    assert estimate.shape == (20, len(LOSSES), shape["channels"])
    assert mean.shape == (20, shape["channels"])
    assert certainty.shape == (20, len(LOSSES))


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


def test_with_ever_more_samples_of_the_same_kind_it_tends_to_the_mean():
    network, (profile, _) = scrambled({"channels": 3}), given({"channels": 3})
    distances = []
    for times in (2**12, 2**20):
        many = Profile(profile.bins * times, profile.count * times, profile.unit)
        estimate, mean, certainty = network(many, None)
        distances.append((estimate - mean[:, None]).abs().max().item())
        assert certainty.max() <= 2**12 / (2**12 + 16 * times)
    assert distances[1] < 0.01 * distances[0]


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_reach_every_weight(shape):
    network = scrambled(shape)
    network(*given(shape))[0].square().sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_each_row_is_on_its_own():
    shape = {"channels": 3, "described": 5}
    network, (profile, described) = scrambled(shape), given(shape)
    some = Profile(profile.bins[3:5], profile.count[3:5], profile.unit)
    part = network(some, described[3:5])
    assert part[0].detach().numpy() == pytest.approx(
        network(profile, described)[0][3:5].detach().numpy(), rel=1e-5
    )


def test_shares_between_sizes_move_estimates_part_of_the_way():
    network, (profile, _) = scrambled({"channels": 3}), given({"channels": 3})
    whole, mean, certainty = network(profile, None)
    shares = np.zeros((2, len(LOSSES), 14))
    shares[1] = 1
    network.shrinkage = np.array([4.0, 64.0]), shares
    estimate, _, sure = network(profile, None)
    torch.testing.assert_close(estimate, (whole + mean[:, None]) / 2)
    torch.testing.assert_close(sure, certainty / 2)


def test_arrays_go_out_and_come_in():
    one, other = (scrambled({"channels": 3}, seed) for seed in range(2))
    other.load_arrays(one.to_arrays())
    inputs = given({"channels": 3})
    assert torch.equal(one(*inputs)[0], other(*inputs)[0])


def test_arrays_that_do_not_fit_are_refused():
    network = Network(3)
    arrays = network.to_arrays()
    with pytest.raises(RuntimeError, match="size mismatch"):
        network.load_arrays(Network(1).to_arrays())
    del arrays["answer.bias"]
    with pytest.raises(RuntimeError, match="answer.bias"):
        network.load_arrays(arrays)
