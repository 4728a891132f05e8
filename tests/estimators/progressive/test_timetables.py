"""Timetables: a stream learns whenever its samples have doubled, longest from all of them."""

import numpy as np
import pytest

from chdstat.errors import InputError
from chdstat.estimators import Progressive, Stream
from chdstat.estimators.progressive.stream import follow, schedule


@pytest.mark.parametrize("spp", [4, 15, 16, 31, 64, 100, 2048])
@pytest.mark.parametrize("iterations", [1, 7, 500, None])
def test_all_iterations_are_shared_out_and_the_last_ones_see_all_samples(spp, iterations):
    plan = schedule(spp, iterations)
    assert sum(plan.values()) == (iterations or 2000)
    assert max(plan) == spp
    assert plan[spp] > sum(plan.values()) / 2 - 1
    assert list(plan) == sorted(plan)


def test_samples_double_and_so_do_iterations():
    assert schedule(128, 1500) == {16: 100, 32: 200, 64: 400, 128: 800}


def test_what_is_too_little_is_refused():
    with pytest.raises(InputError, match="at least 4 spp, got 3"):
        schedule(3)
    with pytest.raises(InputError, match="iterations must be at least 1, got 0"):
        schedule(64, 0)


@pytest.mark.parametrize("batch", [5, 24, 64])
def test_whatever_the_batches_it_learns_as_long(batch):
    x = np.random.default_rng(0).exponential(size=(6, 6, 1, 40)).astype(np.float32)
    stream = Stream(Progressive(), learns=True)
    follow(stream, np.split(x, range(batch, 40, batch), axis=-1), spp=40, iterations=4)
    assert stream.iterations == 4
    assert (stream.count == 40).all()
