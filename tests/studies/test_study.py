"""Studies: every scene asked for every claim, renders made once, and a PDF that says it all."""

from __future__ import annotations

import json
import mmap
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import Interval
from chdstat.errors import InputError, LeftOutWarning
from chdstat.estimators.training import train_model
from chdstat.patterns import atlas
from chdstat.reporting.documents import study_document
from chdstat.studies import stores, studies, study
from chdstat.studies.claims import CLAIMS, ClaimTest, Finding, SceneData
from chdstat.studies.stores import scenes_of
from tests.pdf import text_of
from tests.rendering.test_recipes import GOOD
from tests.stops import stopped

TINY = {"spp": 64, "size": (16, 16), "backend": "scalar", "estimators": ("mean",)}


def noise(scene, shape=(12, 12, 3, 128), seed=0):
    rng = np.random.default_rng(seed)
    x = rng.gamma(1.0, size=shape) * (rng.random((*shape[:2], 1, shape[3])) < 0.6)
    return chd.Samples.from_array(x.astype(np.float32), scene=scene)


@pytest.fixture(scope="module", autouse=True)
def few_shapes():
    """Let atlases have two shapes: to choose their number takes longer than all the rest."""

    def drawn(samples, **options):
        try:
            return atlas(samples, clusters=2, **options)
        except InputError:  # all pixels are alike
            return atlas(samples, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studies, "atlas", drawn)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("renders")


@pytest.fixture(scope="module")
def found(folder):
    """Return a study of a rendered scene and of given samples."""
    return study(["cornell-box", noise("noise")], folder=folder, **TINY)


def refuse(*args, **kwargs):
    pytest.fail("done again")


def copied(folder, tmp_path):
    return Path(shutil.copytree(folder, tmp_path / "renders"))


def test_rendered_scenes_say_where_samples_fell(found):
    rendered, given = found.scenes
    assert rendered.data.samples.film is not None
    assert rendered.data.film_split is not None
    assert (given.data.film_split, given.data.within_pixels) == (None, None)
    split = next(f for f in given.findings if f.number == 34)
    assert "192 spp" in split.reason or "film=True" in split.reason


def test_each_scene_is_asked_for_every_claim(found):
    single = [c.number for c in CLAIMS if not c.across]
    for scene in found.scenes:
        assert [f.number for f in scene.findings] == single
    assert [f.number for f in found.across] == [11, 12]
    assert found.names == ("cornell-box", "noise")
    table = found.table()
    assert [row["number"] for row in table] == [str(c.number) for c in CLAIMS]
    for row in table:
        across = row["number"] in {"11", "12"}
        assert bool(row["all scenes"]) == across
        assert bool(row["noise"]) != across


def test_a_scene_is_rendered_in_four_ways(found):
    cornell, given = found.scenes
    data = cornell.data
    depth = [s.attrs["integrator"]["max_depth"] for s in (data.shorter, data.samples)]
    assert depth == [stores.SHORT, 8]
    assert data.integrator.attrs["integrator"]["rr_depth"] == stores.ROULETTE
    assert cornell.again.attrs["seed"] == data.samples.attrs["seed"] + 1
    renders = (data.samples, cornell.again, data.shorter, data.integrator)
    assert len({samples.attrs["seed"] for samples in renders if samples is not None}) == 4
    assert given.data.shorter is given.data.integrator is given.again is None


def test_a_sampler_is_one_more_render(found, folder, tmp_path):
    assert found.finding(17, "cornell-box").verdict == "cannot tell"
    copy = copied(folder, tmp_path)
    more = study("cornell-box", folder=copy, sampler="multijitter", **TINY)
    spread = more.scenes[0].data.spread
    assert (spread.attrs["sampler"], spread.spp) == ("multijitter", 256)
    assert len(list(copy.glob("*.zarr"))) == 5
    assert more.finding(17, "cornell-box").verdict == "supported"
    assert more.finding(17, "cornell-box").test.interval.high < 0.9
    assert 17 not in more.scenes[0].repeated
    renders = more.to_dict()["scenes"][0]["renders"]
    assert renders["spread_samples"]["sequence"] == 16


def test_a_study_guides_where_waves_are_traced(monkeypatch):
    asked = []

    def render(scene, **options):
        asked.append(options)
        x = np.random.default_rng(len(asked)).random((2, 2, 3, options["spp"]))
        attrs = {"backend": "llvm", "integrator": {"type": "path"}, "spp": options["spp"]}
        return chd.Samples.from_array(x, **attrs)

    monkeypatch.setattr(stores, "render", render)
    (scene,) = scenes_of("cornell-box", {"spp": 512})
    for more in (False, True):
        asked.clear()
        data, _ = stores.Stores(None, integrators=more).renders(scene)
        assert [o["spp"] for o in asked if o.get("integrator") == "guided"] == [128] * more
        assert [o["spp"] for o in asked if o.get("adaptive")] == [128] * more
        assert (data.guided is None) == (data.adaptive is None) == (not more)
        assert len({o["seed"] for o in asked}) == len(asked)


def test_integrators_render_one_scene_in_other_ways():
    (scene,) = scenes_of("cornell-box", {"spp": 256, "size": (12, 12)})
    data, _ = stores.Stores(None, "scalar", False, integrators=True).renders(scene)
    renders = {"path": data.samples, **data.integrators}
    assert set(renders) == {
        *("path", "early roulette", "no roulette", "BSDF sampling alone"),
        *(f"direct light, {name}" for name in ("lights", "BSDFs", "both")),
    }
    assert len({samples.attrs["seed"] for samples in renders.values()}) == len(renders)
    mean = {name: samples.read().mean() for name, samples in renders.items()}
    null = {name: (s.read() == 0).all(axis=2).mean() for name, s in renders.items()}
    for name in ("early roulette", "no roulette", "BSDF sampling alone"):
        assert mean[name] == pytest.approx(mean["path"], rel=0.1)
    assert mean["direct light, both"] < 0.9 * mean["path"]
    assert null["BSDF sampling alone"] > null["path"] + 0.1
    assert null["direct light, BSDFs"] > null["direct light, both"] + 0.1
    assert data.guided is None  # by the scalar backend, nothing can be
    assert data.adaptive.counts.mean() == pytest.approx(data.adaptive.attrs["spp"], rel=0.05)
    # Lights that no ray meets are always sampled.
    lamp = {"type": "point", "intensity": {"type": "rgb", "value": 1.0}}
    assert stores.without_emitter_sampling({"type": "scene", "lamp": lamp}) is None


def test_an_interrupted_study_is_taken_up(tmp_path):
    with stopped(stores, "analyze"):
        study("cornell-box", folder=tmp_path, **TINY)
    left = set(tmp_path.glob("*.zarr"))
    assert len(left) == 4
    study("cornell-box", folder=tmp_path, **TINY)
    assert set(tmp_path.glob("*.zarr")) == left
    assert not list(tmp_path.glob("*.checkpoint"))


def test_maps_are_in_files_and_read_back_as_they_were(tmp_path):
    rendered = chd.render(
        "cornell-box", spp=32, size=(16, 12), out=tmp_path / "box.zarr", progress=False
    )
    kept = stores.Stores(tmp_path / "kept", progress=False)
    first = kept.analysis(rendered)
    again = kept.analysis(rendered)
    assert first.identical(again)
    for dataset in (first, again):
        base = dataset["log_counts"].values
        while isinstance(base, np.ndarray):
            base = base.base
        assert isinstance(base, memoryview | mmap.mmap)


def test_a_damaged_analysis_is_made_again(found, folder, tmp_path):
    copy = copied(folder, tmp_path)
    for kept in copy.glob("*.analysis"):
        shutil.rmtree(kept / "mean")
    again = study("cornell-box", folder=copy, **TINY)
    assert again.scenes[0].findings[0].to_dict() == found.scenes[0].findings[0].to_dict()
    more = study("cornell-box", folder=copy, **(TINY | {"spp": 128}))
    assert more.scenes[0].data.samples.spp == 128
    assert len(list(copy.glob("*.zarr"))) == 4


def test_json_holds_all_but_arrays(found, tmp_path):
    content = json.loads(found.save(tmp_path / "findings.json").read_text())
    assert [scene["scene"] for scene in content["scenes"]] == ["cornell-box", "noise"]
    assert content["scenes"][0]["renders"]["another_seed"]["seed"] == 2
    assert content["provenance"]["chdstat"] == chd.__version__
    assert len(content["table"]) == len(CLAIMS)
    assert list(tmp_path.iterdir()) == [tmp_path / "findings.json"]


def test_the_pdf_has_all_claims(tmp_path, monkeypatch):
    x = noise("bathroom", shape=(8, 8, 3, 64)).read()
    samples = chd.Samples.from_array(x, scene="bathroom", scene_source="chdstat")
    monkeypatch.chdir(tmp_path)
    found = study([samples, noise("noise", shape=(8, 8, 3, 64))], estimators=["mean"])
    assert list(tmp_path.iterdir()) == []  # without a folder
    path = found.save_pdf(tmp_path / "study.pdf")
    assert "bathroom remakes the paper's Bathroom: " in text_of(path, last=1)
    text = text_of(path)
    assert "bathroom*, noise" in text
    assert "noise*" not in text
    assert "A remake of the paper’s Bathroom, not that scene." in text
    for part in ("Verdicts", "cannot tell", "Method and limits"):
        assert part in text
    assert [c.name for c in CLAIMS if c.name not in text.lower()] == []
    assert list(tmp_path.iterdir()) == [path]


def test_a_study_shows_regions_of_few_samples_and_of_few_pixels():
    for shape in ((12, 12, 3, 16), (6, 6, 3, 64)):
        x = noise("bathroom", shape=shape).read()
        samples = chd.Samples.from_array(x, scene="bathroom", scene_source="chdstat")
        few = study([samples, noise("noise", shape=shape)], estimators=["mean"])
        assert {"scene0-regions", "scene1-regions"} <= study_document(few).figures.keys()


HOPELESS = {
    "all null": lambda x: x * 0,
    "all bad": lambda x: x * np.nan,
    "one pixel": lambda x: x[:1, :1],
    "one channel": lambda x: x[:, :, :1],
    "one sample": lambda x: x[..., :1],
}


def test_hopeless_samples_give_a_study_that_cannot_tell():
    x = noise("x", (4, 4, 3, 64)).read()
    samples = [
        chd.Samples.from_array(f(x), axes="yxcs", scene=name) for name, f in HOPELESS.items()
    ]
    with pytest.warns(LeftOutWarning, match=r"100\.0 % of the samples .* are bad"):
        hopeless = study(samples, folder=None, estimators=("mean",))
    assert hopeless.names == tuple(HOPELESS)
    for scene in hopeless.scenes:
        assert not any(f.verdict == "supported" for f in scene.findings), scene.name
    drawn = study_document(hopeless)
    assert {f"scene{i}-batches" for i in range(len(HOPELESS))} <= set(drawn.figures)
    assert drawn.content["counts"]["supported"] == 0
    tested = [claim["number"] for claim in drawn.content["claims"]]
    assert tested == [n for n in range(1, 35) if f"claim{n}" in drawn.figures]
    listed = " ".join(row["claims"] for row in drawn.content["untested"])
    assert {int(n) for n in re.findall(r"\d+", listed)} == {*range(1, 35)} - {*tested}
    for figure in drawn.figures.values():
        figure.draw_without_rendering()


def test_a_recipe_names_scene_settings_and_regions(tmp_path):
    path = tmp_path / "box.toml"
    path.write_text(GOOD)
    (scene,) = scenes_of(path, {"spp": 32})
    recipe = scene.recipe
    assert (recipe.size, recipe.spp, recipe.seed, recipe.max_depth) == ((128, 96), 32, 3, 9)
    assert [r.name for r in scene.regions] == ["wall"]
    (other,) = scenes_of(path, {"size": (16, 24)})
    assert other.regions == ()  # they are for its proportions


def test_seeds_that_contradict_each_other_cannot_tell():
    nulls = Interval(0.3, 0.2, 0.4)
    yes, no, open_ = (
        Finding((ClaimTest("nulls", nulls, least=least),), spp=64) for least in (0.1, 0.5, 0.3)
    )
    assert yes.confirmed(no).verdict == "cannot tell"
    assert "claimed at least 0.5" in yes.confirmed(no).reason
    assert yes.confirmed(yes) is yes
    assert yes.confirmed(None) is yes
    assert yes.confirmed(open_) is yes


def test_a_wrong_recipe_is_refused_before_any_work(tmp_path):
    path = tmp_path / "box.toml"
    path.write_text(GOOD.replace("schema = 1", "schema = 7"))
    with pytest.raises(InputError, match=r"box\.toml.*got 7"):
        study(path, folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_wrong_input_is_refused_before_any_work(found, tmp_path):
    with pytest.raises(InputError, match=r"\.pdf"):
        found.save_pdf(tmp_path / "study.html")
    with pytest.raises(InputError, match="nowhere"):
        found.save(tmp_path / "nowhere" / "findings.json")


def test_scenes_of_one_name_are_told_apart():
    names = [s.name for s in scenes_of([noise("a"), noise("a", seed=1), noise("b")], {})]
    assert names == ["a", "a (2)", "b"]


def test_what_learned_is_kept_beside_its_samples(found, folder, tmp_path, monkeypatch):
    copy = copied(folder, tmp_path)
    samples = chd.open(next(path for path in copy.glob("*.zarr") if chd.open(path).spp == 64))
    model = train_model(samples, "elek2019", iterations=20, progress=False)
    labels = chd.analyze(samples, held_out=False, progress=False)["label"]
    asked = []

    def compared(samples, estimators, *, model, **options):
        asked.append(dict(model))
        return chd.compare(samples, estimators, **options, model={"elek2019": trained})

    monkeypatch.setattr(stores, "compare", compared)
    trained, where = model, stores.Stores(copy, progress=False)
    names = ["mean", "elek2019"]
    first = where.comparison(samples, names, labels)
    again = where.comparison(samples, names, labels)
    assert asked == [{}]
    np.testing.assert_equal(again.table(), first.table())
    assert list(again.models) == names[1:]
    for record in copy.glob("*comparison*.npz"):
        record.write_bytes(b"damaged")
    where.comparison(samples, names, labels)
    assert list(asked[1]) == ["elek2019"]
    (network,) = copy.glob("*.safetensors")
    network.write_bytes(b"damaged")  # a comparison without its network is none
    last = where.comparison(samples, names, labels)
    assert asked[2] == {}
    assert list(last.models) == names[1:]
    assert len(list(copy.glob("*.safetensors"))) == 1


def test_the_same_study_once_more_asks_nothing_again(found, folder, tmp_path, monkeypatch):
    copy = copied(folder, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(stores, "render", refuse)
        patch.setattr(stores, "analyze", refuse)
        once = study("cornell-box", folder=copy, **TINY)
        patch.setattr(studies, "atlas", refuse)
        patch.setattr(stores, "compare", refuse)
        patch.setattr(type(CLAIMS[0]), "find", refuse)
        again = study("cornell-box", folder=copy, **TINY)
    first, as_before, told = (study.scenes[0].to_dict() for study in (found, once, again))
    assert first["findings"] == as_before["findings"]
    for content in (told, as_before):
        del content["seconds"]
    assert told == as_before
    assert again.table() == once.table()
    with monkeypatch.context() as patch:
        patch.setattr("chdstat._core.files.code_digest", lambda: "another")
        patch.setattr(stores, "analyze", refuse)
        with pytest.raises(pytest.fail.Exception, match="done again"):
            study("cornell-box", folder=copy, **TINY)


def test_a_foreign_store_is_analysed_once(tmp_path, monkeypatch):
    path, folder = tmp_path / "mine.zarr", tmp_path / "kept"
    options = {"spp": 64, "size": (16, 16), "backend": "scalar"}
    asked = {"folder": folder, "estimators": ("mean",)}
    chd.render("cornell-box", **options, out=path)
    once = study(path, **asked)
    with monkeypatch.context() as patch:
        patch.setattr(stores, "analyze", refuse)
        again = study(path, **asked)
    assert again.table() == once.table()
    shutil.rmtree(path)
    chd.render("cornell-box", **options, seed=1, out=path)
    other = study(path, **asked)
    assert not np.array_equal(
        other.scenes[0].data.summary["mean"], once.scenes[0].data.summary["mean"]
    )


REAL = {
    "bathroom": {18, 19, 20, 26},
    "white-room": {18, 19, 20, 21, 25, 26},
    "night-room": {18, 22, 23, 24, 26},
}


@pytest.mark.external
@pytest.mark.parametrize("name", REAL)
def test_real_recipes_have_regions_for_claims(name):
    recipe = Path(__file__).parents[2] / "renders" / f"real-{name}.toml"
    (scene,) = scenes_of(str(recipe), {"spp": 128})
    size = tuple(length // 4 for length in scene.recipe.size)
    samples = chd.render(scene.source, spp=128, size=size, max_depth=4, backend="scalar")
    data = SceneData(scene.name, samples, scene.regions)
    found = {claim.number: claim.find(data) for claim in CLAIMS if claim.number in REAL[name]}
    assert all(finding.tests for finding in found.values()), found
    assert all("remake" not in finding.about for finding in found.values())
