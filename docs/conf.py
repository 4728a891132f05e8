"""Configuration of the documentation: ``sphinx-build -W -b html docs docs/_build/html``."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from inventories import write_inventories

import chdstat
from chdstat.studies.claims import CLAIMS

os.environ.setdefault("OMP_NUM_THREADS", "1")

project = "chdstat"
author = "The chdstat developers"
copyright = f"2026, {author}"
version = release = chdstat.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.extlinks",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "certified_schema",
    "commands",
    "docstrings",
    "families",
    "paper",
    "figures",
    "formats",
    "listed",
    "markdown",
    "mathml",
    "patterns",
    "public_names",
    "reasons",
    "run",
    "scenes",
]
exclude_patterns = ["_build", "examples"]
default_role = "autolink"
extlinks = {"doi": ("https://doi.org/%s", "doi:%s")}
rst_epilog = f".. |claims| replace:: {len(CLAIMS)}"
smartquotes = False  # they would turn the -- of options into dashes

autodoc_member_order = "bysource"
autodoc_typehints = "none"
templates_path = ["_templates"]
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_aliases = {
    "ndarray": "numpy.ndarray",
    "Axes": "matplotlib.axes.Axes",
    "Figure": "matplotlib.figure.Figure",
    "Path": "pathlib.Path",
}
intersphinx_mapping = write_inventories(Path(__file__).parent / "_build" / "inventories")
intersphinx_timeout = 5

PARTS = ("look", "fit", "test", "compare", "contrast", "studies")
sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "doc_module": "chdstat",
    "backreferences_dir": "gallery/backreferences",
    "filename_pattern": r"plot_",
    "first_notebook_cell": "%matplotlib inline",
    "subsection_order": [f"examples/{part}" for part in PARTS],
    "within_subsection_order": "FileNameSortKey",
    "nested_sections": False,
    "image_scrapers": ("figures.last_figure",),
    "reset_modules": ("matplotlib", "figures.without_progress"),
    "capture_repr": ("_repr_html_", "__repr__"),
    "ignore_repr_types": r"matplotlib\.figure|StyledFigure",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 1,
    "plot_gallery": "True",
    "parallel": 2,
    "thumbnail_size": (480, 320),
}

html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"
html_title = "chdstat"
html_static_path = ["_static"]
html_css_files = ["chdstat.css"]
html_js_files = ["names.js"]
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}
html_sidebars: dict[str, list[str]] = {
    page: []
    for page in (
        "index",
        "tutorial",
        "gallery/**",
        "scenes/**",
        "_modules/**",
        "search",
        "genindex",
    )
}
copybutton_selector = "div:not(.output) > div.highlight > pre"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

warnings.filterwarnings("ignore", message=".*FigureCanvasAgg is non-interactive.*")
