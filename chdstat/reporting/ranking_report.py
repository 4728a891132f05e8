"""Ranking report: several renders of a view as a short PDF, by their noise.

It says whether the means agree, which render is noisier, where in the image each is the least
noisy, which patterns hold the noise, and what differs in how the renders were made.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chdstat import viz
from chdstat._core.display import capital, percent
from chdstat._core.doors import report
from chdstat._core.resampling import Interval
from chdstat.errors import InputError
from chdstat.inference import Contrasts
from chdstat.inference.noise_rankings import TIMING, NoiseRanking
from chdstat.patterns import Label
from chdstat.reporting.documents import Document, typeset
from chdstat.viz.maps import LABEL_COLORS
from chdstat.viz.styling import called


def _ranking_document(found: Contrasts) -> Document:
    """Return several renders, ready to typeset.

    Raises
    ------
    InputError
        If they are not ranked by their noise.
    """
    noise = found.noise
    if noise is None:
        message = (
            "a report needs renders that are ranked by their noise, chdstat.contrast([a, b]), got "
            "contrasts of means alone"
        )
        raise InputError(message)
    sizes, last = noise.maps.sizes, noise.names[-1]
    facts = {capital(n): text for n, text in noise.facts(brief=True).items()}
    orders = {f"At {at}": order.conclusion.partition(", ")[2] for at, order in noise.orders.items()}
    content = {
        "names": noise.names,
        "first": noise.order.names[0],
        "last": last,
        "about": f"{sizes['x']} × {sizes['y']} pixels",
        "findings": {"Means": found.means.removeprefix("Means: "), **orders, **facts},
        "timed": "equal time" in noise.orders,
        "rows": _rows(found, noise),
        "pairs": len(noise.order.ratios),
        "level": percent(noise.level),
        "rate": percent(noise.alpha),
        "timing": TIMING,
        "causes": _explanations(noise),
        "magnified": ("", ", with one part magnified", ", with two parts magnified")[
            len(noise.examples)
        ],
        "settings": [{"name": name, "values": values} for name, values in noise.settings.items()],
    }
    return Document("ranking_report.typ", content, {"renders": viz.contrast(found)})


def _rows(found: Contrasts, noise: NoiseRanking) -> list[dict[str, str]]:
    """Return a row for each render, the least noisy first."""
    rows = []
    for words in noise.in_words():
        name = words["render"]
        mean = "1" if name == noise.names[-1] else _difference(found[name].loss)
        pixels, _ = noise.wins()[name]
        row = {
            "mean": mean,
            "pixels": percent(pixels),
            "doubtful": percent(noise.doubtful.get(name, np.nan)),
        }
        rows.append(words | row)
    return rows


def _difference(loss: Interval[float]) -> str:
    """Return how much brighter than the last render one is, given how much darker the last is."""
    with np.errstate(all="ignore"):
        value, low, high = 1 / (1 - np.array([loss.value, loss.low, loss.high])) - 1
    return Interval(value, low, high).shown(partial(percent, sign=True))


def _explanations(noise: NoiseRanking) -> list[dict[str, str]]:
    """Return a row for each pattern that holds noise of a render; the first says what it means."""
    patterns = [cause.pattern for cause in noise.causes]
    return [
        {
            "render": cause.name,
            "pattern": called(cause.pattern),
            "color": LABEL_COLORS[called(cause.pattern)],
            "pixels": percent(cause.pixels),
            "share": cause.share.shown(percent),
            "ratio": str(cause.ratio),
            "null": percent(0) if cause.without_nulls else cause.null_share.shown(percent),
            "least_null": percent(cause.least_null_share),
            "meaning": Label[cause.pattern.upper()].meaning
            if patterns.index(cause.pattern) == i
            else "",
        }
        for i, cause in enumerate(noise.causes)
    ]


def _write(found: Contrasts, target: Path, **_: Any) -> Path:
    return typeset(_ranking_document(found), target)


report.register(Contrasts, _write)
