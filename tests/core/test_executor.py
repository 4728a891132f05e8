"""Workers: results come in order, few at a time, and an error ends the work."""

from __future__ import annotations

import threading
import time

import pytest

from chdstat._core.executor import cores, in_order


def test_results_come_in_the_order_of_the_items():
    def slow_first(i):
        time.sleep(0.02 * (i == 0))
        return i

    assert list(in_order(slow_first, range(8), workers=4)) == list(range(8))


def test_several_work_at_once():
    both = threading.Barrier(2, timeout=10)  # passes only if two are at work
    assert list(in_order(lambda i: both.wait() >= 0 and i, range(2), workers=2)) == [0, 1]


def test_an_error_is_raised_in_its_place_and_ends_the_work():
    begun = []

    def fail_at_three(i):
        begun.append(i)
        if i == 3:
            message = "three"
            raise ValueError(message)
        return i

    results = in_order(fail_at_three, range(1000), workers=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
    assert len(begun) < 10


def test_items_are_taken_only_as_results_are_asked_for():
    taken = []

    def items():
        for i in range(100):
            taken.append(i)
            yield i

    results = in_order(abs, items(), workers=2)
    next(results)
    assert len(taken) <= 4
    results.close()


def test_there_is_a_core():
    assert cores() >= 1
