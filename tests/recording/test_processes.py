"""Renderers in processes of their own, played by small workers."""

import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from chdstat.errors import RenderError, SceneError
from chdstat.recording import processes
from chdstat.recording.processes import RendererProcess

Starter = Callable[..., RendererProcess]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Starter]:
    """Start a worker of some code."""
    started = []

    def begun(code: str, command: tuple[str, ...] = (sys.executable,)) -> RendererProcess:
        worker = tmp_path / "worker.py"
        worker.write_text(textwrap.dedent(code))
        started.append(RendererProcess(command, worker, renderer="Toy"))
        return started[-1]

    yield begun
    for process in started:
        process.close()


DRAW = """
import numpy as np
def draw(seed, size):
    image = np.random.default_rng(seed).random((size, size, 3), np.float32)
    return {"seed": seed}, {"image": image[::-1], "whole": np.arange(4), "none": image[:0]}
"""


def test_arrays_arrive_exactly(start: Starter) -> None:
    process = start(DRAW)
    for size in (1, 300):
        reply, arrays = process.call("draw", seed=7, size=size)
        drawn = np.random.default_rng(7).random((size, size, 3), np.float32)
        assert reply == {"seed": 7}
        np.testing.assert_array_equal(arrays["image"], drawn[::-1])
        np.testing.assert_array_equal(arrays["whole"], np.arange(4, dtype=np.float32))
        assert arrays["none"].shape == (0, size, 3)
        assert all(array.dtype == np.float32 for array in arrays.values())


def test_prints_never_come_between(start: Starter) -> None:
    process = start("""
        import os, sys
        print("hello from the import")
        def draw(n):
            print("x" * n)
            os.write(1, b"raw " * n)
            os.system("echo from a child")
            sys.stderr.write("warning\\n" * n)
            return {"n": n}
    """)
    for n in (1, 50_000):  # more than a pipe holds
        assert process.call("draw", n=n)[0] == {"n": n}


def test_prints_before_the_loop_are_skipped(start: Starter, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import runpy, sys\nprint('Toy 1.0' * 10_000)\nrunpy.run_path(sys.argv[1], {}, '__main__')"
    )
    process = start(DRAW, (sys.executable, str(program)))
    assert process.call("draw", seed=1, size=2)[0] == {"seed": 1}


def test_exceptions_leave_it_running(start: Starter) -> None:
    process = start("""
        def draw(seed):
            if seed < 2:
                raise ZeroDivisionError("no light at all")
            return {"seed": seed}
        def load():
            raise SceneFault("no camera in it; add one")
    """)
    with pytest.raises(RenderError, match="Toy raised ZeroDivisionError: no light at all"):
        process.call("draw", seed=1)
    with pytest.raises(SceneError, match=r"^no camera in it; add one$"):
        process.call("load")
    with pytest.raises(RenderError, match="KeyError"):
        process.call("no_such_function")
    assert process.call("draw", seed=2)[0] == {"seed": 2}


@pytest.mark.parametrize(
    ("end", "told"),
    [
        ("os._exit(3)", r"exit code 3"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", r"SIGSEGV"),
    ],
)
def test_a_death_is_told_with_its_last_words(start: Starter, end: str, told: str) -> None:
    process = start(f"""
        import os, signal, sys
        def draw():
            print("out of memory", file=sys.stderr, flush=True)
            {end}
    """)
    with pytest.raises(RenderError, match=rf"ended during 'draw' \({told}\).*out of memory"):
        process.call("draw")
    assert not process.is_running
    with pytest.raises(RenderError, match="was ended"):
        process.call("draw")


def test_a_death_between_calls_is_told(start: Starter) -> None:
    process = start("import os\ndef pid():\n    return {'pid': os.getpid()}\n")
    os.kill(process.call("pid")[0]["pid"], signal.SIGKILL)
    with pytest.raises(RenderError, match="SIGKILL"):
        process.call("pid")


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import no_such_renderer", "cannot be used: ModuleNotFoundError"),
        ("import os; print('licence?', flush=True); os._exit(1)", r"at its start.*licence\?"),
        ("raise SceneFault('x')", "cannot be used: x"),
    ],
)
def test_a_worker_that_cannot_start_is_told(start: Starter, code: str, told: str) -> None:
    with pytest.raises(RenderError, match=told):
        start(code)


def test_programs_that_are_none_are_told(start: Starter, tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="cannot be started by .*nothing"):
        start(DRAW, (str(tmp_path / "nothing"),))
    with pytest.raises(RenderError, match="at its start"):
        start(DRAW, (sys.executable, "-c", "print('I am no renderer')"))


def test_silence_at_the_start_ends(start: Starter, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_START", 1.0)
    silent = (sys.executable, "-c", "import time\nprint('busy', flush=True)\ntime.sleep(100)")
    with pytest.raises(RenderError, match=r"did not start in 1 s.*busy"):
        start(DRAW, silent)


@pytest.mark.parametrize("garbage", ["b'<html>' * 9", "b'chd\\1' + b'\\xff' * 8", "HUGE"])
def test_garbage_is_not_understood(start: Starter, garbage: str) -> None:
    process = start(f"""
        import os, struct
        HUGE = struct.pack("<4sQ", b"chd\\1", 2) + b"[]"
        def draw():
            for number in range(3, 20):  # every open file, the replies among them
                try:
                    os.write(number, {garbage})
                except OSError:
                    pass
            return {{}}
    """)
    with pytest.raises(RenderError, match="not understood"):
        process.call("draw")
    assert not process.is_running


def test_it_ends_with_a_killed_parent(tmp_path: Path) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import os, time\ndef draw():\n    print(os.getpid())\n"
        "    open('pid', 'w').write(str(os.getpid()))\n    time.sleep(1000)\n"
    )
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys; from chdstat.recording.processes import RendererProcess\n"
            "RendererProcess([sys.executable], 'worker.py', renderer='Toy').call('draw')",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    pid = _eventually(lambda: int((tmp_path / "pid").read_text() or "x"))
    parent.kill()
    parent.wait()
    _eventually(lambda: not _is_alive(pid) or _fails())


def test_ctrl_c_is_for_the_parent(start: Starter) -> None:
    process = start("""
        import os, signal, time
        def pid():
            return {"pid": os.getpid(), "group": os.getpgrp()}
        def draw():
            os.kill(os.getppid(), signal.SIGINT)  # only now does the parent wait
            time.sleep(60)
    """)
    about, _ = process.call("pid")
    assert about["group"] != os.getpgrp(), "a terminal would reach it"
    # Tests that run in the background ignore the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            process.call("draw")
    finally:
        signal.signal(signal.SIGINT, before)
    _eventually(lambda: not _is_alive(about["pid"]) or _fails())
    assert not process.is_running


def test_it_cannot_be_sent_elsewhere(start: Starter) -> None:
    with pytest.raises(TypeError, match="pickle"):
        pickle.dumps(start(DRAW))


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def _fails() -> bool:
    message = "not yet"
    raise ValueError(message)


def _eventually(found: Callable[[], int]) -> int:
    """Return what is found, which may take a while."""
    for _ in range(600):
        try:
            return found()
        except (OSError, ValueError):
            time.sleep(0.1)
    return found()
