"""Report: a PDF comes out of whatever samples there are, and says what it could not do."""

from __future__ import annotations

import contextlib
import re
from importlib import resources

import numpy as np
import pypdfium2
import pytest

import chdstat as chd
from chdstat.errors import InputError, LeftOutWarning
from chdstat.reporting import scene_report
from chdstat.reporting.content import remake_note
from chdstat.reporting.typst import typeset

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


def test_a_report_has_all_its_parts(radiance, tmp_path, monkeypatch):
    """Of a remake, which it says first and once; its template reads all that it is given."""
    given = []

    def kept(document, *where):
        given.append(document)
        return typeset(document, *where)

    monkeypatch.setattr(scene_report, "typeset", kept)
    samples = chd.Samples.from_array(radiance, scene="bathroom", scene_source="chdstat")
    path = chd.report(samples, tmp_path / "noise.pdf", estimators=FIXED)
    text = text_of(path)
    note = "A remake of the paper's scene: bathroom (of Bathroom)."
    assert note in text_of(path, last=1)
    assert text.count(note) == 1
    assert remake_note([chd.Samples.from_array(radiance, scene="bathroom")]) == ""
    assert "About this image: other views of the scene, or other scenes, may differ." in text
    (document,) = given
    templates = resources.files("chdstat.reporting") / "templates"
    read = "".join((templates / name).read_text() for name in (document.template, "parts.typ"))
    assert not [name for name in document.figures if f'"{name}"' not in read]
    assert not [entry for entry in document.content if f"data.{entry}" not in read]
    for part in ("Findings", "Provenance", "The case study", "The whole image"):
        assert part in text
    for part in ("Are averages Gaussian?", "Estimators", "Method and limits", "References"):
        assert part in text
    for part in ("The paper’s claims", "Not tested: 9 (path lengths)", "share of gamma less"):
        assert part in text
    assert "50 % of all samples find no light" in text
    assert "This report looks at the 128 samples of radiance" in text_of(path, last=1)
    assert "median of means" in text
    assert path.stat().st_size < 5e6
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("one sample", lambda x: x[:8, :8, :, :1], "not compared"),
        ("all null", lambda x: x[:8, :8] * 0, "100 % of all samples find no light"),
        ("all bad", lambda x: x[:8, :8] * np.nan, "8192 of 8192 samples are NaN or infinite"),
        ("constant", lambda x: x[:8, :8] * 0 + 2, "0 % of all samples find no light"),
        ("one pixel", lambda x: x[:1, :1], "1 × 1 pixels"),
        ("one channel", lambda x: x[:8, :8, :1], "1 channel,"),
    ],
)
def test_hopeless_samples_give_a_report_that_says_so(radiance, tmp_path, name, change, said):
    samples = chd.Samples.from_array(change(radiance), axes="yxcs", scene=name)
    path = tmp_path / "hopeless.pdf"
    warned = pytest.warns(LeftOutWarning, match=r"100\.0 % of the samples .* are bad")
    with warned if name == "all bad" else contextlib.nullcontext():
        chd.report(samples, path, estimators=FIXED)
    assert said in text_of(path)


def test_a_region_may_have_any_name_and_bad_samples_are_counted(radiance, tmp_path, caplog):
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
    path = chd.report(samples, tmp_path / "named.pdf", recipe=recipe, estimators=FIXED)
    assert "1 a $x^$ b" in text_of(path)
    assert "2 of 8192 samples are NaN or infinite" in text_of(path)
    assert [r.getMessage()[:24] for r in caplog.records] == ["no font has the letters "]


def test_a_wrong_target_is_refused_before_any_work(radiance, tmp_path):
    samples = chd.Samples.from_array(radiance)
    with pytest.raises(InputError, match=r"must end in \.pdf"):
        chd.report(samples, tmp_path / "report.html")
    with pytest.raises(InputError, match="create it first"):
        chd.report(samples, tmp_path / "nowhere" / "report.pdf")


def test_a_scene_is_rendered_and_its_store_is_kept(tmp_path):
    options = {"spp": 2, "size": (16, 16), "backend": "scalar", "store": tmp_path / "c.zarr"}
    path = chd.report("cornell-box", tmp_path / "c.pdf", estimators=FIXED, **options)
    assert "16 × 16 pixels, 3 channels, 2 samples per pixel" in text_of(path)
    assert chd.open(tmp_path / "c.zarr").spp == 2
    again = chd.report(tmp_path / "c.zarr", tmp_path / "d.pdf", estimators=FIXED)
    assert "path" in text_of(again)


def test_the_first_page_tells_what_is_noisy_and_what_helps(tmp_path):
    """One pixel in ten is a hundred times as noisy; half the samples are null in another tenth."""
    rng = np.random.default_rng(0)
    x = 1 + 0.01 * rng.standard_normal((20, 20, 1, 128))
    x[:2] = rng.exponential(1.0, (2, 20, 1, 128))
    x[2:4] *= rng.random((2, 20, 1, 128)) < 0.2
    text = text_of(
        chd.report(
            chd.Samples.from_array(x.astype(np.float32)), tmp_path / "a.pdf", estimators=["mean"]
        ),
        last=1,
    )
    # Of 40 exponential pixels with CV 1, and 40 of which a fifth is lit with CV 2 in every pixel.
    assert "The largest part of the noise is in null-heavy pixels" in text
    assert re.search(r"10 % of the image and hold [78]\d % of its relative variance", text)
    assert re.search(r"[78]\.\d % \[", text)


def test_a_second_report_trains_as_the_first(radiance, tmp_path):
    samples = chd.Samples.from_array(radiance[:8, :8])
    asked = {"estimators": ("mean", "elek2019"), "iterations": 3}
    texts = [text_of(chd.report(samples, tmp_path / f"{i}.pdf", **asked)) for i in range(2)]
    assert texts[0] == texts[1]
    assert "3 minibatches train its network in place of 30000" in texts[0]
