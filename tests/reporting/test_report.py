"""Reports, and files of comparisons: whatever samples there are, and what could not be done."""

from __future__ import annotations

import contextlib
import errno
import json
import re
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import chdstat as chd
from chdstat.comparison import Interval
from chdstat.errors import ChdstatError, LeftOutWarning, StoreError
from chdstat.reporting import scene_report
from chdstat.reporting.content import claim_content, finding_content, remake_note, with_others
from chdstat.reporting.documents import Document, pages_of, typeset
from chdstat.reporting.figures import FIGURES, claim_figures, save_comparison
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import CLAIMS, ClaimTest, Finding, PlotData
from tests.pdf import text_of, white_shares

FIXED = ("mean", "median_of_means")


@pytest.fixture(scope="module")
def radiance():
    rng = np.random.default_rng(5)
    x = rng.gamma(1.0, size=(20, 24, 3, 128)) * (rng.random((20, 24, 1, 128)) < 0.5)
    return x.astype(np.float32)


def keep_documents(monkeypatch):
    """Return a list of what is typeset from now on, document by document."""
    given = []

    def kept(document, *where):
        given.append(document)
        return typeset(document, *where)

    monkeypatch.setattr(scene_report, "typeset", kept)
    return given


@pytest.fixture
def documents(monkeypatch):
    return keep_documents(monkeypatch)


@pytest.fixture(scope="module")
def short(radiance, tmp_path_factory):
    """Return the path of a short report of a remake, and its document."""
    samples = chd.Samples.from_array(radiance, scene="bathroom", scene_source="chdstat")
    with pytest.MonkeyPatch.context() as patch:
        documents = keep_documents(patch)
        path = chd.report(samples, tmp_path_factory.mktemp("short") / "noise.pdf")
    return path, documents[0]


def test_a_short_report_is_read_in_minutes(radiance, short):
    """Of a remake, which it says first and once; nothing is trained, and no claim tested."""
    path, document = short
    text = text_of(path)
    assert pages_of(path) <= 4
    note = "bathroom remakes the paper's Bathroom: "
    assert note in text_of(path, last=1)
    assert text.count(note) == 1
    assert remake_note([chd.Samples.from_array(radiance, scene="bathroom")]) == ""
    assert [*document.figures] == ["regions", "noise", "estimates"]
    rows = [row["name"] for row in document.content["estimators"]["rows"]]
    assert rows[:2] == ["default estimate (combination) *", "sample mean"]
    assert not any("Elek" in row for row in rows)
    for part in ("What is noisy here", "Where the noise is", "by how much", "How this was made"):
        assert part in text
    assert "The paper’s claims" not in text
    assert "50 % of all samples find no light" in text_of(path, last=1)
    assert path.stat().st_size < 2e6
    assert list(path.parent.iterdir()) == [path]


def check_pages(path):
    """No page but the last ends in a third of white or more, and none has a hole.

    What does not fit below, such as a table whose rows stay together, is on the next page.
    """
    *first, last = white_shares(path)
    assert all(below < 0.34 for below, _ in first), first
    assert last[0] < 0.6 or not first, last
    assert all(hole < 0.2 for _, hole in (*first, last)), (first, last)


def test_no_page_of_a_report_is_half_empty(short):
    check_pages(short[0])


@pytest.mark.slow
@pytest.mark.parametrize("spp", [32, 128])
@pytest.mark.parametrize("scene", BUILTIN)
def test_no_page_of_a_built_in_scene_is_half_empty(scene, spp, tmp_path):
    path = chd.report(scene, tmp_path / "a.pdf", spp=spp, size=(32, 32), progress=False)
    check_pages(path)
    assert pages_of(path) <= 4


def test_each_number_of_a_report_has_one_value(radiance, short):
    content = short[1].content
    ratio = content["estimators"]["rows"][0]["mse_ratio"].split()[0]
    nulls = content["key_figures"][0]["value"]
    (said,) = (f for f in content["findings"] if "find no light" in f["finding"])
    assert said["finding"].startswith(nulls)
    assert content["key_figures"][3]["value"] == ratio
    (gain,) = (f for f in content["findings"] if f["finding"].startswith("The default estimate"))
    assert gain["finding"].startswith("The default estimate lowers the squared")
    assert f"its squared error is {ratio} " in gain["because"]
    (needed,) = (f for f in content["findings"] if "you need" in f["finding"])
    said = r"For an error of [\d.]+.% you need about [\d,]+ spp, [\d,]+ to [\d,]+\."
    assert re.fullmatch(said, needed["finding"])
    error = chd.estimate(chd.Samples.from_array(radiance)).error
    assert f"of its relMSE, of {error.in_words()}" in needed["because"]


def test_a_full_report_has_all_its_parts(radiance, tmp_path, documents):
    """Its template reads all that it is given; so does that of the claims alone."""
    samples = chd.Samples.from_array(radiance)
    path = chd.report(samples, tmp_path / "noise.pdf", contents="full", estimators=FIXED)
    text = text_of(path)
    chd.report(samples, tmp_path / "claims.pdf", contents="claims", estimators=FIXED)
    templates = resources.files("chdstat.reporting") / "templates"
    for document in documents:
        read = "".join((templates / name).read_text() for name in (document.template, "parts.typ"))
        drawn = document.content["drawn"]
        read += "".join(figure.caption for figure in FIGURES)
        assert {figure["name"] for figure in drawn} == {*document.figures}
        assert not [f["part"] for f in drawn if f'figures-of("{f["part"]}")' not in read]
        assert not [entry for entry in document.content if f"data.{entry}" not in read]
    for part in ("The case study", "The whole image", "Are averages Gaussian?", "References"):
        assert part in text
    for part in ("The paper’s claims", "9 (path lengths)", "share of gamma less"):
        assert part in text
    of_claims = text_of(tmp_path / "claims.pdf")
    for claim in CLAIMS:
        if claim.alone:  # each once: in the table, or among those that do not apply
            said = (f"{claim.number} {claim.name[0].upper()}", f"{claim.number} ({claim.name})")
            assert sum(of_claims.count(words) for words in said) == 1, claim.name
    assert "The case study" not in of_claims
    assert not documents[1].figures


@pytest.mark.parametrize(
    ("name", "change", "said", "figures"),
    [
        ("two samples", lambda x: x[:8, :8, :, :2], "2 samples per pixel tell no distribution", []),
        ("four samples", lambda x: x[..., :4], "4 samples per pixel tell no", ["estimates"]),
        ("32 samples", lambda x: x[:8, :8, :, :32], "", ["regions", "noise", "estimates"]),
        ("all null", lambda x: x[:8, :8] * 0, "No sample finds light", []),
        ("all bad", lambda x: x[:8, :8] * np.nan, "No sample is a number", []),
        ("constant", lambda x: x[:8, :8] * 0 + 2, "Nothing is noisy here", ["regions"]),
        ("one pixel", lambda x: x[:1, :1], "The pixel is gamma-like", ["alone"]),
        ("one channel", lambda x: x[..., :1, :], "one channel", ["regions", "noise", "estimates"]),
    ],
)
def test_odd_samples_have_a_report(radiance, tmp_path, documents, name, change, said, figures):
    samples = chd.Samples.from_array(change(radiance), axes="yxcs", scene=name)
    path = tmp_path / "odd.pdf"
    warned = pytest.warns(LeftOutWarning, match=r"100\.0 % of the samples .* are bad")
    with warned if name == "all bad" else contextlib.nullcontext():
        chd.report(samples, path)
    text = text_of(path)
    assert said in text
    assert [*documents[0].figures] == figures
    assert "— times" not in text
    assert "channel0" not in text
    assert not re.search(r"\[(.+?) to \1\]", text), "an interval that says nothing"
    if name == "one pixel":
        assert "What helps: more samples, at the usual rate" in text
        assert re.search(r"\[\d\d % to \d\d %\] of the samples find no light", text)
    assert pages_of(path) <= (3 if "noise" in figures else 1)


def test_a_report_says_where_numbers_of_samples_differ(radiance, tmp_path):
    spp = radiance.shape[3]
    counts = np.where(np.arange(radiance.shape[1]) < 8, 20, spp) * np.ones((len(radiance), 1), int)
    samples = chd.Samples.from_array(radiance, axes="yxcs", counts=counts)
    chd.report(samples, tmp_path / "some.pdf")
    text = text_of(tmp_path / "some.pdf")
    assert f"20 to {spp} samples each" in text
    assert f"None of {counts.sum():,} samples is NaN" in text
    assert "at least 64 spp, got 20" in text


def test_regions_may_have_any_name(radiance, tmp_path, caplog):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        'schema = 1\nscene = "noise"\nsize = [8, 8]\nspp = 128\nseed = 0\n'
        '[[regions]]\nname = "a $x^$ b \U0010fffd"\n'
        'phenomenon = "diffuse"\nrectangle = [0, 0, 1, 1]\n',
        encoding="utf-8",
    )
    x = radiance[:8, :8].copy()
    x[1, 2, 0, 3], x[4, 4, 1, 5], x[6, 7, 2, 8] = np.nan, np.inf, -1
    samples = chd.Samples.from_array(x, scene="noise")
    asked = {"contents": "full", "estimators": ("mean", "elek2019"), "iterations": 3}
    path = chd.report(samples, tmp_path / "named.pdf", recipe=recipe, **asked)
    assert "1 a $x^$ b" in text_of(path)
    assert "in 3 iterations" in text_of(path)
    assert "2 of 8,192 samples are NaN or infinite" in text_of(path)
    assert [r.getMessage()[:24] for r in caplog.records] == ["no font has the letters "]


def test_a_scene_is_rendered_and_its_store_is_kept(tmp_path):
    options = {"spp": 2, "size": (16, 16), "backend": "scalar", "store": tmp_path / "c.zarr"}
    path = chd.report("cornell-box", tmp_path / "c.pdf", estimators=FIXED, **options)
    assert "16 × 16 pixels, 3 channels, 2 samples per pixel" in text_of(path)
    assert chd.open(tmp_path / "c.zarr").spp == 2
    again = chd.report(tmp_path / "c.zarr", tmp_path / "d.pdf", estimators=FIXED)
    assert "path" in text_of(again)


def test_the_first_page_tells_what_helps(tmp_path, documents):
    """One pixel in ten is a hundred times as noisy; half the samples are null in another tenth."""
    rng = np.random.default_rng(0)
    x = 1 + 0.01 * rng.standard_normal((20, 20, 1, 128))
    x[:2] = rng.exponential(1.0, (2, 20, 1, 128))
    x[2:4] *= rng.random((2, 20, 1, 128)) < 0.2
    samples = chd.Samples.from_array(x.astype(np.float32))
    text = text_of(chd.report(samples, tmp_path / "a.pdf", estimators=["mean"]), last=1)
    # Of 40 exponential pixels with CV 1, and 40 of which a fifth is lit with CV 2 in every pixel.
    assert "The largest part of the noise is in null-heavy pixels" in text
    told = r"10 % of the image and hold [78]\d % \["
    assert re.search(told, text)
    assert re.search(r"[78]\.\d % \[", text)
    regions = [region["name"] for region in documents[0].content["regions"]]
    assert regions[:2] == ["null-heavy", "gamma-like"]  # what holds most of the noise comes first


# --- files of a comparison ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(0)
    samples = chd.Samples.from_array(rng.exponential(size=(4, 4, 3, 64)))
    return chd.compare(samples, ["mean"], n=4, progress=False)


def test_a_comparison_is_there_when_it_is_complete(found, tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    target = tmp_path / "new" / "found"
    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", full)
        with pytest.raises(StoreError, match="found: No space left"):
            save_comparison(found, target)
    assert list(target.parent.iterdir()) == []
    written = save_comparison(found, target)
    assert {"comparison.json", "comparison.zarr", "measures.pdf"} <= {p.name for p in written}
    assert list(target.parent.iterdir()) == [target]
    with pytest.raises(StoreError, match="overwritten"):
        save_comparison(found, target)


# --- typesetting ----------------------------------------------------------------------------------


TEMPLATES = resources.files("chdstat.reporting") / "templates"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a folder of templates, for a test to add its own."""
    folder = Path(shutil.copytree(str(TEMPLATES), tmp_path / "templates"))
    monkeypatch.setattr("chdstat.reporting.documents._TEMPLATES", folder)
    return folder


@pytest.mark.parametrize("width", [1.5, 6.5])
def test_a_figure_has_the_size_in_which_it_was_drawn(own, tmp_path, width):
    (own / "size.typ").write_text(
        '#import "parts.typ": *\n#context [#measure(drawing("drawn")[]).width]'
    )
    drawn = {"drawn": Figure(figsize=(width, 1))}
    path = typeset(Document("size.typ", {}, drawn), tmp_path / "size.pdf")
    assert text_of(path).split()[0] == f"{72 * width:g}pt"


@pytest.mark.parametrize("name", ["parts.typ", "scene_report.typ", "study.typ"])
def test_no_semicolon_of_a_sentence_ends_an_expression(name):
    # Typst takes the one after "#data.number" for the end of code; "\\;" is a letter.
    text = (TEMPLATES / name).read_text(encoding="utf-8")
    assert re.findall(r"#[\w.-]+(?:\([^()]*\))?;", text) == []


def test_an_old_document_survives_a_failed_one(own, tmp_path):
    (own / "wrong.typ").write_text("#nothing")
    target = tmp_path / "old.pdf"
    target.write_bytes(b"old")
    with pytest.raises(ChdstatError, match="nothing"):
        typeset(Document("wrong.typ", {}, {}), target)
    assert target.read_bytes() == b"old"


# --- claims in a report ---------------------------------------------------------------------------


CLAIM = CLAIMS[14]


def part(low, high, unit="1"):
    return ClaimTest("share", Interval((low + high) / 2, low, high), least=0.5, unit=unit)


def finding(*parts, **more):
    about = {"number": 15, "name": CLAIM.name, "claim": CLAIM.claim, "about": "About this image."}
    return Finding(parts, scene="box", spp=64, **about, **more)


@pytest.fixture
def both():
    other = finding(part(0.1, 0.2))
    return finding(part(0.6, 0.8), other_models={"mine": other})


def test_each_part_has_its_number_and_what_was_claimed(both):
    content = finding_content(both)
    assert content["parts"] == [
        {
            "name": "share",
            "value": "0.70",
            "interval": "0.60 to 0.80",
            "claimed": "at least 0.5",
            "verdict": "supported",
        }
    ]
    assert json.dumps(content)


def test_a_part_without_an_interval_says_so():
    unknown = part(np.nan, np.nan, "decade^1/2")
    (shown,) = finding_content(finding(unknown))["parts"]
    assert (shown["name"], shown["value"], shown["interval"]) == ("share (√decade)", "—", "—")
    assert "no interval" in str(unknown)


def test_a_verdict_is_the_claim_s_own(both):
    (beside,) = finding_content(both)["beside"]
    assert (beside["name"], beside["verdict"]) == ("mine", "not supported")
    rows = claim_content(CLAIM, {"box": both})["rows"]
    assert [(row["scenes"], row["verdict"]) for row in rows] == [
        (["box"], "supported"),
        (["box, mine"], "not supported"),
    ]
    assert list(with_others({"box": both})) == ["box", "box, mine"]
    (figure,) = claim_figures(15, {"box": both}).values()
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == list(
        with_others({"box": both})
    )


def test_what_cannot_be_told_says_what_is_needed():
    assert finding_content(finding())["needs"] == "Nothing was measured."
    assert finding_content(finding(part(0.6, 0.8)))["needs"] == ""


def test_labels_of_plots_fit_their_panels():
    long = "log10 relative variance around its region's mean"
    x = np.arange(5.0)
    one = finding(plot_data=PlotData("curves", {"a": (x, x)}, "x", long))
    two = replace(one, plot_data=PlotData("bars", {"a": (x[:1], x[:1])}, y_label="share"))
    figure = claim_figures(15, {"1": one, "2": two})["plots15"]
    assert max(len(line) for line in figure.axes[0].get_ylabel().splitlines()) < 30
    assert claim_figures(15, {"none": finding()}) == {}
