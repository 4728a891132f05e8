"""Passes: which goes first, which stands still, and what is said of those that fail."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import image_errors
from chdstat.errors import StoreError
from chdstat.explorer.address import View
from chdstat.explorer.image_sources import StoreSource
from chdstat.explorer.passes import Passes
from chdstat.explorer.tables import errors_line, errors_table
from chdstat.explorer.workspace import opened


class Stepped:
    """Passes that are done a step at a time, as a test says."""

    def __init__(self):
        self.steps, self.told = [], []
        self._free, self._ended = threading.Semaphore(0), {}
        self.passes = Passes(lambda: False, self._tell)
        self.at = threading.Semaphore(0)

    def work(self, name, count=3):
        for i in range(count):
            self.at.release()
            assert self._free.acquire(timeout=600)
            self.steps.append(name)
            yield name, (i + 1) / count

    def go(self, count=1):
        """Do some steps, and wait until the next one is begun."""
        for _ in range(count):
            self._free.release()
            assert self.at.acquire(timeout=600)

    def ends(self, name):
        """Wait until a pass has ended."""
        self._free.release(99)
        event = self._ended.setdefault(name, threading.Event())
        assert event.wait(600)
        event.clear()

    def _tell(self, what):
        self.told.append(what)
        if what not in self.passes.shares:  # of one that goes on, the share is known
            self._ended.setdefault(what, threading.Event()).set()


@pytest.fixture
def stepped():
    found = Stepped()
    yield found
    found.passes.stop()
    found._free.release(99)


def test_the_latest_request_goes_first(stepped):
    passes = stepped.passes
    passes.ask("one", "a", stepped.work("a"))
    stepped.at.acquire()
    passes.ask("two", "b", stepped.work("b"))
    stepped.go(4)  # the step that was begun, and all of b
    assert stepped.steps == ["a", "b", "b", "b"]
    passes.ask("two", "a", None)  # is there: nothing is begun anew
    stepped.ends("a")
    assert stepped.steps == ["a", "b", "b", "b", "a", "a"]


def test_what_nobody_waits_for_stands_still(stepped):
    passes = stepped.passes
    passes.ask("one", "a", stepped.work("a"))
    stepped.at.acquire()
    passes.ask("one", "b", stepped.work("b"))  # in place of a
    stepped.go(2)
    passes.leave("one")
    passes.ask("two", "c", stepped.work("c"))
    stepped.ends("c")
    assert stepped.steps == ["a", "b", "b", "c", "c", "c"]
    passes.ask("two", "b", stepped.work("b"))
    stepped.ends("b")
    assert stepped.steps[6:] == ["b"]


def test_one_that_fails_says_why_and_ends_no_other(stepped):
    def broken():
        yield "reading", 0.5
        raise StoreError("the store is gone")

    passes = stepped.passes
    passes.ask("one", "a", stepped.work("a"))
    passes.ask("two", "bad", broken())
    stepped.ends("bad")
    stepped.ends("a")
    assert passes.failures == {"bad": "the store is gone"}
    passes.ask("two", "bad", stepped.work("bad"))  # asked again, it is tried again
    stepped.ends("bad")
    assert passes.failures == {}


def test_what_is_forgotten_is_begun_anew(stepped):
    passes = stepped.passes
    passes.ask("one", "a", stepped.work("a"))
    stepped.at.acquire()
    passes.forget()
    stepped._free.release()
    passes.ask("one", "a", stepped.work("a", count=2))
    stepped.ends("a")
    assert stepped.steps == ["a"] * 3


def test_a_store_that_grows_lets_passes_end_and_errors_stand(monkeypatch, stepped):
    renders = np.random.default_rng(1).gamma(1.0, size=(2, 16, 16, 3, 16))
    shared = opened([chd.Samples.from_array(x, axes="yxcs", scene="noise") for x in renders])
    shared.passes.stop()
    shared.passes = passes = stepped.passes
    monkeypatch.setattr(StoreSource, "refreshed", lambda self: StoreSource(self.samples))
    for source in shared.sources:
        source.complete = False
    before = list(shared.sources)
    passes.ask("page", "map", stepped.work("map"))
    stepped.at.acquire()
    shared.refresh()
    assert shared.sources == before
    stepped.ends("map")
    assert stepped.steps == ["map"] * 3
    measured = image_errors({"noise (2)": renders[1].mean(axis=-1)}, renders[0].mean(axis=-1))
    shared.errors[0] = measured
    shared.refresh()
    assert shared.sources != before
    assert shared.errors[0] is measured
    stepped.ends("start")
    shared.want_errors("page", 0)
    stepped.ends("errors 0")
    assert shared.errors[0] is not measured
    assert shared.outdated == set()
    passes.failures["errors 1"] = "the store is gone"
    shared.want_errors("page", 1)
    assert passes.idle  # what failed is not tried again before the store grows
    table = errors_table(measured, "noise", "being measured")
    assert "of fewer samples: being measured anew" in errors_line(table, "noise (2)", "noise")
    assert "fewer" not in errors_line(errors_table(measured, "noise", ""), "noise (2)", "noise")


def test_a_contrast_is_computed_once_for_all_its_maps(monkeypatch, stepped):
    renders = np.random.default_rng(1).gamma(1.0, size=(2, 8, 8, 3, 16))
    shared = opened([chd.Samples.from_array(x, axes="yxcs", scene="noise") for x in renders])
    shared.passes.stop()
    shared.passes = stepped.passes
    one, other = (View(map=f"contrast:{n}", shown=1, reference=0) for n in ("p", "efficiency"))
    key = shared.key(one)

    def contrasting(a, b):
        yield from stepped.work(key)
        return chd.contrast(a, b)

    monkeypatch.setattr("chdstat.explorer.workspace.contrasting", contrasting)
    shared.want("page", one)
    shared.want("page", other)
    stepped.ends(key)
    assert stepped.steps == [key] * 3
    assert shared.map(other) is not None
    assert shared.map(one).title == "Significance of the difference"
