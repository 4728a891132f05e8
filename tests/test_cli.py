"""Command line: exit codes, messages without tracebacks, JSON for scripts."""

from __future__ import annotations

import json

import pytest

from chdstat.cli import main


@pytest.fixture
def run(monkeypatch, capsys):
    """Run chdstat with arguments; return exit code, output, errors."""

    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["chdstat", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return call


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    import chdstat

    path = tmp_path_factory.mktemp("cli") / "box.zarr"
    chdstat.render("cornell-box", spp=16, size=(12, 10), out=path, backend="scalar")
    return path


def test_help_has_an_example_for_every_command(run):
    code, out, _ = run("--help")
    assert code == 0
    for command in ("render", "info", "analyze", "compare", "report", "doctor"):
        assert command in out
        assert "Example: chdstat" in run(command, "--help")[1]


def test_version(run):
    import chdstat

    assert run("--version")[:2] == (0, f"chdstat {chdstat.__version__}\n")


def test_render_resumes_appends_and_speaks_json(run, tmp_path):
    path = tmp_path / "a.zarr"
    arguments = ("render", "cornell-box", "-o", path, "--size", "8x6", "--backend", "scalar", "-q")
    assert run(*arguments, "--spp", 2)[0] == 0
    code, out, _ = run(*arguments, "--spp", 5, "--json")
    assert code == 0
    said = json.loads(out)
    assert (said["spp"], said["size"], said["scene"]) == (5, [8, 6], "cornell-box")


def test_info_says_what_is_stored(run, store):
    code, out, _ = run("info", store, "--json", "--verify")
    said = json.loads(out)
    assert code == 0
    assert said["shape"] == {"y": 10, "x": 12, "channel": 3, "sample": 16}
    assert (said["complete_spp"], said["pending_chunks"], said["damaged"]) == (16, 0, [])
    assert "complete spp" in run("info", store)[1]


def test_analyze_prints_numbers_and_writes_maps(run, store, tmp_path):
    target = tmp_path / "maps.zarr"
    code, out, _ = run("analyze", store, "-o", target, "--json", "-q")
    assert code == 0
    assert 0 < json.loads(out)["null_share"] < 1
    assert (target / "zarr.json").exists()
    code, _, err = run("analyze", store, "-o", target, "-q")
    assert code == 1
    assert "nothing was overwritten" in err


def test_compare_prints_a_table_and_writes_a_folder(run, store, tmp_path):
    target = tmp_path / "found"
    asked = ("compare", store, "-e", "zirr2018", "-e", "mean", "--n", 4, "-q")
    code, out, _ = run(*asked, "--patterns", "--curve", "-o", target)
    assert code == 0
    lines = [line.strip() for line in out.splitlines()]
    assert lines.index("with neighbours:") < next(
        k for k, line in enumerate(lines) if line.startswith("zirr2018")
    )
    written = {path.name for path in target.iterdir()}
    assert written >= {"comparison.json", "comparison.zarr", "measures.pdf", "pixels.pdf"}
    assert written >= {"breakdown.pdf", "curve.pdf", "estimates.pdf"}
    code, _, err = run(*asked, "-o", target)
    assert code == 1
    assert "nothing was overwritten" in err


def test_compare_speaks_json(run, store):
    code, out, _ = run("compare", store, "-e", "mean", "--n", 4, "-q", "--json")
    said = json.loads(out)
    assert code == 0
    assert (said["n"], said["table"][0]["mse_ratio"]) == (4, 1)


def test_report_writes_a_pdf(run, store, tmp_path):
    target = tmp_path / "box.pdf"
    code, out, _ = run("report", store, "-o", target, "-q")
    assert (code, out) == (0, f"wrote {target}\n")
    assert target.read_bytes().startswith(b"%PDF")


def test_doctor_says_what_runs(run, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    code, out, _ = run("doctor", "--json")
    said = json.loads(out)
    assert code == 0
    assert said["backends"]["scalar"].startswith("works")
    assert said["versions"]["mitsuba"][0].isdigit()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "bathrom", "-o", "x.zarr"), "did you mean 'bathroom'"),
        (("compare", "nowhere.zarr"), "no store at nowhere.zarr"),
        (("render", "cornell-box", "-o", "x.zarr", "--spp", "0"), "spp must be at least 1, got 0"),
        (("render", "cornell-box", "-o", "x.zarr", "--size", "12"), "--size takes WIDTHxHEIGHT"),
        (("render", "cornell-box", "-o", "x.zarr", "-D", "a"), "-D takes KEY=VALUE, got 'a'"),
        (("render", "cornell-box", "-o", "x.zarr", "-D", "a=1"), "takes no parameters"),
        (("render", "cornell-box", "-o", "x.zarr", "--backend", "gpu"), "backend must be one of"),
        (("info", "nowhere.zarr"), "no store at nowhere.zarr"),
        (("analyze", "nowhere.zarr"), "no store at nowhere.zarr"),
        (("analyze", "s.zarr", "--threshold", "tail=1"), "one of alpha, null_share"),
        (("analyze", "s.zarr", "--threshold", "alpha=many"), "takes a number, got 'many'"),
        (("analyze", "s.zarr", "--threshold", "alpha"), "--threshold takes KEY=VALUE"),
        (("analyze", "s.zarr", "--threshold", "alpha=2"), "null_share and firefly_share in (0, 1)"),
        (("report", "nowhere.xml", "-o", "x.pdf"), "no built-in scene or file 'nowhere.xml'"),
        (("report", "cornell-box", "-o", "x.txt"), "must end in .pdf"),
    ],
)
def test_bad_input_ends_with_a_message_and_no_traceback(
    run, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments)
    assert code == 1
    assert message in err
    assert "Traceback" not in out + err
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_the_traceback(monkeypatch):
    from chdstat.errors import StoreError

    monkeypatch.setattr("sys.argv", ["chdstat", "--debug", "info", "nowhere.zarr"])
    with pytest.raises(StoreError):
        main()


def test_damage_is_found_and_named(run, tmp_path):
    import chdstat

    path = tmp_path / "box.zarr"
    chdstat.render("cornell-box", spp=4, size=(8, 8), out=path, backend="scalar")
    shard = path / "radiance/c/0/0/0/0"
    shard.write_bytes(shard.read_bytes()[:-40])
    code, out, err = run("info", path, "--verify", "--json")
    assert code == 1
    assert json.loads(out)["damaged"] == [str(shard)]
    assert "1 damaged chunk(s)" in err
    assert run("analyze", path, "-q")[0] == 1


def test_an_interrupt_says_how_to_go_on(run, monkeypatch):
    import chdstat.samples

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(chdstat.samples, "inspect", stop)
    code, _, err = run("info", "x.zarr")
    assert code == 130
    assert "resume" in err
