"""Command line: exit codes, messages without tracebacks, JSON for scripts."""

from __future__ import annotations

import json
import re
import shutil
import sys
from inspect import signature
from pathlib import Path
from typing import get_args
from xml.etree.ElementTree import parse

import numpy as np
import pytest
from pypdfium2 import PdfDocument
from typer.main import get_command

import chdstat as chd
import chdstat.samples
import chdstat.studies
from chdstat.cli import arguments, main, output, program
from chdstat.inference import Reference
from chdstat.io import write_exr, write_reference
from chdstat.rendering.jobs import SETTINGS
from chdstat.rendering.seeds import SamplerName

ROOT = Path(chd.__file__).parent


@pytest.fixture(scope="module")
def store(stored):
    return stored(spp=16, size=(12, 10))


COMMANDS = get_command(program.app).commands
STORE = "a finished store"
"""Stands for the path of one among arguments."""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example(run, name):
    assert name in run("--help")[1]
    assert "Example: chdstat" in run(name, "--help")[1]
    paragraphs = COMMANDS[name].help.split("\n\n")
    assert not any("\n" in text for text in paragraphs), "a terminal breaks lines where it ends"
    for option in COMMANDS[name].params:
        optional = option.param_type_name == "option" and not option.is_flag and not option.required
        if optional:
            assert option.show_default, option.name
            assert option.default is not None or isinstance(option.show_default, str), option.name
    if name != "explore":
        (flag,) = (option for option in COMMANDS[name].params if "--json" in option.opts)
        assert flag.is_flag


def test_dependent_samples_are_named_and_refused(run, store, tmp_path):
    path = tmp_path / "spread.zarr"
    size = ("--size", "12x10", "--backend", "scalar", "--seed", "5")
    code, _, err = run(
        "render", "cornell-box", "-o", path, "--spp", "64", *size, "--sampler=stratified"
    )
    assert code == 0
    assert f"next: chdstat contrast OTHER.zarr {path}" in err
    assert "in sequences of 16 samples that depend on each other" in run("info", path)[1]
    assert json.loads(run("info", path, "--json")[1])["sequence"] == 16
    code, out, _ = run("contrast", store, path)
    assert code in (0, 3, 4)
    assert "averages of 16" in out
    for command in (("analyze",), ("compare",), ("report", "-o", tmp_path / "r.pdf")):
        code, _, err = run(command[0], path, *command[1:])
        assert code == 2
        assert "expected independent samples" in err


@pytest.mark.parametrize(
    ("command", "least"),
    [("report", 2), ("analyze", 2), ("estimate", 4), ("compare", 64), ("train", 64)],
)
@pytest.mark.parametrize("spp", [1, 2, 3])
def test_too_few_samples_are_refused_in_words(run, tmp_path, command, least, spp):
    """What tells something of them is said, with reasons for the rest; nothing is written else."""
    x = np.random.default_rng(spp).lognormal(size=(12, 10, 3, spp)).astype(np.float32)
    store = tmp_path / "few.zarr"
    chd.Samples.from_array(x, axes="yxcs").save(store)
    out = tmp_path / {"report": "r.pdf", "estimate": "e.exr", "train": "t.safetensors"}.get(
        command, "maps.zarr"
    )
    code, said, err = run(command, store, "-o", out)
    if spp < least:
        assert code == 2
        assert f"at least {least}" in err
        assert "got" in err
        assert "render more" in err
        assert not out.exists()
    else:
        assert code == 0
        assert out.exists()
        assert command == "report" or f"{spp} samples per pixel tell no distribution" in said


def test_a_stack_of_one_image_tells_no_distribution(run, tmp_path):
    image, store = tmp_path / "one.exr", tmp_path / "one.zarr"
    chd.io.write_image(image, np.full((6, 8, 3), 0.5, dtype=np.float32))
    assert run("import", image, "-o", store)[0] == 0
    code, _, err = run("report", store, "-o", tmp_path / "r.pdf")
    assert code == 2
    assert "got 1: one sample tells nothing about a distribution" in err
    assert run("contrast", store, store)[0] == 4


def test_alone_it_shows_the_flow_in_its_order(run):
    code, out, _ = run()
    assert code == 0
    steps = ["render", "info", "analyze", "contrast", "compare", "train", "estimate", "report"]
    places = [out.index(f"\n  chdstat {step} ") for step in [*steps, "explore", "study"]]
    assert places == sorted(places)


def test_list_has_a_sentence_for_each_name(run):
    found = json.loads(run("list", "--json")[1])
    assert list(found) == ["scenes", "estimators", "families", "patterns", "formats"]
    assert set(found["estimators"]) == set(chd.estimators.names())
    for kind, rows in found.items():
        assert json.loads(run("list", kind, "--json")[1]) == rows
        shown = run("list", kind)[1].splitlines()
        assert [line.split()[0] for line in shown] == list(rows)
        for name, sentence in rows.items():
            assert sentence[0].isupper() or not sentence[0].isalpha(), name
            assert sentence.endswith("."), name
            assert "partial(" not in sentence, name


def test_the_shell_completes_scenes(run, monkeypatch):
    monkeypatch.setenv("_CHDSTAT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "chdstat render bath")
    monkeypatch.setenv("COMP_CWORD", "2")
    assert "bathroom" in run()[1]


LIBRARY = {
    "train": chd.estimators.train_model,
    "estimate": chd.estimate,
    "compare": chd.compare,
    "study": chd.study,
}


def test_a_render_has_its_options():
    """An option that is not given is no argument: the library knows what holds then."""
    assert arguments.CommonOptions().settings == {}
    texts = {"size": "12x8", "crop": "1,2,3x4", "integrator": '{"type": "path"}', "spp": 3}
    settings = {"spp": 3, "size": (12, 8), "integrator": {"type": "path"}, "crop": (1, 2, 3, 4)}
    assert arguments.CommonOptions.of(texts).settings == settings
    options = {option.name: option for option in COMMANDS["render"].params}
    for name, setting in SETTINGS.items():
        assert options[name].default is None
        if setting.default is not None:
            assert options[name].show_default == str(setting.default), name


@pytest.mark.parametrize("command", ["render", "study"])
def test_the_help_names_every_sampler(command):
    (option,) = (one for one in COMMANDS[command].params if one.name == "sampler")
    assert all(name in option.help for name in get_args(SamplerName))


@pytest.mark.parametrize("command", LIBRARY)
def test_defaults_are_the_library_s(command):
    """But for those that a store has, or that are the library's where they are not given."""
    taken = {option.name: option for option in COMMANDS[command].params}
    others = {"source", "out", "store", "scenes", "estimators", "folder"}
    for name, option in signature(LIBRARY[command]).parameters.items():
        if name in taken.keys() - others and taken[name].default is not None:
            assert taken[name].default == option.default, name


def test_a_reader_finds_spp_in_few_files(run, tmp_path):
    """From --spp to the store: the files whose functions take it, as a parameter or a variable."""
    files: dict[str, set[str]] = {}

    def note(frame, event, _):
        code, place = frame.f_code, Path(frame.f_code.co_filename)
        if event == "call" and ROOT in place.parents and "spp" in code.co_varnames:
            files.setdefault(str(place.relative_to(ROOT)), set()).add(code.co_name)

    path, small = tmp_path / "a.zarr", ("--size", "4x4", "--backend", "scalar")
    code, _, err = run("render", "cornell-box", "-o", path, "--spp", 2, *small, "-q")
    assert (code, err) == (0, "")
    sys.setprofile(note)  # of what is loaded by now
    try:
        code, out, _ = run("render", "cornell-box", "-o", path, "--spp", 5, "--json", "-q")
    finally:
        sys.setprofile(None)
    said = json.loads(out)
    assert (code, said["spp"], said["size"], said["scene"]) == (0, 5, [4, 4], "cornell-box")
    told = "\n".join(f"{file}: {', '.join(sorted(names))}" for file, names in files.items())
    print(f"{len(files)} files take spp on its way to the store:\n{told}")
    assert {"rendering/renders.py", "samples/store.py"} <= files.keys()
    assert len(files) <= 6, told


def test_info_says_what_is_stored(run, store):
    code, out, _ = run("info", store, "--json", "--verify")
    said = json.loads(out)
    assert code == 0
    assert said["shape"] == {"y": 10, "x": 12, "channel": 3, "sample": 16}
    assert (said["complete_spp"], said["pending_chunks"], said["damaged"]) == (16, 0, [])
    code, out, err = run("info", store)
    rows = dict(re.split(r"  +", line, maxsplit=1) for line in out.splitlines())
    assert rows["Image"] == "12 × 10 pixels, 3 channels, 16 samples per pixel"
    assert rows["State"] == "complete"
    assert f"next: chdstat analyze {store}" in err


def test_info_says_that_a_render_was_stopped(run, store, monkeypatch):
    stopped = chd.samples.inspect(store) | {"complete_spp": 8, "pending_chunks": 2}
    monkeypatch.setattr(chd.samples, "inspect", lambda *_, **__: stopped)
    code, out, err = run("info", store)
    assert code == 0
    assert "stopped: every pixel has 8 of 16 samples, and 2 chunks are missing; the same" in out
    assert not err


def test_analyze_speaks_in_sentences_and_writes_maps(run, store, tmp_path, monkeypatch):
    target = tmp_path / "maps.zarr"
    code, numbers, _ = run("analyze", store, "-o", target, "--json", "-q")
    numbers = json.loads(numbers)
    assert code == 0
    assert (target / "zarr.json").exists()
    code, _, err = run("analyze", store, "-o", target, "-q")
    assert code == 2
    assert "nothing was overwritten" in err
    code, whole, err = run("analyze", store, "-o", target, "--overwrite")
    assert code == 0
    assert "12 × 10 pixels with 16 samples each." in whole
    assert f"{100 * numbers['null_share']:.0f}\xa0% of all samples carry no light." in whole
    share = f"{100 * numbers['patterns']['null_heavy']:.1f}\xa0%"
    assert re.search(rf"^null-heavy +{share}  most paths find no light", whole, re.MULTILINE)
    assert err.splitlines()[-1].startswith("next: chdstat explore")
    monkeypatch.setenv("COLUMNS", "70")
    lines = run("analyze", store, "-q")[1].splitlines()
    assert max(map(len, lines)) <= 70
    assert "".join(whole.split())[:200] == "".join("".join(lines).split())[:200]


def test_nothing_but_an_output_is_overwritten(run, store, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/text.tex").write_text("years of work")
    for target in (tmp_path / "thesis", store):
        code, _, err = run("analyze", store, "-o", target, "--overwrite", "-q")
        assert code == 2
        assert "is no output of this command; remove it yourself" in err
    assert (tmp_path / "thesis/text.tex").exists()
    code, _, err = run("render", "cornell-box", "-o", store, "--overwrite")
    assert code == 2
    assert "a store of samples is resumed or appended to" in err


def test_a_store_is_exported_as_a_reference(run, stored, tmp_path):
    path, file = stored(spp=96, size=(12, 10)), tmp_path / "box.exr"
    code, out, err = run("export", path, "-o", file, "--json")
    assert (code, json.loads(out)["spp"], json.loads(out)["path"]) == (0, 96, str(file))
    assert f"next: chdstat contrast RENDER.zarr {file}" in err
    found = Reference.read(file)
    assert (found.known, found.attrs["scene"]) == ("batches", "cornell-box")
    assert found.attrs["integrator"]["type"] == "path"
    code, _, err = run("export", path, "-o", tmp_path / "box.nc")
    assert code == 2
    assert "must end in .exr" in err
    code, _, err = run("export", tmp_path / "none", "-o", tmp_path / "none.exr")
    assert code == 2
    assert "or a finished store" in err


def test_contrast_has_an_exit_code_and_a_page(run, store, tmp_path):
    again, dark = tmp_path / "again.zarr", tmp_path / "dark.zarr"
    other = chd.render("cornell-box", spp=16, size=(12, 10), seed=1, out=again, backend="scalar")
    chd.Samples.from_array(0.5 * other.read(), scene="cornell-box").save(dark)
    page = tmp_path / "page.pdf"
    code, out, err = run("contrast", store, again, "-o", page)
    assert (code, out.split(" (")[0]) == (0, "No difference found")
    assert "efficiency of B over A" in out
    assert f"chdstat explore {store} {again}" in err
    assert len(PdfDocument(page)) == 1
    code, out, err = run("contrast", store, dark, "--json", "-q")
    assert (code, json.loads(out)["outcome"], err) == (3, "differ", "")
    code, out, _ = run("contrast", store, store)
    assert (code, out.split(":")[0]) == (4, "Cannot tell")
    code, out, err = run("contrast", store, again, "--seconds", "1e9")
    assert (code, out) == (2, "")
    assert "render more of them" in err


@pytest.fixture(scope="module")
def compared(stored, tmp_path_factory):
    """Return the paths of a right render, a darker one, and a reference."""
    folder = tmp_path_factory.mktemp("compared")
    right, other = (stored(spp=96, size=(12, 10), seed=seed) for seed in (0, 3))
    dark = chd.Samples.from_array(0.7 * chd.open(right).read()).save(folder / "dark.zarr").path
    reference = write_reference(Reference.of_samples(other), folder / "reference.exr")
    return right, dark, reference


def test_stores_are_ranked_by_their_noise(run, stored, tmp_path):
    stores = [stored(spp=96, size=(12, 10), seed=seed) for seed in (0, 3)]
    noisy = chd.Samples.from_array(
        16 * chd.open(stores[0]).read() * (np.arange(96) % 16 == 0).astype(np.float32),
        scene="cornell-box",
    )
    stores.append(noisy.save(tmp_path / "noisy.zarr").path)
    page = tmp_path / "page.pdf"
    _, out, err = run("contrast", *stores, "-o", page)
    *_, last = [line.split() for line in out.splitlines() if line.startswith(str(tmp_path))]
    assert last[:2] == [str(stores[-1]), "96"]
    assert "least noisy" in out
    assert f"next: chdstat report {stores[0]}" in err
    assert len(PdfDocument(page)) == 1
    code, out, _ = run("contrast", *stores, "--json", "-q")
    order = json.loads(out)["noise"]["orders"]["equal spp"]
    assert (code, order["names"][-1]) == (run("contrast", *stores, "-q")[0], str(stores[-1]))
    code, out, _ = run("report", *stores[:2], "-o", tmp_path / "report.pdf", "-q")
    assert (code, "2 pages" in out) == (0, True)
    for command, meant in {"compare": "contrast", "analyze": "report"}.items():
        code, _, err = run(command, *stores[:2])
        assert code == 2
        assert f"chdstat {meant}" in " ".join(err.split())


@pytest.mark.filterwarnings("ignore:A and B are renders of two scenes")
def test_stores_of_two_scenes_are_not_ranked_and_it_is_said_why(run, stored, tmp_path):
    stores = [stored(spp=96, size=(12, 10), seed=seed) for seed in (0, 3)]
    other = tmp_path / "fog.zarr"
    size = "--size", "12x10", "--backend", "scalar"
    assert run("render", "gallery", *size, "--spp", 96, "-o", other, "-q")[0] == 0
    said = f"cornell-box in {stores[0]} and gallery in {other}"
    code, out, _ = run("contrast", *stores, other)
    assert code == 3
    out = " ".join(out.split())
    assert f"no ranking by noise: expected renders of one scene, got {said}" in out
    assert f"each render is A, and {other} is B" in out
    code, _, err = run("contrast", *stores, other, "-o", tmp_path / "page.pdf")
    assert (code, said in " ".join(err.split())) == (2, True)
    small = chd.Samples.from_array(chd.open(stores[0]).read()[:6]).save(tmp_path / "s.zarr").path
    code, _, err = run("contrast", *stores, small)
    assert (code, f"B, {small}, 12 x 6" in " ".join(err.split())) == (2, True)
    assert "isel" not in err


def test_several_renders_are_contrasted_with_one_reference(run, compared, tmp_path):
    right, dark, reference = compared
    table = tmp_path / "found.xml"
    code, out, err = run("contrast", right, dark, reference, "--junit", table)
    assert code == 3
    assert out.startswith("1 of 2 renders differ")
    assert f"- {dark}: The means differ" in out
    assert "next: chdstat explore" in err
    suite = parse(table).getroot()[0]
    assert {name: suite.get(name) for name in ("tests", "failures", "skipped")} == {
        "tests": "2",
        "failures": "1",
        "skipped": "0",
    }
    passed, failed = suite
    assert (passed.get("name"), failed.get("name")) == (str(right), str(dark))
    assert passed.find("failure") is None
    assert failed.find("failure").get("message").startswith("The means differ")
    assert "would have found a loss" in passed.findtext("system-out")
    assert float(passed.get("time")) > 0
    code, out, _ = run("contrast", right, dark, reference, "--junit", table, "--json", "-q")
    found = json.loads(out)
    assert (code, found["outcome"], found["alpha"]) == (3, "differ", 0.05)
    assert {name: of["alpha"] for name, of in found["contrasts"].items()} == {
        str(right): 0.025,
        str(dark): 0.025,
    }


def test_a_render_of_few_samples_is_skipped(run, compared, stored, tmp_path):
    few = stored(spp=4, size=(12, 10))
    code, _, _ = run("contrast", few, compared[2], "--junit", tmp_path / "a.xml", "-q")
    assert code == 4
    (case,) = parse(tmp_path / "a.xml").getroot()[0]
    assert case.find("skipped").get("message").startswith("Cannot tell")


@pytest.mark.filterwarnings("default::chdstat.errors.InputWarning")
def test_a_scene_is_drawn_until_it_tells(run, compared):
    asked = ("contrast", "cornell-box", compared[2], "--backend", "scalar", "--json", "-q")
    code, out, _ = run(*asked, "--spp", 64)
    found = json.loads(out)
    assert (code, found["outcome"], found["spp"][0]) == (0, "no difference found", 64)
    assert found["a"] == "cornell-box"
    code, out, err = run(*asked, "--spp", 128, "--max-depth", 1)
    assert code == 3
    assert 'drawn by the integrator {"max_depth": 1' in err
    assert json.loads(out)["spp"][0] < 128
    code, _, err = run(*asked, "--seed", 3)
    assert code == 2
    assert "give another --seed" in err


def test_images_and_passes_are_renders_and_references(run, compared, tmp_path):
    right, _, reference = compared
    x = chd.open(right).read()
    (tmp_path / "passes").mkdir()
    for k in range(12):
        batch = x[..., 8 * k : 8 * k + 8].mean(axis=-1)
        write_exr(tmp_path / f"passes/{k:02}.exr", batch, attributes={"samplesPerPixel": "8"})
    code, out, _ = run("contrast", tmp_path / "passes", reference, "--json", "-q")
    assert (code, json.loads(out)["outcome"]) == (0, "no difference found")
    code, out, _ = run("contrast", right, tmp_path / "passes", "--json", "-q")
    assert json.loads(out)["reference"] == "batches"
    mean = write_exr(tmp_path / "mean.exr", x.mean(axis=-1))
    variance = write_exr(tmp_path / "spread.exr", x.var(axis=-1))
    asked = ("--variance", variance, "--reference-spp", 96)
    code, out, _ = run("contrast", right, mean, *asked, "--json", "-q")
    found = json.loads(out)
    assert (found["reference"], found["spp"][1]) == ("variance", 96)
    variance.rename(tmp_path / "mean_var.exr")
    code, out, _ = run("contrast", mean, reference, "--render-spp", 96, "--json", "-q")
    assert (code, json.loads(out)["outcome"]) == (0, "no difference found")


def test_info_says_what_a_reference_cannot_show(run, compared, tmp_path):
    code, out, err = run("info", compared[2])
    assert code == 0
    assert "by means of 48 batches" in out
    assert "cornell-box" in out
    assert f"next: chdstat contrast RENDER.zarr {compared[2]}" in err
    image = write_exr(tmp_path / "a.exr", np.ones((4, 5, 3)))
    code, out, _ = run("info", image, "--json")
    found = json.loads(out)
    assert (code, found["spp"], found["noise"]) == (0, None, "unknown")
    assert "no noise" in found["cannot show"][0]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("RIGHT",), "a render and what to contrast it with"),
        (("RIGHT", "RIGHT", "REFERENCE"), "twice"),
        (("RIGHT", "DARK", "REFERENCE", "-o", "page.pdf"), "about one render or several stores"),
        (("RIGHT", "REFERENCE", "--spp", "64"), "spp"),
        (("RIGHT", "REFERENCE", "--finds", ".01"), "--finds"),
        (("RIGHT", "REFERENCE", "--render-spp", "64"), "--render-spp is for images"),
        (("RIGHT", "REFERENCE", "--junit", "scene.xml"), "scene.xml exists"),
        (("RIGHT", "REFERENCE", "--junit", "found.txt"), ".xml"),
        (("RIGHT", "REFERENCE", "--reference-spp", "64"), "leave out spp"),
        (("cornel-box", "REFERENCE"), "did you mean 'cornell-box'"),
        (("none.exr", "REFERENCE"), "none.exr"),
        (("RIGHT", "none.exr"), "none.exr"),
        (("RIGHT", "none"), "none"),
    ],
)
def test_contrasts_that_make_no_sense_are_refused(
    run, compared, tmp_path, monkeypatch, arguments, named
):
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text("<scene version='3.0.0'/>")
    paths = dict(zip(("RIGHT", "DARK", "REFERENCE"), compared, strict=True))
    code, out, err = run("contrast", *(paths.get(one, one) for one in arguments), "-q")
    assert (code, out) == (2, "")
    assert named in err
    assert Path("scene.xml").read_text() == "<scene version='3.0.0'/>"


def test_compare_prints_a_table_and_writes_a_folder(run, store, tmp_path):
    target = tmp_path / "found"
    asked = ("compare", store, "-e", "zirr2018", "-e", "mean", "--n", 4, "-q")
    code, out, _ = run(*asked, "--patterns", "--curve", "-o", target)
    assert code == 0
    lines = [line.strip() for line in out.splitlines()]
    assert re.match(r"sample mean +1\.00 +(1\.00|cannot tell) ", lines[lines.index("") + 3])
    assert "- use neighbours: Zirr et al. 2018." in lines
    written = {path.name for path in target.iterdir()}
    assert written >= {"comparison.json", "comparison.zarr", "measures.pdf", "pixels.pdf"}
    assert written >= {"breakdown.pdf", "curve.pdf", "estimates.pdf"}
    code, _, err = run(*asked, "-o", target)
    assert code == 2
    assert "nothing was overwritten" in err


def test_a_model_is_trained_and_estimates(run, stored, tmp_path):
    store = stored()
    model, image = tmp_path / "box.safetensors", tmp_path / "box.exr"
    asked = ("train", store, "-o", model, "--iterations", 3, "-q")
    assert run(*asked)[:2] == (0, f"wrote {model}\n")
    code, _, err = run(*asked)
    assert code == 2
    assert "exists; nothing was overwritten. Give another path, or --overwrite" in err
    asked = (*asked[:-1], "--json", "--overwrite")
    code, out, err = run(*asked)
    said = {"path": str(model), "estimator": "elek2019", "iterations": 3}
    assert (code, json.loads(out)) == (0, said)
    *_, line = err.splitlines()
    assert line == f"next: chdstat estimate {store} --model {model} --spp 32 -o {image}"
    asked = ("estimate", store, "-o", image, "--model", model, "--spp", 32, "--level", 0.5, "-q")
    said = f"wrote {image}: linear radiance with all layers, for an EXR viewer\n"
    assert run(*asked)[:2] == (0, said)
    found = chd.io.read_exr(image)
    assert found.image.shape == (16, 24, 3)
    assert set(found.extra) == {"certainty", "low", "high", "mean"}
    assert (found.attributes["spp"], found.attributes["level"]) == ("32", "0.5")


@pytest.mark.parametrize("rendering", [False, True])
def test_estimate_renders_and_keeps_a_store(run, tmp_path, rendering):
    image, kept = tmp_path / "box.exr", tmp_path / "box.zarr"
    asked = ("estimate", "cornell-box", "-o", image, "--spp", 8, "--size", "10x8", "-q")
    more = ("--while-rendering",) if rendering else ("--store", kept)
    code, _, err = run(*asked, "--backend", "scalar", *more)
    assert (code, err) == (0, "")
    assert list(tmp_path.glob("*.zarr")) == ([] if rendering else [kept])
    found = chd.io.read_exr(image)
    assert found.attributes["estimator"] == "combination"
    assert found.image.shape == (8, 10, 3)
    assert {"certainty", "low", "high", "mean"} <= set(found.extra)


@pytest.mark.parametrize("quiet", [False, True])
def test_each_pass_says_its_error(run, tmp_path, caplog, quiet):
    asked = ("estimate", "cornell-box", "-o", tmp_path / "box.exr", "--while-rendering")
    size = ("--spp", 32, "--size", "10x8", "--backend", "scalar", *["-q"] * quiet)
    assert run(*asked, *size)[0] == 0
    told = "\n".join(caplog.messages).replace("\N{NO-BREAK SPACE}", " ")
    passes = re.findall(
        r"(\d+) spp: relative error .+ %\]; .+ % takes about [\d,]+ spp, .+ more", told
    )
    assert passes == ([] if quiet else ["16", "32"])


def test_a_report_says_its_pages(run, store, tmp_path):
    target = tmp_path / "box.pdf"
    asked = ("report", store, "-o", target, "-e", "mean", "--json")
    code, out, err = run(*asked)
    pages = len(PdfDocument(target))
    assert (code, json.loads(out)) == (0, {"path": str(target), "pages": pages})
    assert err.splitlines()[-1] == f"next: chdstat explore {store}"


def test_doctor_says_what_runs(run, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    code, out, _ = run("doctor", "--json")
    said = json.loads(out)
    assert code == 0
    assert said["backends"]["scalar"].startswith("works")
    assert said["versions"]["mitsuba"][0].isdigit()
    assert said["denoiser"].startswith("Open Image Denoise ")
    assert said["other_renderers"]["Cycles"].startswith(("works: Cycles", "does not work: "))
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert "Open Image Denoise cannot be loaded" in " ".join(run("doctor")[1].split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "bathrom", "-o", "x.zarr"), "did you mean 'bathroom'"),
        (("render", "cornell-box", "-o", "x.zarr", "--size", "12"), "--size takes WIDTHxHEIGHT"),
        (("render", "cornell-box", "-o", "x.zarr", "-D", "a"), "-D takes KEY=VALUE, got 'a'"),
        (("render", "cornell-box", "-o", "x.zarr", "-D", "a=1"), "takes no parameters"),
        (("info", "nowhere.zarr"), "no store at nowhere.zarr"),
        (("info", __file__), "is a file; a store is a folder"),
        (("info", __file__), "another renderer with: chdstat import"),
        (("render", STORE, "-o", "x.zarr"), "is a store, of samples that are rendered already"),
        (("estimate", STORE, "-o", "a.exr", "--seed", 3), "a setting of a render, but"),
        (("analyze", "s.zarr", "--threshold", "tail=1"), "did you mean 'tail_index'?"),
        (("analyze", "s.zarr", "--threshold", "alpha=many"), "takes a number, got 'many'"),
        (("analyze", "s.zarr", "--threshold", "alpha"), "--threshold takes KEY=VALUE"),
        (("train", "box", "-o", "a.txt"), "must end in .safetensors"),
        (("train", "nowhere.zarr", "-o", "a.safetensors"), "no store at 'nowhere.zarr'"),
        (("estimate", STORE, "-o", "a.gif"), "must end in .exr, .npy, .pfm, .png, got 'a.gif'"),
        (("report", "nowhere.xml", "-o", "x.pdf"), "no scene file at 'nowhere.xml'"),
        (("estimate", STORE, "-o", "a.exr", "--while-rendering"), "takes a scene, not a store"),
        (("report", STORE, "-o", "a.pdf", "--size", "8x8"), "a setting of a render, but"),
        (("study", STORE, "--spp", "17"), "spp must be from 1 to 16"),
        (("explore", STORE, "-D", "a=1"), "a setting of a render, but"),
    ],
)
def test_bad_input_ends_with_a_message_and_no_traceback(
    run, store, tmp_path, monkeypatch, arguments, message
):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*(store if argument is STORE else argument for argument in arguments))
    assert code == 2
    assert message in err
    assert "Traceback" not in out + err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("analyze", STORE), "a.zarr"),
        (("bench", STORE), "a.csv"),
        (("compare", STORE), "a"),
        (("contrast", STORE, STORE), "a.pdf"),
        (("estimate", STORE), "a.png"),
        (("export", "maps.zarr"), "a.exr"),
        (("paper",), "a.pdf"),
        (("report", STORE), "a.pdf"),
        (("study", STORE), "a.pdf"),
        (("train", STORE), "a.safetensors"),
    ],
)
def test_what_is_there_is_not_overwritten_unasked(run, store, tmp_path, arguments, name):
    (tmp_path / name).write_text("mine")
    asked = [store if argument is STORE else argument for argument in arguments]
    code, out, err = run(*asked, "-o", tmp_path / name)
    assert (code, out) == (2, "")
    assert "exists; nothing was overwritten. Give another path, or --overwrite" in err
    assert (tmp_path / name).read_text() == "mine"
    (option,) = (o for o in COMMANDS[arguments[0]].params if o.name == "overwrite")
    assert option.help == "Replace an output that is there already."


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("anlyze",), "Did you mean 'analyze'?"),
        (("classify", STORE), "It is what 'chdstat analyze' does."),
        (("help", "denoise"), "It is what 'chdstat estimate --denoise' does."),
    ],
)
def test_an_unknown_command_points_to_another(run, arguments, message):
    code, _, err = run(*arguments)
    assert code == 2
    assert message in re.sub(r"[\s│]+", " ", err)


def test_help_and_version_are_found_where_one_looks(run):
    assert run("help") == run("--help")
    assert run("help", "info") == run("info", "--help")
    assert run("-v") == run("--version") == (0, f"chdstat {chd.__version__}\n", "")


def test_damage_is_found_and_named(run, store, tmp_path):
    path = tmp_path / "box.zarr"
    shutil.copytree(store, path)
    shard = path / "radiance/c/0/0/0/0"
    shard.write_bytes(shard.read_bytes()[:-40])
    code, out, err = run("info", path, "--verify", "--json")
    assert code == 2
    assert json.loads(out)["damaged"] == [str(shard)]
    assert "1 damaged file(s)" in err
    assert run("analyze", path, "-q")[0] == 2


def test_a_wrong_choice_is_named_as_it_is_typed(run, tmp_path):
    code, _, err = run("paper", "-o", tmp_path / "x.pdf", "--change", "tagets")
    assert code == 2
    assert err.startswith("chdstat: --change must be one of targets, pixels")


def test_debug_shows_the_traceback(monkeypatch):
    from chdstat.errors import StoreError

    monkeypatch.setattr("sys.argv", ["chdstat", "--debug", "info", "nowhere.zarr"])
    with pytest.raises(StoreError):
        main()


def test_an_interrupt_says_how_to_go_on(run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(chdstat.samples, "inspect", stop)
    assert run("info", "x.zarr")[::2] == (130, "chdstat: stopped\n")
    monkeypatch.setattr(chd, "render", stop)
    for line in (("-o", "x.zarr"), ("--out=x.zarr",)):
        assert run("render", "cornell-box", *line)[::2] == (130, "chdstat: stopped\n")
    (tmp_path / "x.zarr").mkdir()  # as a render makes it that has begun
    for line in (("-o", "x.zarr"), ("--out=x.zarr",)):
        code, _, err = run("render", "cornell-box", *line)
        assert (code, err) == (130, "chdstat: stopped; the same command goes on from here\n")
    monkeypatch.setattr(chdstat.studies, "paper", stop)
    assert run("paper", "-o", "x.pdf")[::2] == (130, "chdstat: stopped\n")
    (tmp_path / "x-renders").mkdir()  # the PDF itself is made at the end
    code, _, err = run("paper", "-o", "x.pdf")
    assert (code, err) == (130, "chdstat: stopped; the same command goes on from here\n")
    monkeypatch.setattr(chdstat.cli.program, "app", stop)  # before a command runs
    assert run("info", "x.zarr")[::2] == (130, "chdstat: stopped\n")


def test_an_adaptive_render_says_its_error(run, tmp_path, caplog):
    view = ("cornell-box", "-o", tmp_path / "a.zarr", "--size", "12x12", "--backend", "scalar")
    code, out, _ = run("render", *view, "--spp", 16, "--adaptive", "--quiet", "--json")
    told = json.loads(out)
    assert code == 0
    assert told["spp"] == pytest.approx(16, abs=0.5)
    assert 0 < told["predicted_relative_error"]["value"] < 2
    assert 0 < told["estimated_relative_error"]["value"] < 2
    code, out, _ = run("render", *view, "--spp", 20, "--error", 1e-3)
    assert code == 3
    assert "20 on average" in out
    assert "an error of 0.001 takes about" in caplog.text
    assert "more than the 0.001 asked for" in caplog.text
    code, out, _ = run("info", tmp_path / "a.zarr")
    assert "none of its own decided how many" in out
    code, _, err = run("render", *view, "--spp", 20, "--error", 1e-3, "--percentile", 90)
    assert code == 2
    assert "decided for the error of the whole image, not of 90 % of the pixels" in err
    other = ("-o", tmp_path / "b.zarr", "--spp", 16, "--error", 1e-3, "--percentile", 90)
    _, out, _ = run("render", *view, *other)
    assert "estimated relative error of 90 % of pixels" in out
    code, _, err = run("render", *view, "--summary-only", "--error", 0.1)
    assert code == 2
    assert "--summary-only keeps no samples" in err


@pytest.mark.parametrize("command", [("compare", "--n", "8"), ("study", "--store", "kept")])
def test_commands_take_different_numbers_of_samples(run, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    counts = np.full((12, 12), 24)
    counts[0, 0] = 16
    x = np.random.default_rng(0).exponential(size=(12, 12, 3, 24))
    chd.Samples.from_array(x, counts=counts).save("own.zarr")
    name, *options = *command, "-e", "mean"
    for spp in ((), ("--spp", 16)):
        code, _, err = run(name, "own.zarr", *options, *spp)
        assert code == 0, err
    code, _, err = run(name, "own.zarr", *options, "--spp", 32)
    assert code == 2
    assert "24" in err


def test_narrow_tables_cut_no_number(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "12")
    output.print_rows([{"a": "median_of_means", "b": "1.20 [0.876, 1.64]"}], {"a": "", "b": "b"})
    assert capsys.readouterr().out.split() == ["b", "median_of_means", "1.20", "[0.876,", "1.64]"]
    monkeypatch.delenv("COLUMNS")
    monkeypatch.setattr("sys.stdout", None)  # closed, by >&-
    output.print_rows([{"a": "1"}], {"a": ""})


def test_commands_to_type_next_quote_paths_with_spaces(capsys):
    output.say_next(False, ("explore", Path("my box.zarr")), ("compare", "STORE"))
    assert (
        capsys.readouterr().err
        == "next: chdstat explore 'my box.zarr'  or  chdstat compare STORE\n"
    )


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("render cornell-box -o {}/a.zarr --spp 0", "--spp must be at least 1, got 0"),
        ("render cornell-box -o {}/a.zarr --seed -3", "--seed must be at least 0, got -3"),
        ("import {}/s.npy -o {}/a.zarr", "--axes yxsc if (y, x, sample, channel), --axes syxc if"),
        ("import {}/i.npy -o {}/a.zarr", "If it holds samples, give --axes yxs"),
        ("estimate {}/s.zarr -o {}/a.exr --level 2", "--level must lie between 0 and 1, got 2"),
        ("compare {}/s.zarr --n 0", "--n must be at least 1, got 0"),
        ("compare {}/s.zarr", "or take a smaller --n"),
        ("contrast {}/s.zarr {}/s.zarr --alpha 3", "--alpha must lie between 0 and 1"),
        ("bench cornell-box --seeds 0", "--seeds must be at least 1, got 0"),
        ("bench {}/s.zarr --seeds 2 --spp 16", "give one: --reference"),
    ],
)
def test_errors_name_options_as_they_are_typed(run, store, tmp_path, line, told):
    x = np.random.default_rng(0).gamma(2.0, size=(4, 6, 70, 3)).astype(np.float32)
    np.save(tmp_path / "s.npy", x)
    np.save(tmp_path / "i.npy", x[:, :, 0])
    (tmp_path / "s.zarr").symlink_to(store)
    code, _, err = run(*(word.format(tmp_path) for word in line.split()))
    assert code == 2
    assert told in err
