"""The directive ``reason-codes``: a list of the reason codes, made from the code itself."""

from __future__ import annotations

import inspect
import re
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive

from chdstat.errors import Reason

__all__ = ["ReasonCodes"]

_MEMBER = re.compile(r'^    (\w+) = \d+\n(?:    """(.+?)""")?', re.MULTILINE)


class ReasonCodes(Directive):
    """List value, name and meaning of every reason code."""

    def run(self) -> list[nodes.Node]:
        meanings = dict(_MEMBER.findall(inspect.getsource(Reason)))
        items = nodes.bullet_list()
        for code in Reason:
            name = code.name.lower()
            text = meanings[code.name] or "There is a value."
            line = nodes.paragraph(
                "", f"{code.value} ", nodes.literal("", name), nodes.Text(f": {text}")
            )
            items += nodes.list_item("", line)
        return [items]


def setup(app: Any) -> dict[str, bool]:
    app.add_directive("reason-codes", ReasonCodes)
    return {"parallel_read_safe": True}
