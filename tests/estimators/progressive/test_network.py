"""The network: it starts from the mean, its certainty mixes with it, gradients reach all of it."""

import numpy as np
import pytest
import torch

from chdstat.estimators import Profile
from chdstat.estimators.progressive.auxiliary import BANDS, RADII
from chdstat.estimators.progressive.dataset import AuxiliaryFeatures
from chdstat.estimators.progressive.inputs import LOSSES, Architecture
from chdstat.estimators.progressive.network import Network, device, encode

SHAPES = [
    Architecture(3),
    Architecture(1),
    Architecture(3, described=5),
    Architecture(3, described=5, neighbours=True),
]


def network_input(shape, rows=20, n=16, seed=0):
    rng = np.random.default_rng(seed)
    profile = Profile.of(rng.gamma(0.5, size=(rows, shape.channels, n)), unit=0.5)
    pools = len(RADII) if shape.neighbours else 0
    auxiliary = AuxiliaryFeatures(
        rng.normal(size=(rows, shape.described)),
        rng.random((rows, pools, BANDS, 1 + shape.channels)),
        rng.random((rows, pools)),
    )
    shared = rng.random((rows, shape.channels if shape.neighbours else 0))
    return encode(profile, auxiliary, shared, "cpu")


def scrambled(shape, seed=0):
    torch.manual_seed(seed)
    network = Network(shape).eval()
    torch.nn.init.normal_(network.answer.weight)
    return network


@pytest.fixture(autouse=True)
def own_random_state():
    with torch.random.fork_rng():
        yield


def test_torch_computes_somewhere():
    assert device() in {"cpu", "cuda"}
    assert torch.zeros(1, device=device()).item() == 0


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_of_what_goes_in_and_comes_out(shape):
    network = scrambled(shape)
    assert network._encoded(network_input(shape)).shape == (20, shape.inputs)
    output = network(network_input(shape))
    assert output.estimate.shape == (20, len(LOSSES), shape.channels)
    assert output.mean.shape == (20, shape.channels)
    assert output.certainty.shape == (20, len(LOSSES))


@pytest.mark.parametrize("channels", [1, 3])
def test_it_begins_near_the_mean(channels):
    output = Network(Architecture(channels))(network_input(Architecture(channels)))
    difference = (output.estimate - output.mean[:, None]).abs().max()
    assert 0 < difference < 0.01


def test_the_estimate_lies_between_the_mean_and_the_proposal():
    shape = Architecture(3)
    network, seen = scrambled(shape), network_input(shape)
    output = network(seen)
    assert ((output.certainty > 0) & (output.certainty < 1)).all()
    assert (output.estimate >= 0).all()
    mean = seen.bins[..., 1:].sum(dim=1)
    assert output.mean.detach().numpy() == pytest.approx(mean.numpy())


def test_with_ever_more_samples_of_the_same_kind_it_tends_to_the_mean():
    shape = Architecture(3)
    network, seen = scrambled(shape), network_input(shape)
    distances = []
    for count in (2.0**16, 2.0**24):
        seen.count.fill_(count)
        output = network(seen)
        distances.append((output.estimate - output.mean[:, None]).abs().max().item())
        assert output.certainty.max() <= 2**12 / (2**12 + count)
    assert distances[1] < 0.01 * distances[0]


@pytest.mark.parametrize("shape", SHAPES)
def test_gradients_reach_every_weight(shape):
    network = scrambled(shape)
    network(network_input(shape)).estimate.square().sum().backward()
    for name, weight in network.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_each_row_is_on_its_own():
    shape = Architecture(3, described=5, neighbours=True)
    network, seen = scrambled(shape), network_input(shape)
    part = type(seen)(**{name: value[3:5] for name, value in vars(seen).items()})
    assert network(part).estimate.detach().numpy() == pytest.approx(
        network(seen).estimate[3:5].detach().numpy(), rel=1e-5
    )


def test_black_and_very_bright_pixels_have_finite_answers():
    shape = Architecture(3)
    x = np.zeros((2, 3, 8))
    x[1] = 1e30
    profile = Profile.of(x, unit=1.0)
    seen = encode(profile, AuxiliaryFeatures.nothing(2), np.zeros((2, 0), np.float32), "cpu")
    assert torch.isfinite(scrambled(shape)(seen).estimate).all()


def test_arrays_go_out_and_come_in():
    shape = Architecture(3)
    one, other = scrambled(shape, 0), scrambled(shape, 1)
    other.load_arrays(one.to_arrays())
    assert torch.equal(one(network_input(shape)).estimate, other(network_input(shape)).estimate)


def test_arrays_that_do_not_fit_are_refused():
    network = Network(Architecture(3))
    arrays = network.to_arrays()
    with pytest.raises(ValueError, match="finite"):
        network.load_arrays(arrays | {"answer.bias": np.full_like(arrays["answer.bias"], np.nan)})
    with pytest.raises(ValueError, match="size mismatch"):
        network.load_arrays(Network(Architecture(1)).to_arrays())
    del arrays["answer.bias"]
    with pytest.raises(ValueError, match="answer.bias"):
        network.load_arrays(arrays)
