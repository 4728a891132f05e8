"""Display: what results show of themselves, in a terminal and in a notebook."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import dataclass
from html.parser import HTMLParser

import matplotlib.image
import numpy as np
import pytest

import chdstat as chd
from chdstat._core.display import (
    Card,
    Shown,
    byte_size,
    duration,
    latex,
    number,
    percent,
    png,
    with_margin,
    written,
)

VOID = {"img"}


class Tags(HTMLParser):
    """Checks that tags are closed in order, and collects the text."""

    def __init__(self, html):
        super().__init__()
        self.open, self.texts, self.images = [], [], []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        else:
            self.images.append(dict(attrs))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.5, "0.500"),
        (1e30, "1.0e+30"),
        (float("nan"), "—"),
        (np.array(["gamma", ""]), "[gamma, ]"),
        (np.zeros((0, 3)), "[]"),
        (np.full(40, np.nan), "(40,) float64, no number"),
        (np.array([np.nan, *range(99)]), "(100,) float64, 0 to 98.0, 1.0\xa0% missing"),
        (np.arange(40, dtype=np.int8), "(40,) int8, 0 to 39"),
        ({"a": 1, "b": (2.0, "c")}, "a 1, b 2.00, c"),
    ],
)
def test_values_are_written_in_short(value, text):
    assert written(value) == text


def test_numbers_and_units_read_well():
    assert [number(v) for v in (0, 1e-7, 99.96, np.inf)] == ["0", "1.0e−07", "100", "—"]
    assert number(12_345_678) == "1.2e+07"
    assert [percent(v, sign=True) for v in (-0.0004, 0.0004)] == ["0.0\xa0%"] * 2
    assert [percent(np.nan), with_margin(np.nan, 0.1)] == ["—"] * 2
    assert [byte_size(0), byte_size(1024)] == ["0 B", "1.00 KiB"]
    assert [duration(0), duration(119.6)] == ["0 ns", "120 s"]


def test_text_from_others_cannot_become_markup():
    evil = "<script>alert('x')</script>"
    card = Card(evil, {evil: evil}, [{evil: evil}], {evil: png(np.zeros((2, 2)))})
    tags = Tags(card.html())
    assert "<script" not in card.html()
    assert tags.texts.count(evil) == 6
    assert tags.images[0]["alt"] == evil


def test_an_image_arrives_as_it_was():
    values = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 1]]], float)
    source = Tags(Card("a", images={"b": png(values)}).html()).images[0]["src"]
    found = matplotlib.image.imread(io.BytesIO(base64.b64decode(source.partition(",")[2])))
    assert np.array_equal(found[..., :3], values)
    assert matplotlib.image.imread(io.BytesIO(png(np.eye(3)))).shape[:2] == (3, 3)


@dataclass(frozen=True, repr=False)
class Many(Shown):
    rows: tuple[float, ...]

    def _card(self):
        return Card("Many", {f"fact {i}": value for i, value in enumerate(self.rows)})


def test_a_screen_says_how_many_lines_are_left_out():
    assert repr(Many((1.0,) * 23)).count("\n") == 23
    text = repr(Many((1.0,) * 30))
    assert text.count("\n") == 23
    assert text.endswith("... and 8 more lines")
    assert Many((1.0,) * 30)._repr_html_().count("<tr>") == 30


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    radiance = rng.gamma(2.0, size=(8, 12, 3, 128)) * (rng.random((8, 12, 1, 128)) < 0.75)
    return chd.Samples.from_array(radiance, scene="<wall>", seed=3, sampler="independent")


@pytest.fixture(scope="module")
def results(samples, stored, model):
    x = samples[2, 3]
    null = (x == 0).all(axis=0)
    gamma = chd.fit.gamma(x, null=null)
    compared = chd.compare(samples, ["mean", "median"], n=8, labels="classify", progress=False)
    study = chd.study(samples, estimators=["mean"], progress=False)
    found = {
        "samples": samples,
        "pixel": samples.pixel(2, 3),
        "scene": chd.load_scene("cornell-box"),
        "fit": gamma,
        "fits of an image": chd.fit.gamma(samples.read()),
        "mixture": chd.fit.mixture(x, null=null),
        "selection": chd.fit.select(x, null=null, held_out=True),
        "tail": chd.fit.tail_index(x, null=null),
        "goodness": chd.fit.goodness(x, "gamma", resamples=0),
        "gaussianity": chd.gaussianity(x, null=null),
        "gaussianity of means": chd.inference.gaussianity_of_means(x),
        "modality": chd.modality(x, null=null),
        "difference": chd.difference(x, samples[0, 0]),
        "histogram": chd.histogram(x, null=null),
        "patterns": chd.classify(samples.read()),
        "atlas": chd.atlas(samples, progress=False),
        "comparison": compared,
        "breakdown": compared.breakdown,
        "curve": chd.comparison.error_curve(samples, ["mean"], sizes=[4, 8], progress=False),
        "pixels of a comparison": compared.draw_pixels(4),
        "untrained": chd.estimators.MLP.preset("elek2019"),
        "model": model,
        "history": model.history,
        "estimates": model.estimate(chd.open(stored()).first(32)),
        "estimator": chd.estimators.lookup("mean"),
        "learned estimator": chd.estimators.lookup("elek2019"),
        "study": study,
        "scene of a study": study.scenes[0],
        "finding": study.scenes[0].findings[1],
    }
    found["held out"] = found["selection"].held_out
    return found


def test_results_show_themselves(results):
    for name, result in results.items():
        text = repr(result)
        lines = text.splitlines()
        assert len(lines) <= 24, name
        # Eight columns of words and intervals are a letter or two too wide, rather than cut.
        assert max(map(len, lines)) <= (82 if name == "breakdown" else 80), text
        more = lines[-1].startswith("  ... and ")
        assert not re.search(r"\.\.\.|…", "\n".join(lines[:-1] if more else lines)), text
        assert "object at 0x" not in text, name
        assert Tags(result._repr_html_()).texts, name


def test_samples_show_a_thumbnail(samples):
    tags = Tags(samples._repr_html_())
    assert tags.images[0]["alt"] == "mean of the first 128 samples"
    assert {"<wall> (samples given)", "independent sampler, seed 3"} <= set(tags.texts)
    source = base64.b64decode(tags.images[0]["src"].partition(",")[2])
    shown = matplotlib.image.imread(io.BytesIO(source))[..., :3]
    assert np.allclose(shown, chd.viz.tonemap(samples.read().mean(axis=-1)), atol=0.01)


def test_a_pixel_that_cannot_be_fitted_says_why():
    dark = chd.fit.gamma(np.zeros(64))
    assert repr(dark).splitlines()[-1] == "  not fitted  all null"


def test_latex_escapes_and_spells():
    rows = [{"a & b": r"50 % of $x_1^{2}$ \ #", "c": "−1.5 ± 0.2 < 3 × 10 — … ~|"}]
    _, _, head, _, row, *_ = latex(rows).splitlines()
    assert head == r"a \& b & c \\"
    left, right = row.removesuffix(r" \\").split(" & ")
    assert left == r"50 \% of \$x\_1\textasciicircum \{2\}\$ \textbackslash \space \#"
    assert right == (r"$-$1.5 $\pm$ 0.2 $<$ 3 $\times$ 10 --- \dots{} \textasciitilde \textbar{}")


def test_latex_of_a_result_without_table():
    @dataclass(frozen=True, repr=False)
    class Found(Shown):
        share: str

    lines = Found("50 %").to_latex().splitlines()
    assert lines[0] == r"\begin{tabular}{ll}"
    assert lines[4] == r"share & 50 \% \\"
    assert lines[-1] == r"\end{tabular}"
