"""Progress: what long work tells in a log, a notebook and a terminal, and what it counts."""

import subprocess
import sys
import time
import types

import numpy as np
import pytest

import chdstat as chd
from chdstat._core import progress
from chdstat._core.arrays import say_once
from chdstat._core.progress import portion, track
from chdstat._core.work import in_order


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(progress, "_LINE_EVERY", 0.002)
    monkeypatch.setattr(progress, "_BAR_EVERY", 0.002)


def said_until(capfd, text):
    said, begin = "", time.monotonic()
    while text not in said:
        said += capfd.readouterr().err
        assert time.monotonic() < begin + 60, said
    return said


def test_a_log_gets_lines(quick, capfd):
    with track("counting", 4) as advance:
        advance(1)
        said = said_until(capfd, "counting: 25 %, ")
    assert "\r" not in said


def test_short_work_is_silent(capfd):
    with track("counting", 4) as advance:
        advance(4)
    assert capfd.readouterr().err == ""


def test_work_that_stands_still_is_told(quick, capfd):
    with track("counting", 4):
        said_until(capfd, "counting: 0 % after 1 s\n")


def test_one_option_silences_all_within(quick, capfd):
    with track("studying", 2, show=False), track("rendering", 4) as advance:
        list(in_order(lambda _: time.sleep(0.01), range(3), workers=1, advance=advance))
        list(in_order(lambda _: told_here(), range(2), workers=2))
    assert capfd.readouterr().err == ""


def test_a_generator_that_outlives_silence_does_not_keep_it(quick, capfd):
    def drawn():
        with track("drawing", 2):
            yield

    with track("contrasting", 1, show=False):
        draws = drawn()
        next(draws)
    draws.close()
    with track("counting", 4):
        said_until(capfd, "counting: 0 %")


def told_here():
    with track("in a thread", 1):
        time.sleep(0.02)


def test_work_within_work_shares_a_line(quick, capfd):
    with track("studying", 4) as outer, track("rendering", 10) as inner:
        outer(1)
        inner(5)
        said = said_until(capfd, "studying: 25 %, nearly done; rendering: 50 %\n")
    assert all(line.startswith("studying: ") for line in said.splitlines())


def test_the_time_left_follows_the_share():
    jobs = [progress._TrackedWork("rendering", 200, began=100.0, done=50)]
    assert progress._told(jobs, 130.0) == "rendering: 25 %, about 90 s left"
    jobs.append(progress._TrackedWork("writing", 0, began=120.0))
    assert progress._told(jobs, 130.0) == "rendering: 25 %, about 90 s left; writing"
    assert progress._told(jobs[1:], 130.0) == "writing after 10 s"


def test_lines_come_every_ten_seconds(monkeypatch, capfd):
    now = 1000.0
    monkeypatch.setattr(progress, "time", types.SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(progress._Timed, "__init__", lambda _: None)  # no thread waits here
    monkeypatch.setattr(progress, "_ended", 0.0)
    lines, jobs = progress._Lines(), [progress._TrackedWork("counting", 4, began=now)]
    for passed in (0, 4, 9):
        now = 1000 + passed
        assert lines._due() == 10 - passed
    for _ in range(3):  # late by two seconds each time
        now += lines._due() + 2
        lines._write(jobs)
        assert lines._due() == 10
    assert capfd.readouterr().err.count("counting: 0 % after") == 3
    monkeypatch.setattr(progress, "_ended", now)
    now += 0.5  # the next of many short pieces goes on waiting
    assert progress._Lines()._due() == 9.5
    now += 60
    assert progress._Lines()._due() == 10


def test_portions_within_threads_are_counted_once():
    counted = []

    def work(_):
        for _ in range(4):
            with portion(0.25):
                pass

    list(in_order(work, range(3), workers=1, advance=counted.append, size=lambda _: 8))
    assert [amount for amount in counted if amount] == [2.0] * 12


def test_an_analysis_tells_of_parts_of_a_tile(monkeypatch):
    counted, original = [], progress.track

    def tracked(*args, **options):
        context = original(*args, show=False)
        context.__enter__()
        return Recorder(args[0], counted)

    class Recorder:
        def __init__(self, what, counted):
            self.what, self.counted = what, counted

        def __enter__(self):
            return lambda amount: self.counted.append((self.what, amount))

        def __exit__(self, *error):
            return None

    monkeypatch.setattr("chdstat.samples.assembly.track", tracked)
    chd.analyze(np.random.default_rng(0).gamma(2.0, size=(8, 8, 3, 128)))
    amounts = [amount for what, amount in counted if what == "analysing"]
    assert max(amounts) <= 64 / 4
    assert sum(amounts) == pytest.approx(64)


def test_a_notebook_gets_a_bar_that_goes(quick, monkeypatch):
    shown = []

    class Handle:
        def update(self, content, *, raw):
            shown.append(content["text/html"])

    def display(content, *, raw, display_id):
        shown.append(content["text/html"])
        return Handle()

    shell = types.SimpleNamespace(kernel=object())
    fake = types.SimpleNamespace(
        get_ipython=lambda: shell, display=types.SimpleNamespace(display=display)
    )
    monkeypatch.setitem(sys.modules, "IPython", fake)
    with track("<counting>", 4) as advance:
        advance(1)
        while not shown:
            time.sleep(0.001)
    assert '<progress value="0.2500"' in shown[0]
    assert "&lt;counting&gt;: 25 %" in shown[0]
    assert shown[-1] == ""


def test_a_terminal_gets_bars(monkeypatch, capfd):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with track("studying", 2, unit="scene") as outer, track("rendering", 4, unit="S") as inner:
        inner(4)
        outer(1)
    said = capfd.readouterr().err
    assert "studying" in said


SCRIPT = """
import sys, time
import numpy as np
import chdstat as chd
from chdstat._core import progress
progress._LINE_EVERY = .01
samples = chd.Samples.from_array(np.ones((4, 4, 3, 8), np.float32))
def slowly(block):
    time.sleep(.2)
    return {"mean": ((), block.mean((-1, -2)))}
samples.map(slowly)
print("silent now", file=sys.stderr)
samples.map(slowly, progress=False)
"""


def test_a_script_tells_its_progress():
    said = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    ).stderr
    told, _, silent = said.partition("silent now\n")
    assert "analysing: " in told
    assert silent == ""


def test_a_notice_is_said_once(caplog):
    for _ in range(3):
        say_once("fog: its lamps are switched off")
        say_once("room: its lamps are switched off")
    assert len(caplog.records) == 2
