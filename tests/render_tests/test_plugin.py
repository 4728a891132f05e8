"""The fixture `same_light` in sessions of pytest: what passes, what fails, and with which words.

Sessions run with renders of 16 x 16 pixels of gamma noise. Their seeds are fixed by their names, so
each of these tests passes or fails always. Right renders fail in a fraction alpha of names.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import PIPE

import pytest

import chdstat as chd
from chdstat.inference import Reference

pytest_plugins = ("pytester",)

DRAWING = """
import os
import numpy as np
import pytest

LOSS = float(os.environ.get("LOSS", 0))

def draw(seed, shape=(16, 16, 3), loss=LOSS):
    noise = np.random.default_rng(seed).gamma(4.0, 0.25, size=shape)
    return noise * np.linspace(0.2, 1, shape[1])[:, np.newaxis] * (1 - loss)

def draws(spp, seed=0, loss=LOSS):
    return np.stack([draw(1000 * seed + i, loss=loss) for i in range(spp)], axis=-1)
"""
ONE = "def test_room(same_light):\n    same_light(draw, spp=32)\n"

RUNNER = """
import json, os, sys
import numpy as np
import pytest
from pathlib import Path
from chdstat.inference import Reference
from chdstat.io import write_reference
from chdstat.render_tests.checks import verdict_on
from chdstat.render_tests.verdicts import RenderCheck

folder = Path(sys.argv[1])
x = np.random.default_rng(0).gamma(2.0, size=(8, 8, 3, 48))
path = write_reference(Reference.of_samples(x), folder / "box.exr")
verdict_on(x[..., :16], RenderCheck("box", path, "box", "t", 0.01, report=folder, always=True))
for line in sys.stdin:
    asked = json.loads(line)
    if not (child := os.fork()):
        os.chdir(asked["folder"])
        os.environ.update(asked["environment"])
        for name, number in (("out", 1), ("err", 2)):
            os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        code = pytest.main(asked["options"])
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""A process that has loaded what sessions use, and forks one that runs each of them."""

Session = Callable[..., pytest.RunResult]


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., pytest.RunResult]]:
    """Return what runs pytest in a folder, in a process of its own."""
    folder = tmp_path_factory.mktemp("runner")
    root = str(Path(chd.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": root, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # files of one size change within a second
    # Where CI is set, pytest repeats whole messages at its end.
    others = ("PYTEST_XDIST_WORKER", "PYTEST_XDIST_WORKER_COUNT", "PYTEST_ADDOPTS")
    for name in (*others, "CI", "BUILD_NUMBER"):
        environment.pop(name, None)
    code = [sys.executable, "-c", RUNNER, str(folder)]
    with subprocess.Popen(code, stdin=PIPE, stdout=PIPE, text=True, env=environment) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def run(where: Path, options: list[str], **environment: str) -> pytest.RunResult:
            asked = {"folder": str(where), "options": options, "environment": environment}
            print(json.dumps(asked), file=process.stdin, flush=True)
            code = int(process.stdout.readline())
            out, err = ((folder / name).read_text("utf-8").splitlines() for name in ("out", "err"))
            return pytest.RunResult(code, out, err, 0.0)

        yield run
        process.stdin.close()


@pytest.fixture
def session(pytester: pytest.Pytester, runner: Callable[..., pytest.RunResult]) -> Session:
    """Return what runs a session of tests: ``session(test, *options, loss=0)``."""

    def run(test: str = ONE, *options: str, loss: float = 0) -> pytest.RunResult:
        pytester.makepyfile(test_renders=DRAWING + test)
        plugins = ["-p", "chdstat.render_tests.plugin", "-p", "no:cacheprovider"]
        plugins += ["-p", "xdist"] * ("-n2" in options)
        return runner(pytester.path, [*plugins, *options], LOSS=str(loss), COLUMNS="100")

    return run


def text_of(result: pytest.RunResult) -> str:
    """Return what was printed, with plain spaces and on one line."""
    return " ".join(result.stdout.str().replace("\N{NO-BREAK SPACE}", " ").split())


def failing(result: pytest.RunResult, *words: str) -> str:
    """Check that the only test failed, and said some words."""
    result.assert_outcomes(failed=1)
    said = text_of(result)
    for word in words:
        assert word in said
    return said


# --- verdicts -----------------------------------------------------------------------------------


def test_a_right_render_passes_and_says_what_it_finds(session: Session):
    session(ONE, "--render-update").assert_outcomes(passed=1)
    result = session(ONE)
    result.assert_outcomes(passed=1)
    line = r"1 render test: none differs\. Any false alarm: at most 1\.0 %\. Smallest loss found: "
    assert re.search(line + r"[\d.]+ %", text_of(result))
    assert "no difference found" not in text_of(result)
    assert not Path("render-report").exists()


def test_a_table_shows_each_test_if_asked(session: Session):
    session(ONE, "--render-update")
    assert re.search(r"room no difference found \d+ [\d.]+ [\d.]+ %", text_of(session(ONE, "-v")))


def test_a_loss_of_five_per_cent_fails_with_a_picture_and_a_page(session: Session):
    session(ONE, "--render-update")
    said = failing(session(ONE, loss=0.05), "The means differ (p ")
    assert re.search(r"Confirmed: \d+ other samples per pixel were drawn, and say the same", said)
    assert re.search(r"the render is [456]\.\d % darker", said)
    for kind in ("picture", "page"):
        (found,) = re.findall(rf"{kind}: (render-report/\S+)", said)
        assert Path(found).stat().st_size > 5000
    assert Path(found).name in Path("render-report/index.html").read_text("utf-8")


def test_a_missing_cosine_is_found(session: Session):
    test = """
def lit(seed, cosine=True):
    angle = np.random.default_rng(seed).uniform(0, np.pi / 2, size=(16, 16, 1))
    return np.sin(angle) * (np.cos(angle) if cosine else 1) * np.pi / 2

def test_floor(same_light):
    same_light(lambda seed: lit(seed, cosine=not LOSS), spp=32)
"""
    session(test, "--render-update")
    session(test).assert_outcomes(passed=1)
    failing(session(test, loss=1), "The means differ")


def test_arrays_samples_and_passes_are_compared_too(session: Session):
    test = """
import chdstat as chd
KINDS = {
    "array": lambda x: x,
    "samples": chd.Samples.from_array,
    "passes": lambda x: list(np.moveaxis(x, -1, 0)),
}
def test_all(same_light):
    for kind in KINDS:
        same_light(KINDS[kind](draws(96, seed=SEED)), NAME, finds=.1)
"""
    session(test.replace("SEED", "1").replace("NAME", "kind"), "--render-update").assert_outcomes(
        passed=1
    )
    assert len([*Path("references").iterdir()]) == 3
    other = test.replace("SEED", "2").replace("NAME", "'array'")
    session(other).assert_outcomes(passed=1)
    failing(session(other, loss=0.05), "The means differ")


def test_stores_and_files_are_compared(session: Session, stored: Callable[..., Path]):
    stores = [str(stored(size=(16, 16), seed=seed)) for seed in (1, 2)]
    test = "def test_store(same_light):\n    same_light({!r}, 'box')\n"
    session(test.format(stores[0]), "--render-update").assert_outcomes(passed=1)
    session(test.format(stores[1])).assert_outcomes(passed=1)
    assert Reference.read("references/box.exr").attrs["scene"] == "cornell-box"


def test_a_function_may_draw_several_samples_at_once(session: Session):
    test = """
def test_room(same_light):
    same_light(lambda seed: np.stack([draw(seed + i) for i in range(5)], -1), spp=32)
"""
    session(test, "--render-update")
    assert Reference.read("references/room.exr").spp == 96
    session(test).assert_outcomes(passed=1)
    failing(session(test, loss=0.05), "The means differ")


def test_the_contrast_is_returned(session: Session):
    test = ONE.replace("same_light(draw", "found = same_light(draw")
    test += "    assert not found or found.spp == (32, 96)\n"
    session(test, "--render-update").assert_outcomes(passed=1)
    session(test).assert_outcomes(passed=1)


def test_what_could_not_be_found_fails_if_it_must_be(session: Session):
    test = "def test_room(same_light):\n    same_light(draw, spp=32, finds={})\n"
    session(ONE, "--render-update")
    session(test.format(0.05)).assert_outcomes(passed=1)
    failing(session(test.format(0.001)), "finds=0.001 asks for 0.1 %: give about spp=")


def test_a_test_that_cannot_tell_fails_or_is_skipped(session: Session):
    session(ONE, "--render-update")
    test = "def test_room(same_light):\n    same_light(draws(4){})\n"
    failing(session(test.format("")), "Cannot tell", "too few")
    result = session(test.format(", cannot_tell='skip'"), "-rs")
    result.assert_outcomes(skipped=1)
    assert "Cannot tell" in text_of(result)


def test_pixels_that_are_nan_fail(session: Session):
    session(ONE, "--render-update")
    test = """
def broken(seed):
    x = draw(seed)
    x[3, 4] = np.nan
    return x

def test_room(same_light):
    same_light(broken, spp=32)
"""
    said = failing(session(test), "1 pixel where all samples of the render are NaN or infinite")
    assert "at y 3, x 4" in said


# --- what is refused ------------------------------------------------------------------------------


def test_without_a_reference_it_says_what_to_do(session: Session):
    failing(session(ONE), "there is no reference", "room.exr", "pytest --render-update")


def test_a_damaged_reference_is_refused_and_renewed(session: Session):
    session(ONE, "--render-update")
    file = Path("references/room.exr")
    file.write_bytes(file.read_bytes()[:2000])
    failing(session(ONE), "room.exr", "renew it with pytest --render-update")
    result = session(ONE, "--render-update")
    result.assert_outcomes(passed=1)
    assert "in place of a damaged file" in text_of(result)
    session(ONE).assert_outcomes(passed=1)


def test_another_size_is_refused(session: Session):
    session(ONE, "--render-update")
    test = "def test_room(same_light):\n    same_light(lambda s: draw(s, (12, 16, 3)), spp=32)\n"
    failing(
        session(test), "16 x 12 pixels and 3 channels, expected 16 x 16 and 3 as in the reference"
    )
    result = session(test, "--render-update")
    result.assert_outcomes(passed=1)
    assert "the new render has 16 x 12 pixels and 3 channels, expected 16 x 16" in text_of(result)


WRONG = {
    "int8": ("(draw(seed) * 255).astype(np.uint8)", "whole numbers (uint8)"),
    "grey": ("draw(seed)[..., 0]", "got shape (16, 16) of float64"),
    "none": ("None", "got NoneType"),
    "ragged": ("draw(seed, (16, 16 + seed % 2, 3))", "expected 16 x 16 and 3 as"),
    "huge": ("draw(seed) * 1e60", "single precision"),
    "same": ("draw(1)", "ignored its seed"),
    "few seeds": ("draw(seed % 3)", "copies among"),
}


@pytest.mark.parametrize("given", WRONG)
def test_a_function_that_draws_no_samples_is_refused(given: str, session: Session):
    code, why = WRONG[given]
    session(ONE, "--render-update")
    test = f"def test_room(same_light):\n    same_light(lambda seed: {code}, spp=32)\n"
    failing(session(test), "InputError", why)
    failing(session(test, "--render-update"), "InputError")


def test_an_error_of_the_function_is_shown_as_it_is(session: Session):
    session(ONE, "--render-update")
    test = """
def test_room(same_light):
    same_light(lambda seed: 1 / 0, spp=32)
"""
    failing(session(test), "ZeroDivisionError: division by zero", "1 / 0")


@pytest.mark.parametrize(
    ("call", "why"),
    [
        ("draws(96)[..., 0], 'a'", "does not show its noise"),
        ("draws(96), 'a', spp=5", "spp=5 is for functions and scenes"),
        ("draw, '../a', spp=5", "must be that of a file"),
        ("draw, 'a', spp=0", "spp must be at least 1"),
        ("draw, 'a', spp=5, finds=1", "finds must lie between 0 and 1"),
        ("draw, 'a', spp=5, cannot_tell='pass'", "cannot_tell must be one of fail, skip"),
        ("draw, 'a', spp=5, seed=-1", "seed must be at least 0"),
        ("[draw(0), draw(1, (8, 8, 3))], 'a'", "expected passes of one shape"),
        ("draw", "give spp="),
    ],
)
def test_calls_that_mean_nothing_are_refused(call: str, why: str, session: Session):
    test = f"def test_room(same_light):\n    same_light({call})\n"
    failing(session(test, "--render-update"), "InputError", why)
    assert not Path("references").exists() or not list(Path("references").iterdir())


@pytest.mark.parametrize("given", ["0", "1", "x"])
def test_alpha_is_a_probability(given: str, session: Session, pytester: pytest.Pytester):
    result = session(ONE, f"--render-alpha={given}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "expected a number between 0 and 1" in result.stderr.str()


def test_a_test_that_was_not_counted_is_refused(session: Session):
    test = "def test_room(request):\n    request.getfixturevalue('same_light')(draw, spp=32)\n"
    failing(session(test), "was not counted among the render tests")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_is_read_only_is_said(session: Session):
    Path("references").mkdir(mode=0o500)
    failing(session(ONE, "--render-update"), "it is read-only")


def test_a_folder_that_cannot_be_made_is_said(session: Session):
    Path("references").write_text("a file")
    failing(session(ONE, "--render-update"), "cannot make the folder")


# --- updates --------------------------------------------------------------------------------------


def test_an_update_keeps_what_does_not_differ(session: Session):
    session(ONE, "--render-update")
    before = Path("references/room.exr").read_bytes()
    result = session(ONE, "--render-update")
    result.assert_outcomes(passed=1)
    assert "kept: room: No difference found" in text_of(result)
    assert Path("references/room.exr").read_bytes() == before


def test_an_update_replaces_what_differs_and_says_how(session: Session):
    session(ONE, "--render-update")
    result = session(ONE, "--render-update", loss=0.1)
    result.assert_outcomes(passed=1)
    assert re.search(r"replaced: room: .* the new render is (9\.\d|1\d) % darker", text_of(result))
    session(ONE, loss=0.1).assert_outcomes(passed=1)


def test_more_samples_make_a_larger_reference(session: Session):
    session(ONE, "--render-update")
    result = session(ONE.replace("32", "64"), "--render-update")
    assert "replaced: room: it now has 192 samples per pixel" in text_of(result)
    assert Reference.read("references/room.exr").spp == 192


def test_spp_is_known_from_the_reference(session: Session):
    session(ONE, "--render-update")
    result = session(ONE.replace(", spp=32", ""), "-v")
    result.assert_outcomes(passed=1)
    assert re.search(r"room no difference found 32 ", text_of(result))


def test_a_reference_is_written_by_one_test(session: Session):
    test = """
@pytest.mark.parametrize("integrator", ["path", "guided"])
def test_room(same_light, integrator):
    same_light(draw, "room", spp=32)
"""
    result = session(test, "--render-update")
    result.assert_outcomes(passed=1, failed=1)
    assert "was already written in this session, by test_renders.py::test_room[path], call 1" in (
        text_of(result)
    )
    session(test).assert_outcomes(passed=2)  # both may be compared with it


def test_samples_of_a_reference_are_those_of_no_test(session: Session):
    test = "def test_room(same_light):\n    same_light(draw, spp=32)\n    " + (
        "print('seeds', *SEEDS)\n"
    )
    noting = "SEEDS = []\nplain = draw\ndef draw(seed):\n    SEEDS.append(seed)\n    "
    noting += "return plain(seed)\n"
    drawn = []
    for options in (["--render-update"], [], ["--render-update"], ["--render-update"]):
        said = session(noting + test, "-s", *options).stdout.str()
        (line,) = re.findall(r"seeds ([\d ]+)", said)
        drawn.append([*map(int, line.split())])
        loss_of_next = drawn[-1]
        assert len(set(loss_of_next)) == len(loss_of_next)
    first, tested, second, third = map(set, drawn)
    assert len(first) == 96
    assert len(tested) == 32
    assert not tested & (first | second)
    assert not first & second
    assert second == third  # which was compared with the first again
    assert max(first | second) < 2**31


def test_the_same_array_is_no_test_but_no_change(session: Session):
    test = "def test_room(same_light):\n    same_light(draws(96))\n"
    session(test, "--render-update")
    result = session(test, "-v")
    result.assert_outcomes(passed=1)
    session(test, "--render-update")
    assert "kept: room: the samples are the same" in text_of(session(test, "--render-update"))


def test_references_lie_in_the_folder_that_the_settings_name(
    session: Session, pytester: pytest.Pytester
):
    pytester.makeini("[pytest]\nrender_references = kept/light\nrender_alpha = 0.002\n")
    session(ONE, "--render-update")
    assert Path("kept/light/room.exr").exists()
    result = session(ONE)
    result.assert_outcomes(passed=1)
    assert "at most 0.2 %" in text_of(result)


# --- alpha ----------------------------------------------------------------------------------------

ALPHAS = """
@pytest.mark.parametrize("k", range(2))
def test_room(same_light, k):
    for call in (1, 2):
        found = same_light(draw, f"room {k} {call}", spp=32)
        if found is not None:
            print(f"alpha={found.alpha!r}")

@pytest.fixture
def box(same_light):
    return same_light

def test_box(box):
    found = box(draw, spp=32)
    if found is not None:
        print(f"alpha={found.alpha!r}")

def test_other():
    pass
"""


def alphas(result: pytest.RunResult) -> list[float]:
    return [float(found) for found in re.findall(r"alpha=(\S+)", result.stdout.str())]


def test_shares_of_alpha_add_up_to_at_most_alpha(session: Session):
    """Union bound: tests share alpha equally, calls of a test have 1/2, 1/4 ... of its share."""
    session(ALPHAS, "--render-update")
    found = alphas(session(ALPHAS, "-s"))
    assert sorted(found) == pytest.approx([0.01 / 3 / 4] * 2 + [0.01 / 3 / 2] * 3)
    assert sum(found) < 0.01


def test_tests_that_are_left_out_have_no_share(session: Session):
    session(ALPHAS, "--render-update")
    assert alphas(session(ALPHAS, "-s", "-k", "box")) == pytest.approx([0.01 / 2])
    two = alphas(session(ALPHAS, "-s", "-k", "room", "--render-alpha=.1"))
    assert two == pytest.approx([0.1 / 4, 0.1 / 8] * 2)


def test_no_test_that_runs_again_gets_another_chance(session: Session, pytester: pytest.Pytester):
    """As plugins do that run failures again: samples and verdict are the same."""
    pytester.makeconftest("""
from _pytest.runner import runtestprotocol
def pytest_runtest_protocol(item, nextitem):
    for _ in range(3):
        item._initrequest()
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    return True
""")
    session(ONE, "--render-update")
    result = session(ONE, "-s", "-v", loss=0.05)
    result.assert_outcomes(failed=1)
    assert "1 render test: 1 differs." in text_of(result)


# --- processes and files --------------------------------------------------------------------------


@pytest.mark.slow
def test_processes_share_alpha_and_one_writes_the_index(session: Session):
    session(ALPHAS, "--render-update", "-n2").assert_outcomes(passed=4)
    result = session(ALPHAS, "-n2", "-v", "--render-report=pages", "--junitxml=j.xml")
    result.assert_outcomes(passed=4)
    assert "5 render tests: none differs" in text_of(result)
    index = Path("pages/index.html").read_text("utf-8")
    for name in ("box", *(f"room {k} {call}" for k in range(2) for call in (1, 2))):
        assert f">{name}</a>" in index
    assert len([*Path("pages").glob("*.html")]) == 6
    values = [
        float(p.attrib["value"])
        for p in ET.parse("j.xml").getroot().iter("property")
        if p.attrib["name"].endswith(".alpha")
    ]
    assert sorted(values) == pytest.approx([0.01 / 3 / 4] * 2 + [0.01 / 3 / 2] * 3)


def test_processes_refuse_two_writers_of_a_reference(session: Session):
    test = """
@pytest.mark.parametrize("integrator", ["path", "guided"])
def test_room(same_light, integrator):
    same_light(draw, "room", spp=32)
"""
    session(test, "--render-update", "-n2").assert_outcomes(passed=1, failed=1)


def test_junit_has_the_numbers(session: Session):
    session(ONE, "--render-update")
    session(ONE, "--junitxml=j.xml")
    found = {p.attrib["name"]: p.attrib["value"] for p in ET.parse("j.xml").iter("property")}
    assert found["room.outcome"] == "no difference found"
    assert 0 < float(found["room.p_value"]) <= 1
    assert 0.001 < float(found["room.smallest_loss_image"]) < 0.05
    assert float(found["room.alpha"]) == pytest.approx(0.005)


def test_pages_stand_alone(session: Session):
    session(ONE, "--render-update")
    session(ONE, "--render-report=out")
    for page in Path("out").glob("*.html"):
        text = page.read_text("utf-8")
        assert not re.search(r"https?://|src=\"(?!data:)|<link", text)
        assert "prefers-color-scheme: dark" in text


def test_pages_quote_names_as_text(session: Session):
    test = """
@pytest.mark.parametrize("k", ["<script>"])
def test_room(same_light, k):
    same_light(draw, spp=32)
"""
    session(test, "--render-update")
    session(test, "--render-report=out")
    assert "[<script>]" not in Path("out/index.html").read_text("utf-8")


def test_help_says_what_there_is(session: Session):
    said = text_of(session(ONE, "--help"))
    for option in ("--render-update", "--render-alpha=ALPHA", "--render-report=FOLDER"):
        assert option in said
    assert "Fail if a render has another light than its reference" in text_of(
        session(ONE, "--fixtures")
    )


def test_a_session_without_render_tests_says_nothing(session: Session):
    result = session("def test_other(): pass\n")
    result.assert_outcomes(passed=1)
    assert "render tests" not in result.stdout.str()
    assert "render test:" not in result.stdout.str()
