"""The page in a real browser, from the first image to the last export."""

from __future__ import annotations

import io
import re
import shutil
import threading
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

import chdstat as chd
from chdstat.analysis import save
from chdstat.explorer import Explorer, selection
from chdstat.explorer.overlays import IMAGES, ramp
from chdstat.io import write_exr
from chdstat.patterns import Label
from chdstat.samples.store import Store
from chdstat.viz.styling import called
from tests.luminance import LUMINANCE

SIZE = 32
PATIENCE = 600_000
"""Milliseconds after which a page counts as stuck, however busy the machine is."""


class Person:
    """Someone before a page: looks, points, clicks, presses keys."""

    def __init__(self, page, explorer):
        self.page, self.explorer, self.url = page, explorer, explorer.url
        self.errors = []
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def open(self, query=""):
        self.page.goto(self.url + query)
        self.page.wait_for_selector("body[data-shown]")
        return self

    def place(self, y, x, image=0, size=SIZE):
        box = self.page.locator(".image").nth(image).bounding_box()
        return box["x"] + (x + 0.5) / size * box["width"], box["y"] + (y + 0.5) / size * box[
            "height"
        ]

    def point(self, y, x):
        self.page.mouse.move(*self.place(y, x))

    def click(self, y, x, *, shift=False, image=0):
        with self.answered():
            if shift:
                self.page.keyboard.down("Shift")
            self.page.mouse.click(*self.place(y, x, image))
            if shift:
                self.page.keyboard.up("Shift")

    def hold(self):
        """Wait while the mouse is down, by the clock of the page: longer than a click takes."""
        since = self.page.evaluate("performance.now()")
        self.waits_for("since => performance.now() > since + 600", arg=since)

    def press(self, key):
        with self.answered():
            self.page.keyboard.press(key)

    @contextmanager
    def answered(self):
        """Wait until what is done within is shown."""
        before = self.page.evaluate("window.chdstat.timings.length")
        yield
        shown = "t => window.chdstat.timings.length > t && window.chdstat.timings.at(-1).end"
        self.page.wait_for_function(shown, arg=before)

    def waits_for(self, expression, **options):
        """Wait until an expression is true on the page."""
        self.page.wait_for_function(expression, **options)

    def text(self, query):
        return self.page.locator(query).inner_text()

    @property
    def query(self):
        return parse_qs(urlsplit(self.page.url).query)

    @property
    def chips(self):
        return [
            t.strip() for t in self.page.locator("#chips .chip > :first-child").all_inner_texts()
        ]

    def alert(self):
        self.page.wait_for_selector("#alert:not([hidden])")
        return self.text("#alert span")


@pytest.fixture(scope="module")
def context(browser):
    """Pages of one context keep the scripts that they share."""
    with browser.new_context() as context:
        yield context


@pytest.fixture
def person(context, explored, store_path, served):
    people = []

    def come(source, **options):
        if source is store_path and not options:
            source = served
        elif not isinstance(source, Explorer):
            source = explored(source, **options)
        page = context.new_page()
        page.set_viewport_size({"width": 1280, "height": 900})
        people.append(Person(page, source))
        return people[-1]

    yield come
    for one in people:
        assert one.errors == []
        one.page.close()


def test_a_click_shows_the_distribution(person, store_path):
    one = person(store_path).open()
    assert one.text("h1") == "box.zarr · cornell-box"
    assert one.text("#described") == "32 × 32 px · 64 spp · path"
    assert len(one.chips) == 1  # the brightest firefly, or the centre
    assert one.page.locator("#headline dl > div").count() == 5
    one.point(20, 10)
    pixel = chd.open(store_path)[20, 10]
    assert one.text("#readout").startswith("y 20 x 10 · R ")
    assert f"{pixel[0].mean():.3g}"[:4] in one.text("#readout")
    one.click(20, 10)
    assert one.chips == ["1: y 20 x 10"]
    assert one.query == {"p": ["20,10"]}
    null = (pixel == 0).all(axis=0).mean()
    assert one.text("#note-log").startswith(f"{100 * null:.0f}\N{NO-BREAK SPACE}% null · 0 bad")
    assert "sample mean" in one.text("#estimates")
    assert one.text("#headline h2").startswith("Pixel · y 20, x 10 · 64 samples")
    assert not one.page.locator("#statistics").is_visible()
    one.page.get_by_text("All statistics").click()
    assert "N for Gaussian averages" in one.text("#statistics")
    assert one.text("#patterns").startswith("Patterns: ")
    lines = one.page.evaluate(
        "Bokeh.documents[0].get_model_by_name('log').renderers[1].data_source.data.xs.length"
    )
    assert lines >= 3


MARKED = "[...document.querySelectorAll('#headline, .panels, .tables')].map((e) => e.ariaBusy)"


def test_what_is_not_of_the_selection_is_marked(person, store_path, monkeypatch):
    """From the command until it is fresh, whatever comes between; the server goes on when told."""
    gates = {name: threading.Semaphore(0) for name in ("plots", "describe")}
    results = selection.SelectionResults

    def gated(compute, gate):
        return lambda *arguments: gate.acquire(timeout=600) and compute(*arguments)

    for name, gate in gates.items():
        monkeypatch.setattr(results, name, gated(getattr(results, name), gate))
    one = person(store_path)
    one.page.goto(one.url + "?p=20,10&z=0,0,20,20")
    one.page.wait_for_selector("body[data-ready]")
    assert "Reading the samples" in one.text("#headline")  # no empty boxes ...
    note = "getComputedStyle(document.querySelector('#note-log'), '::after').content"
    assert "reading samples" in one.page.evaluate(note)
    gates["plots"].release()
    one.waits_for(f"{MARKED}.join() === 'true,false,true'")
    gates["describe"].release()
    one.waits_for(f"{MARKED}.join() === 'false,false,false'")
    one.page.locator(".image").focus()
    one.page.keyboard.press("l")
    one.page.keyboard.press("j")
    assert one.page.evaluate(MARKED) == ["true"] * 3  # at once, before any answer
    one.waits_for("document.querySelector('#chips').innerText.includes('y 21 x 11')")
    one.page.evaluate("window.chdstat.box({final: true, geometry: {type: 'rect', x0: -5, x1: -4,"
                      " y0: 1, y1: 2}})")  # fmt: skip
    assert "outside the image" in one.alert()  # is refused, and the last one is still to come
    assert one.page.evaluate(MARKED) == ["true"] * 3
    assert "y 20, x 10" in one.text("#headline h2")
    for gate in gates.values():
        gate.release(9)
    one.waits_for(f"{MARKED}.join() === 'false,false,false'")
    assert "y 21, x 11" in one.text("#headline h2")


def test_pixels_that_are_worth_a_look_are_suggested(person, store_path):
    one = person(store_path).open()
    one.page.wait_for_selector("#suggested button")
    names = one.page.locator("#suggested button").all_inner_texts()
    assert set(names) <= {"long tail", "bimodal", "null-heavy"}
    with one.answered():
        one.page.locator("#suggested button", has_text=names[0]).first.click()
    assert len(one.chips) == 1
    flagged = one.page.locator("#patterns tr", has_text="●").all_inner_texts()
    assert flagged


def test_several_pixels_have_a_row_and_a_column_each(person, store_path):
    one = person(store_path).open("?p=20,10&p=5,6&p=8,9&a=1")
    assert one.text("#headline h2").startswith("Pixel 2 · y 5, x 6")
    assert "pixel 2: y 5, x 6" in one.text("#estimates h2")
    one.page.get_by_text("All statistics").click()
    for table in ("#patterns", "#statistics"):
        heads = one.page.locator(f"{table} th").all_inner_texts()
        assert [h for h in heads if h.startswith("pixel ")] == ["pixel 1", "pixel 2", "pixel 3"]
    texts = "Bokeh.documents[0].get_model_by_name('linear').renderers.at(-1).data_source.data.text"
    shown = one.page.evaluate(texts)
    assert next(t for t in shown if t in {"1", "2", "3"}) == "1"
    assert len(shown) >= 3 * 3  # each has a number and its own axis


def test_selections_by_mouse_and_keys(person, store_path):
    one = person(store_path).open()
    one.click(5, 5)
    for i in range(5):
        one.click(10, 4 + 5 * i, shift=True)
    assert len(one.chips) == 6
    assert one.query["p"][-1] == "10,24"
    one.page.keyboard.down("Shift")
    one.page.mouse.click(*one.place(30, 30))
    one.page.keyboard.up("Shift")
    assert "at most 6" in one.alert()
    one.press("ArrowDown")
    one.press("ArrowRight")
    assert one.chips[-1] == "6: y 11 x 25"
    one.press("Shift+ArrowRight")  # ten at once, but no farther than the border
    assert one.chips[-1] == "6: y 11 x 31"
    one.click(5, 5, shift=True)  # drops it
    assert len(one.chips) == 5
    with one.answered():
        one.page.get_by_role("button", name="2: y 10").click()
    assert one.query["a"] == ["1"]
    one.click(8, 8)
    assert one.chips == ["1: y 8 x 8"]
    for x in (3, 9, 15, 21):  # fast clicks are all clicks
        one.page.mouse.click(*one.place(12, x))
    one.waits_for("document.querySelector('#chips').innerText.includes('x 21')")


def test_a_box_picks_a_region(person, store_path):
    one = person(store_path).open()
    one.page.get_by_role("button", name="Select a box").click()
    with one.answered():
        one.page.mouse.move(*one.place(4, 6))
        one.page.mouse.down()
        one.page.mouse.move(*one.place(8, 10), steps=3)
        one.page.mouse.move(*one.place(11, 15), steps=3)
        one.page.mouse.up()
    assert one.chips == ["region y 4–11, x 6–15 (8 × 10)"]
    assert one.query == {"r": ["4,6,12,16"]}
    assert one.text("#headline h2").startswith(
        "Region y 4–11, x 6–15 · 80 pixels · 5\u2009120 samples"
    )
    with one.answered():  # a press that is held is a click ...
        one.page.mouse.move(*one.place(12, 9))
        one.page.mouse.down()
        one.hold()
        one.page.mouse.up()
    assert one.chips == ["1: y 12 x 9"]
    with one.answered():  # ... unless it becomes a drag
        one.page.mouse.move(*one.place(4, 6))
        one.page.mouse.down()
        one.hold()
        one.page.mouse.move(*one.place(11, 15), steps=4)
        one.page.mouse.up()
    one.waits_for("document.querySelector('#chips').innerText.includes('region')")
    assert one.chips == ["region y 4–11, x 6–15 (8 × 10)"]


BAND = "document.querySelector('#panel-image .brush')"


def test_samples_of_a_range_are_found_in_the_image(person, store_path):
    """By the mouse, the keyboard and the address; Escape undoes it."""
    told = "document.querySelector('#brushed').innerText"
    one = person(store_path).open("?p=20,10&b=null")
    one.waits_for(f"{told}.includes('null samples')")
    one.page.keyboard.press("Escape")
    one.waits_for("!location.search.includes('b=')")
    plot = one.page.locator("#panel-image .plot")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    one.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)
    one.page.mouse.down()
    one.page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 40, steps=3)
    assert not one.page.evaluate(f"{BAND}.hidden")  # while it is drawn
    one.page.mouse.up()
    one.waits_for(f"location.search.includes('b=') && {told}.includes('samples with luminance')")
    low, high = (float(v) for v in one.query["b"][0].split(","))
    x = chd.open(store_path).read()
    inside = np.einsum("yxcs,c->yxs", x, LUMINANCE)
    inside = ((inside >= np.float32(low)) & (inside <= np.float32(high))).sum(axis=-1)
    pixels, samples = (
        (f"{int(v):,}".replace(",", "\u2009")) for v in ((inside > 0).sum(), inside.sum())
    )
    assert one.page.evaluate(told).startswith(f"{pixels} pixels hold {samples} samples")
    values = "Bokeh.documents[0].get_model_by_name('image0').renderers[1].data_source.data.image[0]"
    shown = np.array(one.page.evaluate(f"Array.from({values})"), float).reshape(SIZE, SIZE)
    np.testing.assert_allclose(np.nan_to_num(10**shown), inside / 64, rtol=1e-5)
    one.page.keyboard.press("Escape")
    one.waits_for(f"!location.search.includes('b=') && {told} === '' && {BAND}.hidden")
    one.page.keyboard.press("w")
    one.page.keyboard.type("0.5")
    one.page.keyboard.press("Tab")
    one.waits_for(f"location.search.includes('b=0.5') && {told}.includes('of 0.500 or more')")
    ends = "[...document.querySelectorAll('#brushing input')].map((e) => e.value).join()"
    one.page.keyboard.type("0.2")  # the upper end, and below the lower one, which gives way
    one.page.keyboard.press("Tab")
    one.waits_for(f"{told}.includes('of 0.200 or less') && {ends} === ',0.2'")
    one.page.locator("#brushing input").first.focus()
    one.page.keyboard.press("Escape")  # from within the field, too
    one.waits_for("!location.search.includes('b=')")
    one.page.locator("h1").click()
    one.page.keyboard.press("o")
    one.waits_for(f"location.search.includes('b=null') && {told}.includes('null samples')")
    one.open("?p=20,10&b=null")  # the map is there: its bar comes before the view
    assert not one.page.locator("#limits").is_visible()
    one.page.locator("select[data-option=map]").select_option("null_share")
    one.waits_for("!location.search.includes('b=') && location.search.includes('map=')")
    linear = "document.querySelector('#panel-linear .brush')"
    plot = one.page.locator("#panel-linear .plot")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    for edge, key in (
        (0.8, "Escape"),
        (1.01, None),
    ):  # a drag is undone, and one to the edge is open
        one.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)
        one.page.mouse.down()
        one.page.mouse.move(box["x"] + edge * box["width"], box["y"] + 40, steps=3)
        if key:
            one.page.keyboard.press(key)
            assert one.page.evaluate(f"{linear}.hidden")
        one.page.mouse.up()
    one.waits_for(f"{told}.includes(' or more: ') && /b=[0-9.]+(,|%2C)(&|$)/.test(location.search)")


def test_a_click_outside_changes_nothing(person, store_path):
    one = person(store_path).open("?p=3,4")
    for _ in range(4):
        one.page.get_by_role("button", name="Zoom out").click()
    one.waits_for("location.search.includes('z=')")
    box = one.page.locator(".image").bounding_box()
    one.page.mouse.click(box["x"] + 5, box["y"] + 5)
    assert "outside the image" in one.alert()
    assert one.query["p"] == ["3,4"]
    one.page.get_by_role("button", name="Dismiss").click()
    assert not one.page.locator("#alert").is_visible()


def test_maps_take_the_place_of_the_image(person, store_path):
    one = person(store_path).open("?p=20,10")
    for name, expected in {
        "null_share": "share of the good samples",
        "tail_index": "generalised Pareto",
        "best_family": "by BIC",
        "pattern": "primary label",
        "n_needed": "samples, luminance",
    }.items():
        one.page.locator("select[data-option=map]").select_option(name)
        one.waits_for(
            "(words) => document.querySelector('#colorbar').innerText.includes(words)"
            " && document.querySelector('#working').innerText === ''",
            arg=expected,
        )
        # The address follows in an answer of its own.
        one.waits_for("name => new URLSearchParams(location.search).get('map') === name", arg=name)
    one.point(20, 10)
    assert "N needed" in one.text("#readout")
    one.page.locator("select[data-option=map]").select_option("image")
    one.page.wait_for_selector("#colorbar", state="hidden")


def test_maps_have_ranges_and_opacity_and_come_from_files(person, explored, store_path, tmp_path):
    path = save(chd.summarize(chd.open(store_path), progress=False), tmp_path / "maps.zarr")
    explorer = explored(store_path, maps=path)
    one = person(explorer).open("?p=20,10&map=file:null_share")
    one.waits_for("document.querySelector('#colorbar').innerText.includes('Null share')")
    one.page.locator("#limits input").first.fill("0.25")
    one.page.locator("#limits input").first.press("Enter")
    one.waits_for("location.search.includes('lim=0.25')")
    low = "Bokeh.documents[0].get_model_by_name('image0').renderers[1].glyph.color_mapper.low"
    one.waits_for(f"{low} === 0.25")  # the address may be first
    one.page.locator("#opacity").fill("0.5")
    alpha = "Bokeh.documents[0].get_model_by_name('image0').renderers[1].glyph.global_alpha"
    one.waits_for(f"(() => {{ const a = {alpha}; return (a.value ?? a) === 0.5; }})()")
    one.waits_for("location.search.includes('o=0.5')")
    again = person(explorer).open(one.page.evaluate("location.search"))
    again.waits_for(f"(() => {{ const a = {alpha}; return (a.value ?? a) === 0.5; }})()")
    assert again.page.locator("#opacity").input_value() == "0.5"
    assert not one.page.locator("select[data-option=signed]").is_visible()
    one.page.locator("select[data-option=cmap]").select_option("magma")
    one.waits_for("location.search.includes('cm=magma')")
    palette = "Bokeh.documents[0].get_model_by_name('image0').renderers[1].glyph.color_mapper"
    one.waits_for(f"{palette}.palette.at(-1) === '{ramp('magma')[-1]}'")
    one.page.locator("select[data-option=map]").select_option("relative_error")
    one.waits_for("!location.search.includes('lim=')")
    ticks = "[...document.querySelectorAll('#colorbar .ends span')].map((e) => e.innerText)"
    one.waits_for(f"{ticks}.join(' ') === '0.001 0.01 0.1 1'")  # values, not their logarithms
    relative = chd.open(store_path).pixel(20, 10).moments
    share = float(relative.standard_error[-1] / relative.mean[-1])
    one.point(20, 10)
    assert float(one.text("#readout").rsplit(maxsplit=1)[1]) == pytest.approx(share, rel=1e-3)
    one.page.locator("#limits input").first.fill("0")
    one.page.locator("#limits input").first.press("Enter")
    assert "must be above 0" in one.alert()


def test_keys_change_exposure_channel_and_map(person, store_path):
    one = person(store_path).open("?p=20,10&ev=1")
    one.page.locator(".image").focus()
    for key, name, value in (
        ("e", "ev", "1.5"), ("Shift+E", "ev", "1"), ("g", "g", "1.1"), ("c", "c", "0"),
        ("i", "map", "null_share"), ("l", "p", "20,11"), ("Shift+K", "p", "10,11"),
        ("ArrowLeft", "p", "10,10"),
    ):  # fmt: skip
        one.page.keyboard.press(key)
        one.waits_for(
            "([n, v]) => new URLSearchParams(location.search).get(n) === v", arg=[name, value]
        )
    one.page.keyboard.press("r")
    one.waits_for("!location.search.includes('ev=') && !location.search.includes('g=')")
    one.page.keyboard.press("?")
    assert "next channel" in one.text("#help")
    assert "reference" not in one.text("#help")


def test_the_pixel_under_the_pointer_stands_beside_a_pinned_one(person, store_path):
    one = person(store_path).open("?p=20,10")
    one.page.keyboard.press("v")
    chips = "document.querySelector('#chips').innerText"
    for y, x in ((5, 6), (8, 9)):
        one.point(y, x)
        one.waits_for(f"{chips}.includes('2: y {y} x {x}')")
    assert one.chips[0] == "1: y 20 x 10"
    one.page.mouse.click(*one.place(8, 9))  # pinned: the next one is a third
    one.point(12, 25)
    one.waits_for(f"{chips}.includes('3: y 12 x 25')")
    one.page.keyboard.press("v")
    one.waits_for(f"!{chips}.includes('3:')")
    assert one.chips == ["1: y 20 x 10", "2: y 8 x 9"]


def test_zoom_is_in_the_address(person, store_path):
    one = person(store_path).open("?p=20,10&z=8,18,14,24")
    values = "Bokeh.documents[0].get_model_by_name('image0').renderers.at(-1).data_source.data.text"
    one.waits_for(f"{values}.length === 36")
    pixel = chd.open(store_path)[18, 8].mean(axis=-1)
    shown = [float(v) for v in one.page.evaluate(values)[0].split("\n")]
    np.testing.assert_allclose(shown, pixel, rtol=1e-2)
    one.page.get_by_role("button", name="Fit", exact=True).click()
    one.waits_for("!location.search.includes('z=')")
    assert one.page.evaluate(values) == []
    one.page.get_by_role("button", name="Zoom in").click()
    one.waits_for("location.search.includes('z=')")


def test_the_theme_is_that_of_the_system_until_it_is_switched(browser, served):
    with browser.new_context(color_scheme="light") as context:
        one = Person(context.new_page(), served).open("?p=20,10")
        theme, plot = "document.documentElement.dataset.theme", "'linear'"
        ground = f"Bokeh.documents[0].get_model_by_name({plot}).background_fill_color"
        assert one.page.evaluate(theme) == "light"
        assert one.page.evaluate(f"(c => c.value ?? c)({ground})") == "#ffffff"
        one.page.get_by_role("button", name="Light or dark").click()
        one.page.reload()
        one.page.wait_for_selector("body[data-shown]")
        assert one.page.evaluate(theme) == "dark"
        assert one.errors == []


def test_options_change_what_is_drawn(person, store_path):
    one = person(store_path).open("?p=20,10")
    for name in ("gamma", "mixture"):
        one.page.locator(f"[data-family={name}]").check()
        one.waits_for(f"location.search.includes('{name}')")
    one.page.locator("[data-family=best]").uncheck()
    batches = one.page.locator("select[data-option=batch]")
    assert batches.input_value() == "16"  # a quarter of the samples, though 32 is the default
    assert batches.locator("option:not([disabled])").all_inner_texts() == ["1", "2", "4", "8", "16"]
    one.page.locator("select[data-option=batch]").select_option("8")
    one.waits_for("document.querySelector('#estimates h2').innerText.includes('from 8')")
    one.page.locator("select[data-option=channel]").select_option("luminance")
    one.waits_for("document.querySelector('#legend').innerText === 'luminance'")
    one.page.locator("select[data-option=tone]").select_option("filmic")
    one.page.locator("#exposure").fill("2.5")
    one.waits_for("location.search.includes('ev=2.5')")
    assert one.text("#stops") == "+2.50"
    assert one.query == {
        "p": ["20,10"], "c": ["luminance"], "f": ["gamma,mixture"], "n": ["8"], "ev": ["2.5"],
        "tone": ["filmic"],
    }  # fmt: skip
    one.page.get_by_role("button", name="Auto").click()
    one.waits_for("!location.search.includes('ev=')")


TICKS = {
    (0.03, 1.5): [0.05, 0.1, 0.2, 0.5, 1],
    (1, 128): [1, 2, 5, 10, 20, 50, 100],
    (1e-3, 0.9): [0.001, 0.003, 0.01, 0.03, 0.1, 0.3],
    (1e-5, 1e5): [1e-4, 1e-2, 1, 1e2, 1e4],
    (1e-30, 1e30): [1e-30, 1e-20, 1e-10, 1, 1e10, 1e20, 1e30],
    (0.29, 0.95): [0.4, 0.6, 0.8],
    (0, 1): [],
}


def test_names_of_patterns_tell_cause_and_cure(person, store_path):
    one = person(store_path).open("?p=20,10&map=pattern")
    pattern = chd.open(store_path).pixel(20, 10).patterns
    label = Label(int(pattern.label))
    assert one.text("#why").endswith(f": {label.meaning}")
    one.waits_for("document.querySelector('#colorbar button')")
    for place in ("#why", "#patterns tr:nth-child(3)", "#colorbar"):
        button = one.page.locator(f"{place} button").first
        (told,) = (x for x in Label if called(x.name.lower()) == button.inner_text())
        button.click()
        said, cure = one.text("#help"), told.cure_by(chd.open(store_path).attrs)
        assert all(text in said for text in (told.meaning, cure, told.typical))
        one.page.keyboard.press("Escape")


def test_an_address_that_is_wrong_is_explained(person, store_path):
    one = person(store_path).open("?p=99,0&p=1,1&map=wave&store=/etc/passwd")
    said = one.alert()
    assert "outside the image" in said
    assert "no map is called 'wave'" in said
    assert "'store'" in said
    assert one.chips == ["1: y 1 x 1"]


def test_fits_are_tested_when_asked(person, store_path, monkeypatch):
    monkeypatch.setattr(selection, "RESAMPLES", 9)
    one = person(store_path).open("?p=20,10")
    assert not one.page.locator("#goodness progress").is_visible()
    one.page.get_by_role("button", name="Test the fits").click()
    one.page.wait_for_selector("#goodness table")
    assert "199 replicates" in one.text("#goodness .note")
    assert one.page.locator("#goodness tr").count() == 5  # the head and four families
    one.page.evaluate("scrollTo(0, 0)")
    one.click(5, 5)  # another place, another question
    assert one.page.get_by_role("button", name="Test the fits").is_enabled()


def test_trained_estimators_are_among_the_others(person, tmp_path):
    x = np.random.default_rng(0).gamma(2.0, size=(24, 32, 3, 128)).astype(np.float32)
    chd.Samples.from_array(x).save(tmp_path / "a.zarr")
    samples = chd.open(tmp_path / "a.zarr")
    path = tmp_path / "mine.safetensors"
    chd.estimators.train_model(samples, iterations=5, progress=False).save(path)
    one = person(tmp_path / "a.zarr", models=[path]).open("?p=20,10&n=32")
    one.waits_for("document.querySelector('#estimates').innerText.includes('mine')")
    row = one.page.locator("#estimates tr", has_text="mine").inner_text()
    assert re.search(r"mine, [\d.]+.% certain.* ± ", row.replace("\n", " "))


def test_exports_are_files(person, store_path):
    one = person(store_path).open("?p=20,10&p=5,6")
    content = {}
    for kind in ("csv", "png", "svg", "pdf"):
        with one.page.expect_download() as coming:
            one.page.locator(f"[data-export={kind}]").click()
        assert coming.value.suggested_filename == f"box-20_10-5_6.{kind}"
        content[kind] = Path(coming.value.path()).read_bytes()
    samples = chd.open(store_path)
    table = np.genfromtxt(io.BytesIO(content["csv"]), delimiter=",", names=True)
    np.testing.assert_array_equal(table["G"][:64].astype(np.float32), samples[20, 10][1])
    assert len(table) == 128
    assert content["png"].startswith(b"\x89PNG")
    assert content["svg"].startswith(b"<?xml")
    pdfium = pytest.importorskip("pypdfium2")
    with pdfium.PdfDocument(content["pdf"]) as document:
        assert len(document) == 1


@pytest.fixture(scope="module")
def several(store_path, tmp_path_factory):
    """Return the store, one with shorter paths, and an image without samples."""
    folder = tmp_path_factory.mktemp("several")
    other = chd.render(
        "cornell-box", spp=64, size=(32, 32), max_depth=2, seed=5, out=folder / "other.zarr",
        backend="scalar", progress=False,
    )  # fmt: skip
    image = np.asarray(chd.summarize(other, progress=False)["mean"], np.float32)
    return [store_path, other.path, write_exr(folder / "reference.exr", image)]


FRONT = "[...document.querySelectorAll('figure')].findIndex((f) => f.classList.contains('front'))"


def test_several_images_are_compared(person, several):
    one = person(several).open("?p=20,10")
    assert one.text("h1") == "box.zarr, other.zarr, reference.exr"
    assert one.page.locator("#reference").input_value() == "2"  # the last
    assert one.text("#legend").split() == ["box.zarr", "other.zarr"]
    assert "64 samples of box.zarr" in one.text("#headline h2")
    one.waits_for(
        "document.querySelector('#scores').innerText.startsWith('Against reference.exr: MSE ')"
    )
    assert one.page.locator("#errors tr").count() == 3  # a head, and both renders
    assert "its noise stays in the errors" in one.text("#errors .note")
    one.page.locator("h1").click()
    for key, front in (("2", 1), ("ArrowDown", 2), ("ArrowDown", 0), ("ArrowUp", 2), ("1", 0)):
        one.page.keyboard.press(key)
        assert one.page.evaluate(FRONT) == front  # at once
    one.page.keyboard.down("Shift")
    assert one.page.evaluate(FRONT) == 2
    one.page.keyboard.up("Shift")
    assert one.page.evaluate(FRONT) == 0
    busy = """() => {
      const key = { key: "2", code: "Digit2", bubbles: true };
      document.querySelector("h1").dispatchEvent(new KeyboardEvent("keydown", key));
      return document.querySelector("#scores").ariaBusy;
    }"""
    assert one.page.evaluate(busy) == "true"  # the numbers are those of the other image
    one.page.keyboard.press("Shift+Digit1")
    one.waits_for("location.search.includes('i=1') && location.search.includes('ref=0')")
    one.waits_for("document.querySelector('#headline').innerText.includes('of other.zarr')")
    one.waits_for(
        "document.querySelector('#scores').innerText.startsWith('Against box.zarr: MSE ')"
        " && document.querySelector('#scores').ariaBusy === 'false'"
    )
    one.waits_for("!document.querySelector('#compared').hidden")
    assert "other.zarr against box.zarr" in one.text("#compared")
    one.page.keyboard.press("d")
    bar = "document.querySelector('#colorbar').innerText"
    one.waits_for(f"{bar}.includes('shown minus reference')")
    one.page.locator("select[data-option=map]").select_option("contrast:difference")
    one.waits_for(f"{bar}.includes('A box.zarr, B other.zarr.')")
    one.page.keyboard.press("x")  # exchanged
    one.waits_for(f"{bar}.includes('A other.zarr, B box.zarr.')")
    one.page.keyboard.press("3")
    one.page.locator("select[data-option=map]").select_option("image")
    one.page.keyboard.press("s")
    one.waits_for("location.search.includes('side=1')")
    boxes = [figure.bounding_box() for figure in one.page.locator("figure").all()]
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    one.click(5, 6, image=1)
    assert one.chips == ["1: y 5 x 6"]
    assert one.page.evaluate("document.documentElement.scrollWidth") <= 1280
    assert one.page.evaluate(OVERLAPS) == []
    with one.page.expect_download() as coming:
        one.page.locator("[data-export=pdf]").click()
    assert Path(coming.value.path()).read_bytes().startswith(b"%PDF")


def test_images_without_samples_are_looked_at(person, several):
    one = person([several[2], several[2]])
    one.page.goto(one.url + "?map=tail_index")
    assert "needs samples" in one.alert()
    one.waits_for("document.querySelector('main').classList.contains('imageonly')")
    assert one.page.locator("[data-show]").all_inner_texts()[1].endswith("reference.exr (2)")


def test_a_scene_is_sampled_where_it_is_clicked(person):
    one = person("cornell-box", size=(32, 32)).open()
    one.click(20, 10)
    one.page.wait_for_selector("#live:not([hidden])")
    assert one.text("#live span").startswith("2 048 samples")
    one.page.get_by_role("button", name="Draw more").click()
    one.waits_for(
        "parseInt(document.querySelector('#live span').innerText.replace(/\\s/g, '')) > 2048"
    )
    one.page.get_by_role("button", name="Pause").click()
    one.page.wait_for_selector("#live button:text('Draw more')")
    maps = one.page.locator("select[data-option=map]")
    assert maps.locator("option").count() == 1 + len(IMAGES)  # what the image gives
    maps.select_option("relative_error")
    bar = "document.querySelector('#colorbar').innerText"
    one.waits_for(f"{bar}.includes('Standard error over mean (luminance)')")
    assert "sampled where you click" in one.text("#described")
    one.explorer._startup.workspace.sources[0].close()
    one.click(3, 3)
    assert "process that renders" in one.text("#failed")


def test_a_store_deleted_under_the_server_is_a_message(person, own_store):
    one = person(own_store).open()
    one.click(20, 10)
    shutil.rmtree(own_store)
    one.click(3, 3)
    assert "is gone" in one.alert()
    assert "could not be read" in one.text("#failed")
    assert not one.page.locator("#headline").is_visible()  # no numbers of the pixel before
    one.page.reload()
    one.page.wait_for_selector("body[data-shown]")
    assert one.text("h1") == "own.zarr · cornell-box"


def test_a_store_that_is_still_written_grows_on_the_page(person, tmp_path):
    path = tmp_path / "part.zarr"
    job = {"size": (32, 32), "out": path, "backend": "scalar", "progress": False}
    chd.render("cornell-box", spp=64, **job)
    Store.open(path, writable=True).extend(128)
    one = person(path).open("?p=20,10")
    assert "64 of 128 (not finished) spp" in one.text("#described")
    chd.render("cornell-box", spp=128, **job)
    one.waits_for("document.querySelector('#described').innerText.includes('128 spp')")
    one.waits_for("document.querySelector('#headline').innerText.includes('128 samples')")


def test_a_server_that_stops_is_told(person, store_path, explored):
    explorer = explored(store_path)
    sockets = """const Real = WebSocket;
    window.sockets = [];
    window.WebSocket = class extends Real {
      constructor(...given) { super(...given); window.sockets.push(this); }
    }"""
    one = person(explorer)
    one.page.add_init_script(sockets)
    one.open()
    one.page.evaluate("window.before = true; window.sockets[0].close()")
    one.waits_for("!window.before && document.body?.dataset.shown")  # the page loads itself anew
    explorer.stop()
    assert "server has stopped" in one.alert()
    assert one.page.get_by_text("Reconnecting").count() == 0


@pytest.mark.parametrize("theme", ["dark", pytest.param("light", marks=pytest.mark.slow)])
def test_no_state_of_the_page_shuts_anyone_out(browser, explored, several, theme):
    """Rules of axe-core for each state; for colours in both themes see `test_server`, too."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core").Axe()
    with browser.new_context(color_scheme=theme) as context:
        one = Person(context.new_page(), explored(several))
        for query in (
            "?p=20,10&map=diff:signed",
            "?p=5,6&p=8,9&side=1&b=0.5,2",
            "?r=2,2,9,9&map=pattern",
        ):
            one.open(query)
            one.page.get_by_text("All statistics").click()
            one.page.locator("#keys").click()
            found = axe.run(one.page).response["violations"]
            assert [(v["id"], [n["html"] for n in v["nodes"]]) for v in found] == []


def test_nothing_overlaps_or_sticks_out(person, store_path):
    one = person(store_path).open("?p=20,10&p=5,6&p=8,9&map=pattern")
    one.waits_for("document.querySelector('#working').innerText === ''")
    for width in (1280, 1920, 2560):
        one.page.set_viewport_size({"width": width, "height": 900})
        assert one.page.evaluate("document.documentElement.scrollWidth") <= width
        assert one.page.evaluate(OVERLAPS) == []
    # A phone: the image is first, fingers hit what they want, and tables end where the page does.
    for width, height in ((390, 844), (360, 740)):
        one.page.set_viewport_size({"width": width, "height": height})
        one.waits_for(
            "document.querySelector('#controls').contains(document.querySelector('#auto'))"
        )
        image, controls = (one.page.locator(q).bounding_box() for q in (".image", "#controls"))
        assert image["y"] + image["height"] <= min(controls["y"], height)
        for folded in ("#controls", "#drawing", ".tables details"):
            if one.page.locator(folded).get_attribute("open") is None:
                one.page.locator(f"{folded} > summary").click()
        assert one.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert one.page.evaluate(OVERLAPS) == []
        assert one.page.evaluate(SMALL) == []
        for table in one.page.locator(".table:visible").all():
            assert table.evaluate(REACHED)
    one.page.set_viewport_size({"width": 1280, "height": 900})
    one.waits_for("document.querySelector('header').contains(document.querySelector('#theme'))")


SMALL = """() => [...document.querySelectorAll('button, select, summary, label, input[type=range]')]
  .filter((e) => e.tagName !== 'LABEL' || e.closest('fieldset'))
  .filter((e) => e.getClientRects().length && !e.closest('#why'))
  .filter((e) => { const r = e.getBoundingClientRect(); return r.height < 44 || r.width < 44; })
  .map((e) => e.outerHTML.slice(0, 80))"""
"""What is smaller than a finger needs (WCAG 2.2, 2.5.5); links within a sentence may be."""
REACHED = """(e) => {
  const right = (e) => e.getBoundingClientRect().right;
  e.scrollLeft = e.scrollWidth;
  const end = Math.max(0, ...[...e.querySelectorAll('th, td')].map(right)), edge = right(e);
  e.scrollLeft = 0;
  return end <= edge + 1 && edge <= innerWidth && getComputedStyle(e).overflowX === 'auto';
}"""
"""Whether the last column of a table comes into view, within the page."""
OVERLAPS = """() => {
  const parts = [...document.querySelectorAll(
    'header > *, .controls > *, .panel, .tables > .table:not([hidden]), #readout, #chips,'
    + '.image, #colorbar'
  )].filter((e) => e.getClientRects().length && e.innerText !== '');
  const found = [];
  for (const a of parts) for (const b of parts) {
    if (a === b || a.contains(b) || b.contains(a)) continue;
    const [p, q] = [a.getBoundingClientRect(), b.getBoundingClientRect()];
    const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
    const tall = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
    if (wide > 1 && tall > 1) found.push([a, b].map((e) => e.outerHTML.slice(0, 80)));
  }
  return found;
}"""
"""Pairs of parts of the page that lie upon each other."""


def test_headings_axes_and_keys_are_a_readers(person, store_path):
    """Headings say what is shown, axes have round labels, and all is reached with the keyboard."""
    one = person(store_path).open("?p=20,10")
    for button in one.page.locator(".help:visible").all():
        button.click()
        assert len(one.text("#help")) > 100
        one.page.keyboard.press("Escape")
    ticks = (
        "([low, high]) => Bokeh.documents[0].get_model_by_name('running').below[0].ticker"
        ".get_ticks(low, high, null, 0).major"
    )
    for ends, expected in TICKS.items():
        assert one.page.evaluate(ticks, list(ends)) == pytest.approx(expected)
    one.page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    one.page.locator("h1").click()
    seen = []
    for _ in range(60):
        one.page.keyboard.press("Tab")
        seen.append(
            one.page.evaluate(
                """(() => {
                  const e = document.activeElement, d = e.dataset;
                  return d.export ?? d.option ?? d.family ?? d.drag ?? d.zoom
                    ?? (e.className || e.id);
                })()"""
            )
        )
    expected = ["csv", "map", "exposure", "auto", "tone", "image", "pan", "in", "best", "channel"]
    places = [seen.index(name) for name in expected]
    assert places == sorted(places)


def test_keys_do_what_a_mouse_does(person, several):
    """Help takes the focus and gives it back, tables scroll, and a region needs no mouse."""
    one = person(several).open("?p=20,10")
    heading = one.page.locator("#headline h2")
    name = heading.get_attribute("aria-label")
    assert name == heading.locator("span").inner_text()  # without that of its button
    one.page.locator("#patterns .named").first.focus()
    one.page.keyboard.press("Enter")
    assert one.page.evaluate("document.activeElement.id") == "help"
    assert "Set where" in one.text("#help")
    one.page.keyboard.press("Escape")
    assert one.page.evaluate("document.activeElement.className") == "named"
    one.page.keyboard.press("ArrowDown")  # in the table, which scrolls
    assert one.page.evaluate(
        "document.querySelector('figure.front') === document.querySelector('figure')"
    )
    stops = "[...document.querySelectorAll('.image')].map((e) => e.tabIndex)"
    assert one.page.evaluate(stops) == [0, -1, -1]
    one.page.locator(".image").first.focus()
    one.press("n")
    assert one.chips == ["region y 16–24, x 6–14 (9 × 9)"]
    one.press("n")
    assert one.chips == ["1: y 20 x 10"]
    one.press("n")
    one.page.get_by_role("button", name="Drop the region").click()
    one.waits_for("document.body.classList.contains('nothing')")
