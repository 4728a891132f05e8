"""Regions: pixels of an image side by side, as a figure and a table."""

from __future__ import annotations

import numpy as np

import chdstat as chd
from chdstat.viz.results import panel_of
from tests.viz.figures import texts

X = np.random.default_rng(0).lognormal(size=(10, 12, 3, 128))
X[:, :6] *= np.random.default_rng(1).random((10, 6, 1, 128)) < 0.1
SAMPLES = chd.Samples.from_array(X, scene="hall")


def test_a_region_study_is_one_figure_and_one_table():
    study = SAMPLES.regions({"dark & old wall": (4, 2), "floor": (9, 11)})
    figure = study.plot(width="column", scales="log")
    assert figure.get_figwidth() == 3.4
    assert texts(figure) >= {"1 dark & old wall", "2 floor", "null-heavy", "1", "2"}
    begin, _, head, _, first, second, *_ = study.to_latex().splitlines()
    assert begin == r"\begin{tabular}{lrrrrrrr}"
    assert head.count(" & ") == first.replace(r"\&", "").count(" & ") == 7
    assert first.startswith(r"dark \& old wall & 4, 2 & null-heavy & ")
    pixel = study.pixels["floor"]
    mean = max(pixel.radiance.mean(axis=-1, dtype=float))
    assert f"& {mean:.2f} $\\pm$" in second


def test_without_places_there_is_one_for_each_pattern():
    labels = chd.classify(SAMPLES, progress=False)["label"]
    study = SAMPLES.regions()
    assert len(study.pixels) == len(np.unique(labels))


def test_curves_of_several_modes_are_mixtures():
    """For regions of a report and of a notebook alike; few positive samples have none."""
    rng = np.random.default_rng(1)
    x = rng.lognormal(size=(2, 2, 3, 256))
    x[0] *= np.where(rng.random((2, 1, 256)) < 0.5, 100, 1)
    x[1, 1, :, 12:] = 0
    samples = chd.Samples.from_array(x)
    pixels = [samples.pixel(*place) for place in ((0, 0), (1, 0), (1, 1))]
    assert [pixel.curve and pixel.curve.name for pixel in pixels] == [
        *("lognormal_mixture", "lognormal"),
        None,
    ]
    assert all(panel_of(pixel, "wall").select("luminance").fits[0] for pixel in pixels[:2])
    grey = chd.Samples.from_array(x[:, :, :1]).pixel(0, 0)
    assert "mixture" in panel_of(grey, "wall").note
