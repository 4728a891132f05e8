"""Render tests: a plugin of pytest that contrasts renders with references.

A test asks for the fixture `same_light`, which fails if the means of the render and of its
reference differ. `SameLight` is its type. Nothing heavy is loaded until a test calls it.
"""

from __future__ import annotations

from chdstat.render_tests.plugin import SameLight

__all__ = ["SameLight"]


def __dir__() -> list[str]:
    return sorted(__all__)
