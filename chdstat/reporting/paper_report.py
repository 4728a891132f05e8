"""Report on the paper's experiment: all of its figures and tables, as a PDF.

`FIGURES` is the table of the figures, in the order and with the numbers of Elek, Thomas and Forbes
2019.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from chdstat import viz
from chdstat._core.arrays import Array, generator, is_bad
from chdstat._core.display import number, percent
from chdstat._core.doors import report
from chdstat._core.image_scales import worst_parts
from chdstat.estimators.elek2019 import CHOICES, PAPER, as_published
from chdstat.reporting.content import remake_note
from chdstat.reporting.documents import Document, overview, typeset
from chdstat.reporting.figures import batches_of, depth_of, marks_of
from chdstat.scenes import BUILTIN
from chdstat.studies.claims import CLAIMS
from chdstat.studies.paper_numbers import SENTENCES, firefly, numbers
from chdstat.studies.paper_study import (
    BATCH,
    PIXELS,
    PUBLISHED,
    RESULTS,
    SCENES,
    PaperScene,
    PaperStudy,
    shown,
)
from chdstat.studies.studies import ACROSS
from chdstat.viz import VERDICTS
from chdstat.viz.styling import panels_in

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COMPARED = 3
"""Regions whose CHDs of shorter and of longer paths are compared."""
_RGB = ("R", "G", "B")
_NETWORK = "network, as published"
_KEY = "In colour R, G and B; dashed: means."


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper.

    Attributes
    ----------
    name, number
        Its name here, and its number there.
    draw
        Returns the figure; None if there is nothing to show.
    caption
        What it shows; {here} is what `about` returns.
    of
        Titles of the scenes that it shows, one figure for each; empty for one figure of all.
    """

    name: str
    number: str
    draw: Callable[[Any], Figure | None]
    caption: str
    of: tuple[str, ...] = ()

    def drawn(self, found: PaperStudy) -> Iterator[tuple[dict[str, str], Figure]]:
        """Yield figures, with where they belong and their captions."""
        scenes = [scene for scene in found.scenes if scene.title in self.of]
        for part in scenes if self.of else [found]:
            figure = self.draw(part)
            if figure is None:
                continue
            title = f"{self.name}-{part.title}" if isinstance(part, PaperScene) else self.name
            here = {"name": _named(part)}
            if isinstance(part, PaperScene):
                here |= {"own": firefly(0)(part), "above": firefly(1)(part)}
            place = {"number": self.number, "caption": self.caption.format(**here)}
            yield {"name": title, **place}, figure


def _named(part: Any) -> str:
    """Return the name of a scene, and of the paper's if it is a remake."""
    if not isinstance(part, PaperScene):
        return ""
    name = part.study.name
    return f"{name}, in place of {part.title}" if name in BUILTIN else part.title


def _first(found: PaperStudy) -> Figure:
    """Draw batches of random pixels of the first scene."""
    data = found.scenes[0].study.data
    width = data.samples.shape[1]
    lit = np.flatnonzero(data.summary["luminance_mean"].to_numpy() > 0)
    drawn = np.sort(generator(0).permutation(lit)[:PIXELS])
    places = [(int(i) // width, int(i) % width) for i in drawn]
    marks = [viz.Mark(f"({x}, {y})", slice(y, y + 1), slice(x, x + 1), (y, x)) for y, x in places]
    batches = [batches_of(data.samples[place]) for place in places]
    return viz.batches_of_pixels(data.summary["mean"].values, marks, batches)


def _scenes(found: PaperStudy) -> Figure:
    return overview(found.study)


def _study(scene: PaperScene) -> Figure | None:
    """Draw the regions of a scene with their CHDs, as printed."""
    data = scene.study.data
    if not data.regions:
        return None
    marks = marks_of(data)
    panels = [_panel(data.samples[mark.pixel], mark.name, data.samples.channels) for mark in marks]
    return _regions(data.summary["mean"].values, marks, panels)


def _panel(x: Array, name: str, channels: tuple[str, ...]) -> viz.Panel:
    """Return the CHD of a pixel from samples (channel, sample) without bad ones."""
    return viz.Panel.as_printed(name, x[:, ~is_bad(x).any(axis=0)], channels=channels)


def _regions(image: Array, marks: list[viz.Mark], panels: list[viz.Panel]) -> Figure:
    channels = _RGB if tuple(panels[0].channels or ()) == _RGB else None
    return viz.region_study(image, marks, panels, channels=channels, scales=("linear", "log"))


def _firefly(scene: PaperScene) -> Figure | None:
    """Draw the brightest firefly and the pixel above it, in the estimate in which it is seen."""
    found = scene.firefly()
    if found is None:
        return None
    y, x, batch = found
    data = scene.study.data
    image = data.summary["batch_means"].values[..., batch]
    marks, panels = [], []
    for name, row in (("firefly", y), ("its neighbour", y - 1)):
        marks.append(viz.Mark(name, slice(row, row + 1), slice(x, x + 1), (row, x)))
        panels.append(_panel(data.samples[row, x], name, data.samples.channels))
    return _regions(image, marks, panels)


def _images_of_paths(scene: PaperScene) -> Figure | None:
    data = scene.study.data
    if data.shorter is None or data.shorter_summary is None:
        return None
    renders = (data.shorter, data.shorter_summary), (data.samples, data.summary)
    images = {
        f"up to {depth_of(samples)} segments, {samples.spp} spp": found["mean"].values
        for samples, found in renders
    }
    return viz.side_by_side(images, width=4.4)


def _paths(scene: PaperScene) -> Figure | None:
    """Draw CHDs of the same pixels with shorter and with longer paths."""
    data = scene.study.data
    if data.shorter is None or not data.regions:
        return None
    marks = marks_of(data)[:_COMPARED]
    panels = [
        _panel(samples[mark.pixel], f"{mark.name}, {words}", samples.channels)
        for mark in marks
        for words, samples in (("shorter", data.shorter), ("longer", data.samples))
    ]
    colors = [color for color in viz.PALETTE[: len(marks)] for _ in range(2)]
    return viz.chd_grid(panels, columns=2, colors=colors)


def _reduction(scene: PaperScene) -> Figure:
    images: dict[str, Any] = {f"baseline, {BATCH} spp": scene.mean}
    images[_network_name(scene)] = scene.network.estimate
    truth = {f"ground truth, {scene.samples.spp} spp": scene.truth}
    return viz.side_by_side({**images, **truth}, insets=worst_parts(scene.mean, scene.truth))


def _network_name(scene: PaperScene) -> str:
    return "network with changes" if scene.changed else _NETWORK


def _losses(found: PaperStudy) -> Figure | None:
    scenes = [scene for scene in found.scenes if scene.title in RESULTS]
    if not scenes:
        return None
    with viz.style():
        figure, axes = panels_in(None, len(scenes), len(scenes), 2.4)
        for ax, scene in zip(axes, scenes, strict=True):
            viz.training(scene.network.losses, ax=ax)
            ax.set_title(scene.title, loc="left", pad=34)
    return figure


def _evaluation(scene: PaperScene) -> Figure:
    return cast("Figure", viz.pixel_estimates(scene.drawn_pixels()).figure)


FIGURES = (
    PaperFigure("batches", "1", _first, f"Luminance of {PIXELS} random pixels of the first scene: "
                f"superimposed batches of {BATCH} samples (top; black: their average), and the "
                "means of the batches (bottom). Dashed: the mean of all batches. The axis ends "
                "where 1 % of the samples are brighter."),
    PaperFigure("scenes", "2", _scenes, "The scenes of the study, each under its own exposure."),
    *(
        PaperFigure(f"study{i}", str(3 + i), _study, "Study of {name}: regions of interest and the "
                    "pixel whose distribution is shown; 100 linear bins on the range of its first "
                    "50 samples padded by a quarter, 100 logarithmic ones from 1e−5 to 1e5; nulls "
                    f"apart. {_KEY}", (title,))
        for i, title in enumerate(SCENES)
    ),
    PaperFigure("firefly", "6", _firefly, "Firefly of {name}: the brightest one, of RGB irradiance "
                "{own} in the estimate from 32 samples that is shown, and the pixel above it, of "
                f"{{above}}; their distributions are of all samples. {_KEY}", ("MeasureOne",)),
    PaperFigure("depths", "6", _images_of_paths, "Path lengths of {name}: two bounces, and five, "
                "under one exposure.", ("MeasureOne",)),
    PaperFigure("paths", "6", _paths, "Path lengths of {name}: distributions of the same pixels, "
                f"two bounces (left) and five (right). {_KEY}", ("MeasureOne",)),
    PaperFigure("reduction", "7", _reduction, "Variance reduction in {name}: mean, network and "
                "ground truth under one exposure; frames mark where the mean is furthest too "
                "bright.", RESULTS),
    PaperFigure("losses", "8", _losses, "Losses over the training, against the error of the "
                "sample mean on the same batches (dashed)."),
    PaperFigure("evaluation", "9", _evaluation, "Numerical evaluation in {name}: ground truth "
                "(bars), sample mean (rings) and network; random pixels from dark to bright, "
                "luminance.", RESULTS),
)  # fmt: skip
"""Figures of the paper."""


# --- tables ---------------------------------------------------------------------------------------


def _errors(found: PaperStudy) -> list[dict[str, str]]:
    """Return the table of errors."""
    return [
        {
            **{name: row[name] for name in ("scene", "network", "judged")},
            "mse": shown(row, "mse_ratio", number),
            "relmse": shown(row, "relmse_ratio", number),
            "improved": shown(row, "improved", percent),
            "fireflies": shown(row, "fireflies_left", percent),
        }
        for row in found.table()
    ]


def _verdicts(found: PaperStudy) -> list[dict[str, Any]]:
    """Return each sentence of the paper with its verdict in every scene."""
    rows = []
    for claim in CLAIMS:
        if claim.number not in SENTENCES:
            continue
        section, sentence = SENTENCES[claim.number]
        columns: Mapping[str, str | None] = (
            {ACROSS: None} if claim.across else {name: name for name in found.study.names}
        )
        cells: dict[str, list[str]] = {}
        for column, name in columns.items():
            finding = found.study.finding(claim.number, name)
            if finding is not None:
                cells.setdefault(finding.verdict, []).append(column)
        rows.append({
            "number": str(claim.number),
            "name": claim.name,
            "section": section,
            "sentence": sentence,
            "claim": claim.claim,
            "cells": [{"verdict": verdict, "scenes": ", ".join(names)}
                      for verdict, names in cells.items()],
        })  # fmt: skip
    return rows


def _choices(found: PaperStudy) -> list[dict[str, str]]:
    """Return what may differ from the paper, and whether it does in this run."""
    return [
        {
            "name": choice.name,
            "paper": choice.paper,
            "other": choice.other,
            "state": "changed" if choice.name in found.changed else "as published",
            "ours": "differs" if choice.ours else "as published",
        }
        for choice in CHOICES.values()
    ]


def _left_open() -> str:
    """Return what the paper does not say of its network and its training, as it is here."""
    config = as_published()
    return (
        f"ReLU between layers, minibatches of {config.minibatch} rows, {config.optimiser.title()}, "
        f"{config.initialisation.replace('he', 'He')} first weights, and radiance over its "
        f"{config.scaling}"
    )


def _scale(found: PaperStudy) -> list[str]:
    """Return in which ways the experiment is smaller than the paper's."""
    scale, there = found.scale, []
    for name, words in (("edge", "pixels along the longer edge"), ("spp", "samples per pixel"),
                        ("iterations", "minibatches of a training")):  # fmt: skip
        one, other = getattr(scale, name), getattr(PUBLISHED, name)
        if one != other:
            there.append(f"{one} {words} in place of {other} (`--{name} {other}`)")
    return there


def paper_document(found: PaperStudy) -> Document:
    """Return the experiment, ready to typeset."""
    drawn: dict[str, Figure] = {}
    placed = []
    for one in FIGURES:
        for place, figure in one.drawn(found):
            placed.append(place)
            drawn[place["name"]] = figure
    content = {
        "placed": placed,
        "errors": _errors(found),
        "numbers": numbers(found),
        "verdicts": VERDICTS,
        "sentences": _verdicts(found),
        "choices": _choices(found),
        "changed": list(found.changed),
        "open": _left_open(),
        "scale": _scale(found),
        "network": PAPER,
        "remakes": remake_note(scene.samples for scene in found.scenes),
        "missing": "MeasureOne" if any(s.title == "MeasureOne" for s in found.scenes) else "",
        "provenance": {k: str(v) for k, v in found.study.provenance.items()},
    }
    return Document("paper.typ", content, drawn)


report.register(PaperStudy, lambda found, target: typeset(paper_document(found), target))
