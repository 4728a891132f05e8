"""Plugin of pytest: the fixture `same_light`, its options, and what a session says of its renders.

The option ``--render-alpha`` bounds the chance of any false alarm in a session. Each test that asks
for the fixture gets an equal share, and the k-th call within a test 1 / 2^k of that, so that the
shares add up to at most alpha, however many calls a test makes. Tests are counted after
deselection; each process of pytest-xdist collects all of them, and counts the same.

Nothing heavy is loaded until a test calls the fixture. PYTEST_DONT_REWRITE: there is no assertion.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

from chdstat.render_tests.verdicts import RenderCheck, RenderVerdict

if TYPE_CHECKING:
    from chdstat.inference import Contrast

_VERDICTS = "chdstat_verdicts"
"""Attribute of a report that holds the verdicts of its test."""
_CLAIMS = "chdstat_claims"
"""Key under which a process of pytest-xdist is told the folder of claims."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of render tests."""
    group = parser.getgroup("chdstat", "render tests (chdstat)")
    group.addoption(
        "--render-update",
        action="store_true",
        help="write the references of the tests that run, where none is there or the light differs",
    )
    group.addoption(
        "--render-alpha",
        type=_probability,
        metavar="ALPHA",
        help="largest chance of any false alarm among all render tests of the session, default .01",
    )
    group.addoption(
        "--render-report",
        metavar="FOLDER",
        help="write pages of all render tests there; by default, of those that fail, in "
        "render-report",
    )
    parser.addini("render_alpha", "default of --render-alpha", default="0.01")
    parser.addini("render_report", "folder of pages of failures", default="render-report")
    parser.addini(
        "render_references",
        "folder of references, relative to that of the test file",
        default="references",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Begin to count render tests."""
    config.pluginmanager.register(_RenderTests(config), "chdstat-session")


def _probability(text: str) -> float:
    """Return an option as a probability.

    Examples
    --------
    >>> _probability("0.01")
    0.01
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        message = f"expected a number between 0 and 1, got {text!r}"
        raise argparse.ArgumentTypeError(message)
    return value


def _key(text: str, size: int) -> str:
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()


@pytest.fixture
def same_light(request: pytest.FixtureRequest) -> SameLight:
    """Fail if a render has another light than its reference: ``same_light(render, name, spp=256)``.

    `render` is a function ``draw(seed)`` that returns one sample of each pixel, an array (y, x,
    channel), or several, (y, x, channel, sample), of linear radiance. Or it is an array (y, x,
    channel, sample), `chdstat.Samples`, the path of a store, a list of images or EXR files, one of
    each pass, or a scene or its name. The reference is ``references/NAME.exr`` beside the test
    file; ``pytest --render-update`` writes it. The name is that of the test by default. `spp` is
    the number of samples per pixel, by default a third of those of the reference. `seed=1` and so
    on choose other random numbers. ``finds=.01`` also fails if a loss of 1 % of the light would not
    have been found. A test that cannot tell fails, or is skipped with ``cannot_tell="skip"``.
    """
    session: _RenderTests = request.config.pluginmanager.getplugin("chdstat-session")
    return SameLight(request, session)


class SameLight:
    """The fixture `same_light` of one test: it counts calls, and keeps their verdicts."""

    def __init__(self, request: pytest.FixtureRequest, session: _RenderTests) -> None:
        self._item, self._session, self._calls = request.node, session, 0
        self._verdicts = session.verdicts_of[self._item.nodeid] = list[RenderVerdict]()

    def __repr__(self) -> str:
        return "<compares a render with its reference>"

    def __call__(
        self,
        render: Any,
        name: str | None = None,
        *,
        spp: int | None = None,
        seed: int = 0,
        finds: float | None = None,
        cannot_tell: Literal["fail", "skip"] = "fail",
    ) -> Contrast | None:
        """Compare a render with its reference, as the fixture says."""
        __tracebackhide__ = True
        from chdstat.errors import ChdstatError, check_option
        from chdstat.render_tests.checks import verdict_on

        self._calls += 1
        check_option("cannot_tell", cannot_tell, ("fail", "skip"))
        named = self._name(name)
        asked = self._session.check_of(self._item, named, self._calls, spp, seed, finds)
        try:
            verdict, found = verdict_on(render, asked)
        except ChdstatError as error:
            self._note(RenderVerdict(named, asked.test, asked.alpha, "refused", str(error)))
            raise error.with_traceback(None) from None
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            self._note(RenderVerdict(named, asked.test, asked.alpha, "refused", said))
            raise
        self._note(verdict)
        if verdict.outcome == "cannot tell" and cannot_tell == "skip":
            pytest.skip(f"{named}: {verdict.sentence}")
        if not verdict.passed:
            raise AssertionError(self._session.failure(verdict, asked))
        self._item.add_report_section("call", "same_light", f"{named}: {verdict.sentence}\n")
        return found

    def _note(self, verdict: RenderVerdict) -> None:
        self._verdicts.append(verdict)
        self._item.user_properties.extend(verdict.properties().items())

    def _name(self, name: str | None) -> str:
        """Return the name of the reference: a name of a file.

        Raises
        ------
        InputError
            If the name that is given is none.
        """
        own = re.sub(r"[^\w.-]+", "-", self._item.name.removeprefix("test_")).strip("-.")
        if name is None:
            return own if self._calls == 1 else f"{own}-{self._calls}"
        if not isinstance(name, str) or not re.fullmatch(r"[\w][\w. +=,-]*", name):
            from chdstat.errors import InputError

            message = (
                "the name of a reference must be that of a file, of letters, digits, dots and "
                f"dashes, got {name!r}"
            )
            raise InputError(message)
        return name


class _RenderTests:
    """What is known of all render tests of a session."""

    def __init__(self, config: pytest.Config) -> None:
        self._config, self._tests = config, 0
        self._worker = hasattr(config, "workerinput")
        self._asked = set[str]()
        self._claims: Path | None = None
        self.verdicts_of = dict[str, list[RenderVerdict]]()
        self._known = dict[str, list[RenderVerdict]]()
        self._index: Path | None = None
        if (given := config.getoption("render_report")) is not None:
            # Also for processes of pytest-xdist, which may have another folder.
            config.option.render_report = str(config.invocation_params.dir / given)

    # --- asking -----------------------------------------------------------------------------------

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Count the tests that ask for the fixture."""
        asking = [i.nodeid for i in session.items if "same_light" in getattr(i, "fixturenames", ())]
        self._tests, self._asked = len(asking), set(asking)

    @property
    def alpha(self) -> float:
        """Largest chance of a false alarm in the session.

        Raises
        ------
        UsageError
            If the file of settings has no such number.
        """
        given = self._config.getoption("render_alpha")
        try:
            return given or _probability(self._config.getini("render_alpha"))
        except argparse.ArgumentTypeError as error:
            message = f"render_alpha: {error}"
            raise pytest.UsageError(message) from error

    @property
    def always(self) -> bool:
        """Whether tests that pass have pages, too."""
        return self._config.getoption("render_report") is not None

    @property
    def folder(self) -> Path:
        """The folder of pages."""
        given = self._config.getoption("render_report") or self._config.getini("render_report")
        return Path(self._config.invocation_params.dir, given)

    def check_of(
        self,
        item: pytest.Item,
        name: str,
        call: int,
        spp: int | None,
        seed: int,
        finds: float | None,
    ) -> RenderCheck:
        """Return what a call checks.

        Raises
        ------
        InputError
            If the test was not counted.
        """
        if item.nodeid not in self._asked:
            from chdstat.errors import InputError

            message = (
                f"{item.nodeid} was not counted among the render tests, so that its share of alpha "
                "is unknown: name same_light as an argument of the test, or of its fixture"
            )
            raise InputError(message)
        folder = Path(self._config.getini("render_references"))
        by = f"{item.nodeid}, call {call}"
        return RenderCheck(
            name,
            item.path.parent / folder / f"{name}.exr",
            f"{name.replace(' ', '-')}-{_key(by, 3)}",
            item.nodeid,
            self.alpha / self._tests / 2**call,
            spp,
            seed,
            finds,
            update=bool(self._config.getoption("render_update")),
            report=self.folder,
            always=self.always,
            claim=lambda path: self._claim(path, by),
        )

    def failure(self, verdict: RenderVerdict, asked: RenderCheck) -> str:
        """Return what a failed test says."""
        from chdstat._core.files import shown

        lines = [f"{verdict.name}: {verdict.sentence}"]
        if verdict.looks > 1:
            lines.append(
                f"Confirmed: {verdict.spp} other samples per pixel were drawn, and say the same."
                if verdict.outcome == "differ"
                else f"{verdict.spp} other samples per pixel were drawn, and do not clear it."
            )
        lines += [
            f"{word + ':':9}{shown(asked.report / file)}"
            for word, file in (("picture", verdict.picture), ("page", verdict.page))
            if file
        ]
        if verdict.outcome == "differ" and not asked.update:
            lines.append("If this light is right, renew the reference: pytest --render-update")
        return "\n".join(lines)

    # --- references that are written --------------------------------------------------------------

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Tell a process of pytest-xdist where claims are."""
        node.workerinput[_CLAIMS] = str(self._folder_of_claims())

    def _folder_of_claims(self) -> Path:
        if self._claims is None:
            given = getattr(self._config, "workerinput", {}).get(_CLAIMS)
            self._claims = Path(given or tempfile.mkdtemp(prefix="chdstat-claims-"))
        return self._claims

    def _claim(self, reference: Path, by: str) -> None:
        """Note who writes a reference, over all processes.

        Raises
        ------
        InputError
            If another test, or another call, has written it in this session.
        """
        claim = self._folder_of_claims() / _key(str(reference), 16)
        try:
            with claim.open("x", encoding="utf-8") as file:
                file.write(by)
        except FileExistsError:
            other = claim.read_text("utf-8")
            if other != by:
                from chdstat.errors import InputError

                message = (
                    f"{reference.name} was already written in this session, by {other}: give each "
                    "call a name of its own, or update with one of them alone (pytest -k)"
                )
                raise InputError(message) from None

    def pytest_unconfigure(self) -> None:
        """Remove the claims."""
        if self._claims is not None and not self._worker:
            shutil.rmtree(self._claims, ignore_errors=True)

    # --- what was found ---------------------------------------------------------------------------

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Give the verdicts of a test to its report, which other processes see."""
        report = yield
        if found := self.verdicts_of.get(item.nodeid):
            setattr(report, _VERDICTS, [verdict.to_dict() for verdict in found])
            found.clear()
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the verdicts of a test; those of its last run, if it is run again."""
        if found := getattr(report, _VERDICTS, None):
            self._known[report.nodeid] = [RenderVerdict(**verdict) for verdict in found]

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """Write the page of all render tests, if one of them has a page."""
        verdicts = self._verdicts
        if self._worker or not (self.always or any(v.page for v in verdicts)) or not verdicts:
            return
        from chdstat.render_tests.pages import write_index

        self._index = write_index(verdicts, self.alpha, self.folder)

    @property
    def _verdicts(self) -> list[RenderVerdict]:
        return [verdict for found in self._known.values() for verdict in found]

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Say what was found, and what would have been."""
        verdicts = self._verdicts
        if not verdicts:
            return
        from chdstat._core.files import shown
        from chdstat.render_tests.session_summary import lines_of

        terminalreporter.section("render tests")
        for line in lines_of(verdicts, self.alpha, verbose=self._config.get_verbosity() > 0):
            terminalreporter.write_line(line)
        if self._index is not None:
            terminalreporter.write_line(f"report: {shown(self._index)}")
