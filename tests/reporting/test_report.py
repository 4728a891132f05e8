"""Report: a PDF comes out of whatever samples there are, and says what it could not do."""

from __future__ import annotations

import contextlib
from importlib import resources

import numpy as np
import pypdfium2
import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, InputError, LeftOutWarning
from chdstat.reporting import scene_report
from chdstat.reporting.content import findings
from chdstat.reporting.typst import between, number, percent

FIXED = ("mean", "median_of_means")


def text_of(path, last=None):
    pdf = pypdfium2.PdfDocument(path)
    try:
        pages = [pdf[i] for i in range(len(pdf))][:last]
        text = " ".join(page.get_textpage().get_text_range() for page in pages)
        return " ".join(text.split())
    finally:
        pdf.close()


@pytest.fixture(scope="module")
def radiance():
    rng = np.random.default_rng(5)
    x = rng.gamma(1.0, size=(20, 24, 3, 128)) * (rng.random((20, 24, 1, 128)) < 0.5)
    return x.astype(np.float32)


def test_a_report_has_all_its_parts(radiance, tmp_path):
    samples = chd.Samples.from_array(radiance, scene="noise")
    path = chd.report(samples, tmp_path / "noise.pdf", estimators=FIXED)
    text = text_of(path)
    for part in ("Findings", "Provenance", "Characteristic distributions", "Maps"):
        assert part in text
    for part in ("Are averages Gaussian?", "Estimators", "Method and limits", "References"):
        assert part in text
    for part in ("The paper’s claims", "Not tested: 9 (path lengths)", "share of gamma less"):
        assert part in text
    assert "50 % of all samples are null" in text
    assert "median of means" in text
    assert path.stat().st_size < 5e6
    assert list(tmp_path.iterdir()) == [path]


def test_a_template_reads_all_that_it_is_given(radiance, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(scene_report, "typeset", lambda document, *_: given.append(document))
    chd.report(chd.Samples.from_array(radiance), tmp_path / "noise.pdf", estimators=FIXED)
    (document,) = given
    templates = resources.files("chdstat.reporting") / "templates"
    text = "".join((templates / name).read_text() for name in (document.template, "parts.typ"))
    assert not [name for name in document.figures if f'"{name}"' not in text]
    assert not [entry for entry in document.content if f"data.{entry}" not in text]


@pytest.mark.parametrize(("source", "remake"), [("chdstat", True), ("bathroom.xml", False)])
def test_a_report_says_first_and_beside_the_claims_that_a_scene_is_a_remake(
    radiance, tmp_path, source, remake
):
    samples = chd.Samples.from_array(radiance[:8, :8], scene="bathroom", scene_source=source)
    path = chd.report(samples, tmp_path / "bathroom.pdf", estimators=FIXED)
    note = "A remake of the paper's scene: bathroom (of Bathroom)."
    assert (note in text_of(path, last=1)) == remake
    whole = text_of(path)
    assert whole.count(note) == 2 * remake
    assert ("The paper’s claims" in whole.split(note)[1]) if remake else True
    assert "About this image: other views of the scene, or other scenes, may differ." in whole


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("one sample", lambda x: x[:8, :8, :, :1], "not compared"),
        ("all null", lambda x: x[:8, :8] * 0, "100 % of all samples are null"),
        ("all bad", lambda x: x[:8, :8] * np.nan, "8192 of 8192 samples are NaN or infinite"),
        ("constant", lambda x: x[:8, :8] * 0 + 2, "0 % of all samples are null"),
        ("one pixel", lambda x: x[:1, :1], "1 × 1 pixels"),
        ("one channel", lambda x: x[:8, :8, :1], "1 channels"),
    ],
)
def test_hopeless_samples_give_a_report_that_says_so(radiance, tmp_path, name, change, said):
    samples = chd.Samples.from_array(change(radiance), axes="yxcs", scene=name)
    path = tmp_path / "hopeless.pdf"
    warned = pytest.warns(LeftOutWarning, match=r"100\.0 % of the samples .* are bad")
    with warned if name == "all bad" else contextlib.nullcontext():
        chd.report(samples, path, estimators=FIXED)
    assert said in text_of(path)


def test_a_region_may_have_any_name(radiance, tmp_path, caplog):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        'schema = 1\nscene = "noise"\nsize = [8, 8]\nspp = 128\nseed = 0\n'
        '[[regions]]\nname = "a $x^$ b \U0010fffd"\n'
        'phenomenon = "diffuse"\nrectangle = [0, 0, 1, 1]\n',
        encoding="utf-8",
    )
    samples = chd.Samples.from_array(radiance[:8, :8], scene="noise")
    path = chd.report(samples, tmp_path / "named.pdf", recipe=recipe, estimators=FIXED)
    assert "1 a $x^$ b" in text_of(path)
    assert [r.getMessage()[:24] for r in caplog.records] == ["no font has the letters "]


def test_bad_samples_are_counted_in_words(radiance, tmp_path):
    x = radiance[:8, :8].copy()
    x[1, 2, 0, 3], x[4, 4, 1, 5], x[6, 7, 2, 8] = np.nan, np.inf, -1
    path = chd.report(chd.Samples.from_array(x), tmp_path / "bad.pdf", estimators=FIXED)
    assert "2 of 8192 samples are NaN or infinite" in text_of(path)


def test_a_wrong_target_is_refused_before_any_work(radiance, tmp_path):
    samples = chd.Samples.from_array(radiance)
    with pytest.raises(InputError, match=r"must end in \.pdf"):
        chd.report(samples, tmp_path / "report.html")
    with pytest.raises(InputError, match="create it first"):
        chd.report(samples, tmp_path / "nowhere" / "report.pdf")


def test_an_old_report_survives_a_failed_one(radiance, tmp_path, monkeypatch):
    import typst

    target = tmp_path / "report.pdf"
    target.write_bytes(b"old")

    def fail(*args, **kwargs):
        raise RuntimeError("no fonts")

    monkeypatch.setattr(typst, "compile", fail)
    samples = chd.Samples.from_array(radiance[:4, :4])
    with pytest.raises(ChdstatError, match="typesetting the report failed: no fonts"):
        chd.report(samples, target, estimators=FIXED)
    assert target.read_bytes() == b"old"


def test_a_scene_is_rendered_and_its_store_is_kept(tmp_path):
    options = {"spp": 2, "size": (16, 16), "backend": "scalar", "store": tmp_path / "c.zarr"}
    path = chd.report("cornell-box", tmp_path / "c.pdf", **options)
    assert "16 × 16 pixels, 3 channels, 2 samples per pixel" in text_of(path)
    assert chd.open(tmp_path / "c.zarr").spp == 2
    again = chd.report(tmp_path / "c.zarr", tmp_path / "d.pdf")
    assert "path" in text_of(again)


def test_findings_name_the_verdict_on_the_papers_claim(radiance):
    samples = chd.Samples.from_array(radiance)
    from chdstat.analysis import overview

    numbers = overview(chd.analyze(samples))
    rows = findings(numbers, None, chd.compare(samples, FIXED))
    (row,) = (r for r in rows if "median of means" in r.question)
    assert "fewer than half" in row.answer


def test_numbers_read_well():
    assert [number(v) for v in (0, 1e-7, 99.96, np.inf)] == ["0", "1.0e−07", "100", "—"]
    assert percent(np.nan) == "—"
    assert between(np.nan, 0.1) == "—"
