"""The rules of a call: two looks, seeds, and how many right renders fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import chdstat as chd
from chdstat.errors import InputError
from chdstat.inference import Contrast, Reference
from chdstat.io import write_reference
from chdstat.render_tests import checks, draws, pages
from chdstat.render_tests.checks import verdict_on
from chdstat.render_tests.draws import Seeds, render_of
from chdstat.render_tests.verdicts import RenderCheck

SHAPE = (8, 8, 3)


def draw(seed: int, loss: float = 0) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).gamma(4.0, 0.25, SHAPE) * (1 - loss)


def samples(spp: int, seed: int = 0) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(seed)
    return rng.gamma(4.0, 0.25, (*SHAPE, spp))


@pytest.fixture
def asked(tmp_path: Path) -> RenderCheck:
    """Return a question with a reference of 48 samples."""
    path = write_reference(Reference.of_samples(samples(48)), tmp_path / "box.exr")
    return RenderCheck("box", path, "box-1", "t.py::test_box", 0.01, report=tmp_path / "report")


@pytest.fixture
def outcomes(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[int]]:
    """Return what lets contrasts find given outcomes: it returns their spp, as they are made."""

    def let(*given: str) -> list[int]:
        left, spp = iter(given), list[int]()

        def contrast(a: Any, b: Any, **options: Any) -> Contrast:
            spp.append(options.get("spp") or a.spp or 0)
            found = chd.contrast(a, b, **options)
            return replace(found, outcome=next(left))  # type: ignore[arg-type]

        for module in (checks, draws):
            monkeypatch.setattr(module, "contrast", contrast)
        return spp

    return let


# --- two looks ------------------------------------------------------------------------------------

PASS, FAIL, OPEN = "no difference found", "differ", "cannot tell"


@pytest.mark.parametrize(
    ("first", "second", "outcome"),
    [
        (PASS, None, PASS),
        (FAIL, FAIL, FAIL),
        (FAIL, PASS, PASS),
        (OPEN, PASS, PASS),
        (OPEN, OPEN, OPEN),
        (FAIL, OPEN, OPEN),
    ],
)
def test_the_second_look_decides_what_the_first_does_not_pass(
    first: str,
    second: str | None,
    outcome: str,
    asked: RenderCheck,
    outcomes: Callable[..., list[int]],
):
    spp = outcomes(*filter(None, (first, second)))
    verdict, _ = verdict_on(draw, replace(asked, spp=16))
    assert verdict.outcome == outcome
    assert verdict.looks == len(spp)
    assert spp == [16, 32][: len(spp)]


def test_samples_that_are_there_get_one_look(
    asked: RenderCheck, outcomes: Callable[..., list[int]]
):
    spp = outcomes(FAIL)
    verdict, _ = verdict_on(samples(16, seed=1), asked)
    assert (verdict.outcome, spp) == (FAIL, [16])


def test_looks_have_other_samples(asked: RenderCheck, outcomes: Callable[..., list[int]]):
    seeds = list[int]()

    def noting(seed: int) -> np.ndarray[Any, Any]:
        seeds.append(seed)
        return draw(seed)

    outcomes(FAIL, FAIL)
    verdict_on(noting, replace(asked, spp=16))
    assert len(seeds) == len(set(seeds)) == 48


@pytest.mark.slow
def test_right_renders_fail_as_rarely_as_alpha_says(tmp_path: Path):
    """40 right renders at a level of .2: their number of failures exceeds the 99.9 % quantile of a
    binomial distribution by chance in one of 1000 choices of seeds."""
    failed = 0
    for number in range(40):
        path = write_reference(Reference.of_samples(samples(48, 1000 + number)), tmp_path / "x.exr")
        asked = RenderCheck(f"box {number}", path, "box", "t", 0.2, 16, report=tmp_path)
        verdict, _ = verdict_on(draw, asked)
        failed += not verdict.passed
    assert failed <= stats.binom.ppf(0.999, 40, 0.2)


def test_a_loss_fails_in_both_looks(asked: RenderCheck):
    verdict, found = verdict_on(lambda seed: draw(seed, 0.3), replace(asked, spp=16))
    assert (verdict.outcome, verdict.looks) == ("differ", 2)
    assert verdict.spp is not None
    assert verdict.spp < 32  # it draws until it can tell
    assert found is not None
    assert verdict.p_value == found.image_p_value < 0.01
    assert "the render is" in verdict.sentence


def test_an_image_alone_may_be_a_reference(asked: RenderCheck):
    chd.io.write_exr(asked.reference, np.ones(SHAPE))
    verdict, _ = verdict_on(draw, replace(asked, spp=64))
    assert verdict.passed
    assert verdict.reference_spp is None
    assert "noise" in verdict.numbers["what the reference cannot show"]
    with pytest.raises(chd.errors.InputError, match="give spp="):
        verdict_on(draw, asked)
    renewed, _ = verdict_on(draw, replace(asked, spp=64, update=True))
    assert renewed.outcome == "replaced"
    assert Reference.read(asked.reference).spp == 192


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_pixels_that_the_reference_lacks_too_do_not_fail(asked: RenderCheck):
    def holed(seed: int) -> np.ndarray[Any, Any]:
        x = draw(seed)
        x[2, 3] = np.nan
        return x

    assert verdict_on(holed, replace(asked, spp=16))[0].outcome == "bad pixels"
    with pytest.raises(InputError, match="first at y 2, x 3"):
        verdict_on(holed, replace(asked, spp=16, update=True))
    samples = np.stack([holed(10**6 + i) for i in range(48)], axis=-1)
    write_reference(Reference.of_samples(chd.Samples.from_array(samples)), asked.reference)
    assert verdict_on(holed, replace(asked, spp=16))[0].passed


def test_a_black_render_makes_no_reference(asked: RenderCheck):
    with pytest.raises(InputError, match="the render is black"):
        verdict_on(lambda seed: 0 * draw(seed), replace(asked, name="black", spp=16, update=True))


@pytest.mark.parametrize(
    ("found", "outcome", "renewed"),
    [(PASS, "kept", False), (FAIL, "replaced", True), (OPEN, "cannot tell", False)],
)
def test_an_update_that_cannot_tell_keeps_the_old_and_fails(
    found: str, outcome: str, renewed: bool, asked: RenderCheck, outcomes: Callable[..., list[int]]
):
    before = asked.reference.read_bytes()
    outcomes(found)
    verdict, _ = verdict_on(draw, replace(asked, spp=16, update=True))
    assert verdict.outcome == outcome
    assert verdict.passed == (found != OPEN)
    assert (asked.reference.read_bytes() != before) == renewed
    assert ("delete box.exr to replace it anyway" in verdict.sentence) == (found == OPEN)


# --- seeds ----------------------------------------------------------------------------------------


def test_seeds_lie_far_apart():
    """A renderer may add the number of a pixel to the seed: 512 x 512 pixels of 256 passes."""
    seeds = np.sort([Seeds("bathroom").of_test(i) for i in range(256)])
    assert np.diff(seeds).min() > 512**2


def test_seeds_depend_on_name_and_number():
    of = [Seeds("a").of_test(0), Seeds("b").of_test(0), Seeds("a", 1).of_test(0)]
    assert len(set(of)) == 3
    assert Seeds("a").of_test(3) == Seeds("a").of_test(3)


def test_a_reference_and_its_successor_share_no_seed():
    seeds = Seeds("a")
    one, other = ({seeds.of_reference(i, other=o) for i in range(5000)} for o in (False, True))
    assert not one & other


# --- renders --------------------------------------------------------------------------------------


def of(render: Any, spp: int | None = None) -> Reference:
    return render_of(render, "box").reference(spp, iter(range(100)))


def test_a_scene_and_its_name_are_rendered():
    by_name, loaded = of("cornell-box", 2), of(chd.load_scene("cornell-box"), 2)
    assert by_name.spp == loaded.spp == 48
    assert (by_name.mean == loaded.mean).all()


def test_passes_may_be_files(tmp_path: Path):
    paths = [chd.io.write_exr(tmp_path / f"{i}.exr", draw(i)) for i in range(48)]
    batches = of(paths).batches
    assert batches is not None
    np.testing.assert_allclose(batches[..., 3], draw(3), rtol=1e-6)


def test_a_reference_of_a_function_is_that_of_its_samples():
    passes = np.stack([draw(i) for i in range(96)], axis=-1)
    passes[2, 3, :, :7] = np.nan
    own = Reference.of_samples(passes)
    found = render_of(lambda seed: passes[..., seed], "box").reference(32, iter(range(96)))
    for name, near in (("batches", 1e-6), ("variance", 1e-3), ("bad", 1e-9)):
        np.testing.assert_allclose(getattr(found, name), getattr(own, name), rtol=near, atol=near)
    assert (found.spp, own.spp) == (96, 96)


def test_references_have_whole_batches():
    found = render_of(draw, "box").reference(17, iter(range(1000)))
    assert found.spp == 96


# --- pages ----------------------------------------------------------------------------------------


@pytest.fixture
def page(asked: RenderCheck) -> str:
    verdict, _ = verdict_on(lambda seed: draw(seed, 0.3), replace(asked, spp=16))
    return (asked.report / verdict.page).read_text("utf-8")


def test_a_page_shows_the_window_where_it_is(page: str):
    assert 'style="left: 0.0%; top: 0.0%; width: 100.0%; height: 100.0%"' in page
    assert page.count("data:image/png;base64,") == 5


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_pages_show_any_number_of_channels(channels: int, asked: RenderCheck):
    reference = Reference.of_samples(samples(48)[:, :, :channels])
    write_reference(reference, asked.reference)
    verdict, found = verdict_on(samples(16, 1)[:, :, :channels], replace(asked, always=True))
    assert found is not None
    assert (asked.report / verdict.page).exists()
    assert len(pages.thumbnails(found)) == 2


def test_a_large_image_has_small_thumbnails():
    a, b = np.random.default_rng(1).gamma(2.0, size=(2, 4, 900, 3, 8))
    found = chd.contrast(a, b)
    assert all(len(text) < 4 * 128 * 4 * 2 for text in pages.thumbnails(found).values())
