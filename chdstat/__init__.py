"""Look at the sample distributions behind a Monte Carlo image.

The names below are loaded when first used, so that ``import chdstat`` stays light. No function
shares its name with a submodule: importing the submodule would hide the function.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_FUNCTIONS = {
    "Samples": "samples",
    "analyze": "analysis",
    "atlas": "patterns",
    "certified": "certification",
    "classify": "patterns",
    "bench": "studies",
    "compare": "comparison",
    "contrast": "inference",
    "difference": "inference",
    "estimate": "estimators",
    "explore": "explorer",
    "gaussianity": "inference",
    "histogram": "summary",
    "load_scene": "scenes",
    "modality": "inference",
    "open": "samples",
    "record": "recording",
    "render": "rendering",
    "report": "reporting",
    "simulate": "patterns",
    "study": "studies",
    "summarize": "summary",
}
_MODULES = (
    "comparison",
    "errors",
    "estimators",
    "fit",
    "inference",
    "io",
    "patterns",
    "rendering",
    "studies",
    "viz",
)

DOORS = {
    "classified": "patterns.classification",
    "draw": "viz.results",
    "pixel_of": "patterns.pixel",
    "read_reference": "io.reference_files",
    "regions_of": "patterns.pixel",
    "report": "reporting",
    "untrusted": "patterns.classification",
}
"""The module that fills each door of `chdstat._core.doors`: this one stands outside the rings."""

__all__ = ["__version__", *sorted((*_FUNCTIONS, *_MODULES))]


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"chdstat.{_FUNCTIONS[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"chdstat.{name}")
    message = f"module 'chdstat' has no attribute {name!r}"
    raise AttributeError(message)


def __dir__() -> list[str]:
    return __all__
