"""Inventories of what these pages link to elsewhere, so that links hold without a network too.

Sphinx takes the full inventory of a project where it can be fetched, and else the one made here.
Only names that pages or docstrings refer to need a row.
"""

from __future__ import annotations

import zlib
from pathlib import Path

__all__ = ["write_inventories"]

_PROJECTS = {
    "python": (
        "https://docs.python.org/3/",
        {
            "pathlib.Path": ("class", "library/pathlib.html#$"),
            "bool": ("class", "library/functions.html#$"),
            "dict": ("class", "library/stdtypes.html#$"),
            "float": ("class", "library/functions.html#$"),
            "int": ("class", "library/functions.html#$"),
            "list": ("class", "library/stdtypes.html#$"),
            "str": ("class", "library/stdtypes.html#$"),
            "tuple": ("class", "library/stdtypes.html#$"),
        },
    ),
    "numpy": (
        "https://numpy.org/doc/stable/",
        {
            "numpy.load": ("function", "reference/generated/$.html#$"),
            "numpy.ndarray": ("class", "reference/generated/$.html#$"),
            "numpy.random.Generator": ("class", "reference/random/generator.html#$"),
            "numpy.save": ("function", "reference/generated/$.html#$"),
        },
    ),
    "scipy": (
        "https://docs.scipy.org/doc/scipy/",
        {"scipy.stats.false_discovery_control": ("function", "reference/generated/$.html#$")},
    ),
    "sklearn": (
        "https://scikit-learn.org/stable/",
        {"sklearn.mixture.GaussianMixture": ("class", "modules/generated/$.html#$")},
    ),
    "xarray": (
        "https://docs.xarray.dev/en/stable/",
        {
            "xarray.DataArray": ("class", "generated/$.html#$"),
            "xarray.Dataset": ("class", "generated/$.html#$"),
        },
    ),
    "matplotlib": (
        "https://matplotlib.org/stable/",
        {
            "matplotlib.axes.Axes": ("class", "api/_as_gen/$.html#$"),
            "matplotlib.figure.Figure": ("class", "api/_as_gen/$.html#$"),
        },
    ),
    "torch": (
        "https://docs.pytorch.org/docs/stable/",
        {"torch.optim.Adam": ("class", "generated/$.html#$")},
    ),
}


def write_inventories(folder: Path) -> dict[str, tuple[str, tuple[str | None, str]]]:
    """Write the inventories, and return what ``intersphinx_mapping`` should be."""
    folder.mkdir(parents=True, exist_ok=True)
    mapping = {}
    for project, (url, names) in _PROJECTS.items():
        lines = [
            f"{name} py:{kind} 1 {page.replace('$', name)} -\n"
            for name, (kind, page) in names.items()
        ]
        head = (
            f"# Sphinx inventory version 2\n# Project: {project}\n# Version: \n"
            "# The remainder of this file is compressed using zlib.\n"
        )
        path = folder / f"{project}.inv"
        path.write_bytes(head.encode() + zlib.compress("".join(lines).encode()))
        mapping[project] = (url, (None, str(path)))
    return mapping
