"""The server: who may talk to it, how it starts and stops, and what it refuses."""

from __future__ import annotations

import base64
import contextlib
import http.client
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from urllib.parse import urlsplit

import numpy as np
import pytest
from matplotlib.image import imread

import chdstat as chd
from chdstat.errors import InputError, RenderError, SceneError, StoreError
from chdstat.explorer import explore, server
from chdstat.explorer.panels import (
    BLENDED,
    CHANNEL_COLORS,
    FAINT,
    GROUND,
    LIGHT,
    PIXEL_COLORS,
    TEXT,
)
from chdstat.explorer.server import Startup

STYLE = resources.files("chdstat.explorer") / "web" / "page.css"


def page(url):
    with urllib.request.urlopen(url, timeout=600) as answer:
        return answer.read().decode()


def handshake(explorer, token, origin):
    """Ask for the websocket as a browser would that shows a page of this origin; the status."""
    connection = http.client.HTTPConnection("127.0.0.1", explorer.port, timeout=600)
    headers = {
        "Origin": origin,
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": f"bokeh, {token}",
    }
    with contextlib.closing(connection):
        connection.request("GET", "/ws", headers=headers)
        return connection.getresponse().status


def answered(port, host, path="/progress"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=600)
    with contextlib.closing(connection):
        connection.request("GET", path, headers={"Host": host})
        return connection.getresponse().status


def test_only_names_of_this_machine_are_answered(served):
    port = served.port
    for host in ("127.0.0.1", f"localhost:{port}", "LOCALHOST", f"[::1]:{port}"):
        assert answered(port, host) == 200
    for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "", "["):
        for path in ("/", "/progress", "/ws"):
            assert answered(port, host, path) in (400, 403)


def test_only_pages_of_the_server_may_talk_to_it(served):
    token = page(served.url).split('"token":"')[1].split('"')[0]
    for host in ("127.0.0.1", "localhost"):
        assert handshake(served, token, f"http://{host}:{served.port}") == 101
    for origin in ("http://evil.example", "http://127.0.0.1:1", "http://localhost", "null"):
        assert handshake(served, token, origin) == 403


def test_a_port_that_cannot_be_had_says_so(served, store_path):
    port = served.port
    with pytest.raises(InputError, match=f"{port}.*--port"):
        explore(store_path, port=port)
    for out_of_range in (-1, 65536):
        with pytest.raises(InputError, match="0 and 65535"):
            explore(store_path, port=out_of_range)


def test_only_this_machine_is_served(served):
    with socket.socket() as probe:
        probe.settimeout(1)
        # Another address of the loopback network stands for any other interface.
        assert probe.connect_ex(("127.0.0.2", served.port)) != 0


def test_a_page_that_is_built_holds_up_no_other(served, monkeypatch):
    begun, go_on, build = threading.Event(), threading.Event(), server._open

    def slow(*arguments):
        begun.set()
        assert go_on.wait(600)
        build(*arguments)

    monkeypatch.setattr(server, "_open", slow)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(page, served.url)
        assert begun.wait(600)
        assert "Bokeh" in page(served.url + "static/js/bokeh.min.js")
        assert not waiting.done()
        go_on.set()
        assert "<title>box.zarr" in waiting.result()


def test_until_there_is_an_image_the_page_says_how_far_it_is(monkeypatch):
    """The notice has the name as text, gives way to the page, and is not kept by the browser."""
    begun, go_on, draw = threading.Event(), threading.Event(), Startup.draw

    def slow(self, render):
        begun.set()
        assert go_on.wait(600)
        return draw(self, render)

    monkeypatch.setattr(Startup, "draw", slow)
    opened = []
    monkeypatch.setattr(server.webbrowser, "open", opened.append)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(explore, "cornell-box", size=(16, 12), browser=True)
        assert begun.wait(600)
        (url,) = opened
        with urllib.request.urlopen(url, timeout=600) as answer:
            assert answer.headers["Cache-Control"] == "no-store"
            assert "loading cornell-box</p>" in answer.read().decode()
        expected = {"text": "loading cornell-box", "image": "", "done": False}
        assert json.loads(page(url + "progress")) == expected
        assert answered(urlsplit(url).port, "evil.example", "/") == 403
        go_on.set()
        with waiting.result() as explorer:
            state = json.loads(page(url + "progress"))
            assert state["done"]
            assert state["image"]
            assert '"token":"' in page(explorer.url)


def test_a_source_that_cannot_be_opened_frees_the_port(store_path):
    before = set(threading.enumerate())
    with pytest.raises(StoreError):
        explore([store_path, "no such store"])
    with pytest.raises((SceneError, RenderError)):
        explore({"type": "scene", "shape": {"type": "no such shape"}})
    left = [t for t in set(threading.enumerate()) - before if "chdstat-explorer" in t.name]
    assert not left


def test_a_page_needs_nothing_from_the_net(served):
    found = page(served.url)
    assert "https://" not in found.replace("https://bokeh", "")
    assert "cdn" not in found


def test_the_page_has_a_coarse_image_before_its_socket(explored):
    """Left black, right bright; none for a part of the image or a map, which look different."""
    x = np.zeros((100, 200, 3, 2), np.float32)
    x[:, 100:] = 1
    url = explored(chd.Samples.from_array(x, axes="yxcs")).url
    coarse = page(url).split("url(data:image/png;base64,")
    assert len(coarse) == 2
    image = imread(io.BytesIO(base64.b64decode(coarse[1].split(")")[0])))
    assert image.shape == (50, 100, 3)
    assert image[:, :50, :3].max() == 0
    assert image[:, 50:].min() > 0.8
    for query in ("?z=0,0,10,10", "?map=null_share"):
        assert "url(data:image/png" not in page(url + query)


def test_names_cannot_become_markup(explored):
    samples = chd.Samples.from_array(np.ones((4, 4, 3, 8)), scene="<img src=x onerror=alert(1)>")
    found = page(explored(samples).url)
    assert "<img src=x" not in found
    assert "&lt;img src=x" in found


def test_it_stops_and_frees_its_port_and_threads(store_path):
    before = set(threading.enumerate())
    with explore(store_path) as explorer:
        port = explorer.port
        assert "at http://127.0.0.1" in repr(explorer)
        assert f"http://127.0.0.1:{port}/" in explorer._repr_html_()
        page(explorer.url)
    assert "stopped" in repr(explorer)
    explorer.stop()
    with explore(store_path, port=port) as again:
        assert again.port == port
    left = [t for t in set(threading.enumerate()) - before if t.name.startswith("chdstat")]
    for thread in left:
        thread.join(timeout=600)
    assert not [t for t in left if t.is_alive()]


def test_stores_that_do_not_fit_are_refused(store_path):
    other = chd.Samples.from_array(np.ones((4, 4, 3, 8)))
    with pytest.raises(InputError, match="32 x 32.*4 x 4"):
        explore([store_path, other])
    with pytest.raises(InputError, match="1 or 3 .*2"):
        explore(chd.Samples.from_array(np.ones((4, 4, 2, 8))))
    with pytest.raises(InputError, match="from 1 to 9"):
        explore([store_path] * 10)
    with pytest.raises(StoreError, match="no EXR file"):
        explore([store_path, store_path.with_name("none.exr")])


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_signal_ends_it_cleanly(store_path, number):
    code = (
        "import sys\nfrom chdstat.explorer import explore\nexplorer = explore(sys.argv[1])\n"
        "print(explorer.url, flush=True)\nexplorer.wait()\nprint('over')"
    )
    command = [sys.executable, "-c", code, str(store_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        url = p.stdout.readline().strip()
        page(url)
        os.kill(p.pid, number)
        out, err = p.communicate(timeout=600)
    assert (p.returncode, out.strip(), err) == (0, "over", "")


# --- the look -----------------------------------------------------------------------------------


def contrast(one, other):
    """Return the contrast ratio of two colours (WCAG 2.2, relative luminance)."""
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def luminance(color):
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return sum(w * p for w, p in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def test_colors_contrast_with_the_ground_in_both_themes():
    named = {BLENDED, *CHANNEL_COLORS.values(), *PIXEL_COLORS}
    assert contrast("#000000", "#ffffff") == pytest.approx(21)  # the known answer
    assert set(LIGHT) == named
    assert min(contrast(color, GROUND) for color in (TEXT, FAINT, *named)) >= 4.5
    assert min(contrast(color, "#ffffff") for color in LIGHT.values()) >= 4.5


@pytest.mark.parametrize("theme", [1, 2])
def test_text_contrasts_with_what_is_behind_it(theme):
    rules = dict(
        part.strip().removeprefix("--").split(": ")
        for part in STYLE.read_text().split("{")[theme].split("}")[0].split(";")
        if part.strip().startswith("--")
    )
    for text in ("text", "faint", "accent", "alert"):
        for ground in ("ground", "panel", "raised"):
            assert contrast(rules[text], rules[ground]) >= 4.5
    assert contrast(rules["alert"], rules["warn"]) >= 4.5
    assert contrast(rules["text"], rules["pressed"]) >= 4.5  # a pressed button
    assert contrast(rules["edge"], rules["raised"]) >= 3  # the border of a control
