"""Commands that no page of ours sends: answered with a message, none with a traceback."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from bokeh.document import Document

from chdstat.explorer.address import View
from chdstat.explorer.session import Session
from chdstat.explorer.workspace import opened

ODD = [
    None,
    True,
    -1,
    10**30,
    float("inf"),
    float("nan"),
    1.5,
    "",
    "²",
    "99999",
    "x" * 1000,
    [],
    [None],
    {},
]


@pytest.fixture(scope="module")
def session(store_path: Path) -> Iterator[Session]:
    shared = opened([store_path, store_path])
    yield Session(Document(), shared, {})
    shared.stop()


def said(session: Session, monkeypatch: pytest.MonkeyPatch, text: str) -> list[str]:
    """Send a text as a page would, and return the alerts."""
    alerts: list[str] = []
    monkeypatch.setattr(session._page, "alert", alerts.append)
    session._received("value", "", text)
    return alerts


def test_options_of_any_value_are_set_or_refused_in_words(session, monkeypatch):
    for option, value in itertools.product([f.name for f in fields(View)] + ["none"], ODD):
        command = {"command": "set", "seq": 1, "option": option, "value": value}
        said(session, monkeypatch, json.dumps(command))
    for value in (None, "99999", "²", 3):
        command = {"command": "set", "seq": 1, "option": "channel", "value": value}
        (alert,) = said(session, monkeypatch, json.dumps(command))
        assert alert.startswith("channel must be one of all, ")


@pytest.mark.parametrize("name", [n[4:] for n in dir(Session) if n.startswith("_on_")])
def test_commands_with_any_arguments_are_answered(session, monkeypatch, name):
    for key, value in itertools.product(["y", "box", "index", "dy", "on", "format"], ODD):
        command: dict[str, Any] = {"command": name, "seq": 1, key: value}
        said(session, monkeypatch, json.dumps(command))
        said(session, monkeypatch, json.dumps(command | {"x": value, "dx": value}))
