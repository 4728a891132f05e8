"""The paper's experiment: its figures and tables, its network as published, and resuming."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from typer.testing import CliRunner

import chdstat as chd
from chdstat.cli import app
from chdstat.errors import InputError
from chdstat.estimators import MLP, Preset
from chdstat.estimators.elek2019 import CHOICES, PAPER, PRESETS, as_published
from chdstat.estimators.held_out import draw_pixels, training_batches
from chdstat.patterns import atlas
from chdstat.rendering.recipes import find_recipe
from chdstat.reporting.documents import pages_of
from chdstat.reporting.paper_report import FIGURES, paper_document
from chdstat.studies import paper, paper_study, stores, studies
from chdstat.studies.claims import CLAIMS
from chdstat.studies.paper_numbers import NUMBERS, SENTENCES
from tests.pdf import text_of
from tests.stops import stopped

TINY = {"only": ["MeasureOne"], "edge": 8, "spp": 128, "iterations": 20, "backend": "scalar"}


@pytest.fixture(scope="module", autouse=True)
def few_shapes():
    """Let atlases have two shapes: to choose their number takes longer than all the rest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studies, "atlas", lambda x, **options: atlas(x, clusters=2, **options))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(scope="module")
def found(folder):
    """Return the experiment with one scene; it is stopped once before its network is trained."""
    with stopped(paper_study, "_network"):
        paper(folder, **TINY, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stores, "render", refuse)  # what was rendered is not rendered again
        return paper(folder, **TINY, progress=False)


@pytest.fixture(scope="module")
def document(found):
    return paper_document(found)


def refuse(*args, **kwargs):
    pytest.fail("done again")


# --- a run ----------------------------------------------------------------------------------------


def test_a_finished_run_does_nothing_again(found, folder, monkeypatch):
    monkeypatch.setattr(stores, "render", refuse)
    monkeypatch.setattr(MLP, "train", refuse)
    again = paper(folder, **TINY, progress=False)
    np.testing.assert_equal(again.table(), found.table())


def test_every_figure_of_the_paper_is_there(document):
    wanted = [f for f in FIGURES if not f.of or "MeasureOne" in f.of]
    wanted = {f.name + "-MeasureOne" * bool(f.of) for f in wanted}
    assert wanted - {"firefly-MeasureOne"} <= {*document.figures}
    assert {f.number for f in FIGURES} == set("123456789")
    assert [place["name"] for place in document.content["placed"]] == [*document.figures]


def test_studies_are_drawn_in_colour_on_both_axes(document):
    (whole, *axes) = document.figures["study3-MeasureOne"].axes
    scales = [ax.get_xscale() for ax in axes if ax.patches and not ax.images]
    assert scales.count("linear") == scales.count("log") > 0
    assert {text.get_text()[-1] for text in whole.get_legend().get_texts()[:3]} == {*"RGB"}


def test_tables_hold_what_the_run_had(found, document):
    rows = {row["what"]: row["here"] for row in document.content["numbers"]}
    shown = [n.what for n in NUMBERS if not n.scenes or "MeasureOne" in n.scenes]
    assert [*rows] == shown
    assert rows["samples per pixel"] == "128"
    assert rows["batches"] == "4 of 32"
    assert rows["bins"] == "100 and 100"
    assert rows["layers"] == "32-32-32-32-1"
    assert rows["iterations, learning rate"] == "20, 0.005"
    assert rows["pixels that train"] == rows["pixels"].replace("8 × 8", "64") == "64"
    published, here, ours = found.table()
    (scene,) = found.scenes
    estimate, truth, mean = scene.network.estimate, scene.truth, scene.mean
    ratio = ((estimate - truth) ** 2).mean() / ((mean - truth) ** 2).mean()
    assert published["mse_ratio"] == pytest.approx(ratio, rel=1e-4)
    assert np.isnan(here["mse_ratio"])  # all pixels trained
    assert (ours["network"], ours["judged"]) == ("as here", "as here")
    assert [f["mse"] for f in document.content["errors"]][1] == "—"


def test_the_command_typesets_what_is_there(found, folder, tmp_path):
    path = tmp_path / "paper.pdf"
    options = [f"--{name}={value}" for name, value in (TINY | {"only": "MeasureOne"}).items()]
    done = CliRunner().invoke(app, ["paper", "-o", str(path), "--store", str(folder), *options])
    assert done.exit_code == 0, done.output
    assert "as published" in done.output
    text = " ".join(text_of(path).split())
    assert pages_of(path) > 3
    for words in ("Numbers of the paper", "Sentences of the paper", "--edge 800", "patience",
                  "minibatches of 256 rows", "not as published"):  # fmt: skip
        assert words in text


def test_each_claim_of_the_paper_has_its_sentence(document):
    ours = range(30, 34)  # on path guiding and adaptive sampling
    assert [*SENTENCES] == [claim.number for claim in CLAIMS if claim.number not in ours]
    assert [row["number"] for row in document.content["sentences"]] == [*map(str, SENTENCES)]
    assert all(cell["verdict"] for row in document.content["sentences"] for cell in row["cells"])


# --- choices --------------------------------------------------------------------------------------


def test_choices_are_switches_that_exist():
    known = {field.name for field in fields(Preset)}
    for name, choice in CHOICES.items():
        assert choice.name == name
        assert {*choice.published} == {*choice.changed} <= known
        changed = as_published(name)
        assert (changed != as_published()) == bool(choice.changed)
        for key, value in choice.changed.items():
            assert value == getattr(changed, key) != choice.published[key]
            assert (getattr(PRESETS[PAPER], key) == value) == choice.ours
    with pytest.raises(InputError, match="tagets"):
        as_published("tagets")


def test_the_command_names_every_choice():
    from typer.main import get_command

    (option,) = (o for o in get_command(app).commands["paper"].params if o.name == "change")
    assert all(name in option.help for name in CHOICES)


def test_published_targets_hold_the_batch():
    x = np.random.default_rng(0).gamma(1.0, size=(2, 2, 3, 64)).astype(np.float32)
    samples, pixels = chd.Samples.from_array(x), np.argwhere(np.ones((2, 2), bool))
    _, whole = training_batches(samples, pixels, 32, leave_out=False)
    np.testing.assert_allclose(whole, np.tile(x.mean(axis=-1).reshape(4, 3), (2, 1)), rtol=1e-6)
    _, others = training_batches(samples, pixels, 32)
    np.testing.assert_allclose(others[:4], x[..., 32:].mean(axis=-1).reshape(4, 3), rtol=1e-5)


def test_as_published_all_pixels_of_a_small_image_train():
    assert len(draw_pixels((10, 10), 6400, seed=0, spare=False)) == 100
    assert len(draw_pixels((90, 90), 6400, seed=0, spare=False)) == 6400


def test_each_channel_may_have_its_network():
    x = np.random.default_rng(0).gamma(1.0, size=(6, 6, 3, 64)).astype(np.float32)
    samples = chd.Samples.from_array(x)
    how = {"iterations": 3, "progress": False}
    found = [paper_study._trained(samples, as_published(), each=each, **how) for each in (0, 1)]
    assert found[0].estimate.shape == found[1].estimate.shape == (6, 6, 3)
    assert not np.allclose(found[0].estimate, found[1].estimate)


# --- scenes ---------------------------------------------------------------------------------------


def test_the_papers_own_scenes_are_taken_where_they_are(tmp_path):
    real = find_recipe("real-bathroom", tmp_path)
    place = tmp_path / "bathroom/scene.xml"
    assert real.scene == str(place)
    place.parent.mkdir()
    place.write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">'
        '<film type="hdrfilm"/></sensor></scene>'
    )
    scale = paper_study.Extent(88, 2048, 1)
    scenes = paper_study._scenes(["Bathroom", "WhiteRoom"], tmp_path, scale)
    assert [scene.name for scene in scenes] == ["real-bathroom", "day-room"]
    assert [scene.recipe.size for scene in scenes] == [(88, 88), (88, 88)]
    assert all(scene.regions for scene in scenes)
    (hall,) = paper_study._scenes(["MeasureOne"], tmp_path, scale)  # there is no other
    assert hall.name == "gallery"
    with pytest.raises(InputError) as refused:
        paper_study._scenes(["WhiteRoom"], tmp_path, scale)
    assert "scene_day_pbrt.xml" in str(refused.value)
    assert str(place) not in str(refused.value)  # which is there
