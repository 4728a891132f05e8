"""What a page shows, as a value: selections, addresses, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from urllib.parse import parse_qs

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chdstat.errors import InputError
from chdstat.explorer.address import (
    BATCH_SIZES,
    FITS,
    MOST_PIXELS,
    TONES,
    View,
    box_between,
    parse_view,
)

HEIGHT, WIDTH = 20, 30

pixels = st.tuples(st.integers(0, HEIGHT - 1), st.integers(0, WIDTH - 1))


@st.composite
def views(draw):
    view = View()
    for y, x in draw(st.lists(pixels, unique=True, max_size=MOST_PIXELS)):
        view = view.pick(y, x, add=True)
    return replace(
        view.activate(draw(st.integers(0, 5))),
        families=tuple(f for f in FITS if draw(st.booleans())) or ("best",),
        batch=draw(st.sampled_from(BATCH_SIZES)),
        exposure=draw(st.none() | st.floats(-10, 10)),
        tone=draw(st.sampled_from(TONES)),
        gamma=draw(st.floats(0.1, 10)),
        shown=draw(st.integers(0, 8)),
        reference=draw(st.none() | st.integers(0, 8)),
        channel=draw(st.sampled_from(["all", "luminance", "0", "2"])),
        map=draw(st.sampled_from(["image", "null_share", "tail_index"])),
        limits=draw(st.none() | st.sampled_from([(0.0, 1.5), (-2.25, -1e-9)])),
    )


@given(views())
def test_an_address_gives_the_view_back(view):
    assert parse_view(parse_qs(view.query()), HEIGHT, WIDTH) == (view, [])


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("p=20,0", "outside the image of 30 x 20 pixels"),
        ("p=-1,0", "expected 2 whole number"),
        ("p=1", "expected 2 whole number"),
        ("p=1,99999999999999999999", "at most 9 digits"),
        ("r=0,0,21,5", "not inside the image"),
        ("r=5,5,5,9", "not inside the image"),
        ("n=33", "batch must be one of"),
        ("f=normal", "families must be one of"),
        ("ev=bright", "number of stops"),
        ("lim=1,0", "the smaller first"),
        ("lim=1", "the smaller first"),
        ("lim=a,b", "limits must be numbers"),
        ("ev=nan", "from -32 to 32 stops"),
        ("ev=1e9", "from -32 to 32 stops"),
        ("g=0", "from 0.1 to 10"),
        ("i=9", "shown must be one of 0, 1,"),
        ("tone=none", "tone must be one of"),
        ("c=alpha", "channel must be one of"),
        ("map=<script>", "no option 'map'"),
        ("store=/etc/passwd", "'store', which means nothing here"),
    ],
)
def test_what_an_address_cannot_ask_for_is_said_and_left_out(query, said):
    view, notes = parse_view(parse_qs(query), HEIGHT, WIDTH)
    assert view == View()
    assert len(notes) == 1
    assert said in notes[0]


def test_selections_replace_add_and_drop():
    view = View().pick(1, 1).pick(2, 2, add=True).pick(1, 1, add=True)
    assert (view.pixels, view.active) == (((2, 2),), 0)
    view = View().box((0, 0, 4, 4)).pick(3, 3)
    assert (view.pixels, view.region) == (((3, 3),), None)
    assert View().box((4, 5, 5, 6)).pixels == ((4, 5),)
    view = View()
    for i in range(MOST_PIXELS):
        view = view.pick(0, i, add=True)
    with pytest.raises(InputError, match="at most 6"):
        view.pick(1, 1, add=True)


def test_moves_stay_inside_and_apart():
    view = View().pick(0, 0).pick(0, 1, add=True)
    size = HEIGHT, WIDTH
    assert view.move(0, -1, *size) == view  # onto the other one
    assert view.move(-1, 0, *size) == view
    assert view.move(99, 99, *size).pixels == ((0, 0), (19, 29))
    assert View().move(1, 1, *size).pixels == ((10, 15),)  # from nothing to the centre
    assert View().box((0, 0, 2, 3)).drop(0) == View()


@pytest.mark.parametrize("option", ["pixels", "active", "region", "nonsense"])
def test_only_options_can_be_set(option):
    with pytest.raises(InputError, match="no option"):
        View().changed(option, "1")


@given(st.tuples(*[st.floats(-50, 50)] * 4))
def test_a_drawn_box_has_whole_pixels_of_the_image_or_is_refused(corners):
    one, other = corners[:2], corners[2:]
    try:
        top, left, bottom, right = box_between(one, other, HEIGHT, WIDTH)
    except InputError:
        return
    assert 0 <= top < bottom <= HEIGHT
    assert 0 <= left < right <= WIDTH
    assert box_between(other, one, HEIGHT, WIDTH) == (top, left, bottom, right)
