"""Words follow numbers: no headline and no cell of a report says what its interval does not."""

from types import SimpleNamespace

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.resampling import Interval
from chdstat.analysis import NoiseShares
from chdstat.reporting import figures, headlines, scene_report
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import SceneData
from chdstat.studies.scene_data import WithinPixels
from chdstat.studies.studies import SceneStudy
from tests.reporting.contradictions import contradictions
from tests.viz.figures import texts

RNG_SEED = 3


def content_of(samples, monkeypatch, **options):
    """Return what a report would typeset."""
    kept = []
    monkeypatch.setattr(scene_report, "typeset", lambda document, _: kept.append(document))
    monkeypatch.setattr(scene_report.figures, "report_figures", lambda _: ({}, []))
    chd.report(samples, "never-written.pdf", progress=False, **options)
    return kept[0].content


def plain_noise(rng):
    return rng.gamma(1.0, size=(16, 16, 3, 96))


def dark_among_bright(rng):
    """Null-heavy pixels of rare bright samples among calm ones: any smoothing harms them."""
    x = 1 + 0.2 * rng.standard_normal((16, 16, 1, 96))
    x[::2, ::2] = 1e-3 * (1 + 0.1 * rng.standard_normal((8, 8, 1, 96)))
    x[:, :6] = rng.lognormal(0, 1.5, (16, 6, 1, 96)) * (rng.random((16, 6, 1, 96)) < 0.2)
    return np.abs(x)


def rare_light(rng):
    return rng.lognormal(0, 2.0, (16, 16, 1, 48)) * (rng.random((16, 16, 1, 48)) < 0.05)


@pytest.mark.parametrize("law", [plain_noise, dark_among_bright, rare_light])
def test_no_word_contradicts_its_interval(law, monkeypatch):
    x = law(np.random.default_rng(RNG_SEED)).astype(np.float32)
    content = content_of(chd.Samples.from_array(x), monkeypatch)
    assert content["findings"]
    assert contradictions(content) == []


def test_a_region_that_the_estimate_harms_has_a_headline():
    """With the numbers of a scene that had none: three times the error where nulls are many."""

    def row(estimator, label, value, low, high):
        ends = zip(("", "_low", "_high"), (value, low, high), strict=True)
        return {"estimator": estimator, "label": label} | {f"relmse_ratio{e}": v for e, v in ends}

    rows = [
        row("combination", "null_heavy", 3.16, 2.2, 4.4),
        row("median_of_means", "null_heavy", 0.006, 0.002, 0.011),
        row("combination", "gamma_like", 0.4, 0.3, 0.5),
        row("combination", "bimodal", 1.3, 0.8, 1.9),
    ]
    share = {"null_heavy": 0.6, "gamma_like": 0.3, "bimodal": 0.1}
    compared = SimpleNamespace(n=32, breakdown=SimpleNamespace(table=lambda: rows))
    (said,) = headlines.where_it_harms(compared, 1000, NoiseShares(0.5, share, share))
    assert said == (
        "The default estimate raises the relative error in null-heavy pixels.",
        "From 32 samples, over the mean's, in null-heavy pixels it is 3.2 [2.2, 4.4], that of "
        "median of means 0.006 [0.002, 0.011].",
    )


@pytest.fixture(scope="module")
def rendered():
    """Return the built-in scenes by name, rendered when they are asked for."""
    made = {}

    def of(name):
        if name not in made:
            made[name] = chd.render(name, spp=256, size=(24, 24), seed=0, progress=False)
        return made[name]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("spp", [16, 32, 64, 128, 256])
@pytest.mark.parametrize("scene", BUILTIN)
def test_no_word_of_forty_reports_contradicts_its_interval(scene, spp, rendered, monkeypatch):
    content = content_of(rendered(scene), monkeypatch, spp=spp)
    assert contradictions(content) == []


def finding(words, because):
    return {"finding": words, "because": because}


MEANS = "times the mean's"
WORSE = "3.2 [2.1, 4.5]\N{NO-BREAK SPACE}▲"


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"findings": [finding("The default estimate lowers the squared error.",
             f"From 32 samples, its squared error is 1.02 [0.95, 1.15] {MEANS}; .")]},
            "the squared error is",
        ),
        (
            {"findings": [finding("The default estimate does not help measurably.",
             f"its squared error is 0.4 [0.3, 0.5] {MEANS}")]},
            "the squared error is",
        ),
        (
            {"findings": [finding("The default estimate helps.",
             f"its squared error is 1.0 [0.3, 1.5] {MEANS}")]},
            "helps whom",
        ),
        (
            {"findings": [finding("x", "as of a mean of about 321 samples, 150 to 640")]},
            "more digits than the range",
        ),
        (
            {"findings": [finding("x", "it is 0.3123 [0.21, 0.44]")]},
            "more digits than the interval",
        ),
        ({"findings": [finding("x", "it is 0.5 [0.21, 0.44]")]}, "outside of its interval"),
        ({"noise": [{"name": "bimodal", "share": "5 %", "estimate": "3.2 [2.1, 4.5]"}]}, "sign"),
        ({"noise": [{"name": "bimodal", "share": "5 %", "estimate": WORSE}]}, "no headline says"),
        (
            {"findings": [finding("The largest part of the noise is in bimodal pixels.", "")],
             "noise": [{"name": n, "share": s, "estimate": "—"}
                       for n, s in (("bimodal", "5\N{NO-BREAK SPACE}%"),
                                    ("other", "50\N{NO-BREAK SPACE}%"))]},
            "other has 50",
        ),
        (
            {"key_figures": [{"value": "0.5", "interval": "0.6 to 0.7", "label": "x"}]},
            "outside of its interval",
        ),
    ],
)  # fmt: skip
def test_what_contradicts_is_found(changed, said):
    content = {"findings": [], "key_figures": []} | changed
    assert any(said in words for words in contradictions(content)), contradictions(content)


@pytest.mark.parametrize(
    ("ends", "says"),
    [
        ((0.03, 0.02, 0.04), "would take little of the noise: at most 4.0 %"),
        ((0.4, 0.3, 0.5), "could take 40 % [30 %, 50 %] of the noise"),
        ((0.1, 0.05, 0.2), "would take at most 20 % of the noise"),
        ((-0.01, -0.02, -0.005), "would take little of the noise: at most 0 %"),
    ],
)
def test_what_strata_take_follows_from_its_interval(ends, says):
    known = WithinPixels(Interval(*ends), pixels=0.05, held=0.2)
    ((finding, because),) = headlines._of_strata(known)
    assert finding.replace("\N{NO-BREAK SPACE}", " ") == f"Strata over the pixel {says}."
    assert "5.0\N{NO-BREAK SPACE}% of the pixels, as at edges" in because
    assert [*headlines._of_strata(None)] == []


def test_reports_on_scenes_say_and_show_what_strata_would_take(monkeypatch):
    content = content_of("cornell-box", monkeypatch, size=(16, 16), spp=64, backend="scalar")
    assert any("Strata over the pixel" in row["finding"] for row in content["findings"])
    samples = chd.render("cornell-box", size=(8, 8), spp=64, backend="scalar", film=True)
    shown = figures.ReportData(SceneStudy(SceneData("box", samples), ()))
    assert "Variation within the pixel" in texts(figures._within_pixels(shown))
    shown = figures.ReportData(
        SceneStudy(SceneData("box", chd.Samples(samples.read(), attrs={})), ())
    )
    assert figures._within_pixels(shown) is None
