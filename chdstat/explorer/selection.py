"""Results of a selection, computed without any page: panels, tables, estimates and files.

Panels come first, as images are looked at first; then tables; then what takes long.
Samples are exported as CSV or npz, figures as PNG or SVG, both together as a PDF page.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from chdstat import viz
from chdstat._core.arrays import take_rows
from chdstat._core.display import percent
from chdstat._core.files import scratch
from chdstat.comparison.tables import notes
from chdstat.explorer import estimators, tables
from chdstat.explorer.panels import panels
from chdstat.explorer.plots import BLENDED, PanelData, series_of
from chdstat.explorer.shared import Shared
from chdstat.explorer.sources import Overall, SceneSource, Source, StoreSource
from chdstat.explorer.statistics import PlaceStatistics, goodness
from chdstat.explorer.tables import Table, columns_of, patterns_table, statistics_table
from chdstat.explorer.view import Box, Pixel, View
from chdstat.inference.differences import Difference, difference
from chdstat.reporting.typst import Document, typeset
from chdstat.viz.estimators import NAMES
from chdstat.viz.styling import spelt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPORTS", "SelectionPlots", "SelectionResults", "exported"]

_KEPT_BYTES = 128 * 2**20


@dataclass(frozen=True)
class SelectionPlots:
    """What a view shows, but for its tables.

    Attributes
    ----------
    view
        The view.
    keys
        (y, x) of pixels, or (top, left, bottom, right) of a region; none where nothing is selected.
    places
        Statistics of each.
    others
        Statistics of the same places of the store that is compared with.
    panels
        What each panel draws, by name.
    legend
        Names and colours of what is drawn.
    live_spp
        Samples of the active pixel where more of them can be drawn, else None.
    """

    view: View
    keys: Sequence[Pixel | Box]
    places: Sequence[PlaceStatistics]
    others: Sequence[PlaceStatistics]
    panels: Mapping[str, PanelData]
    legend: Sequence[tuple[str, str]]
    live_spp: int | None

    @property
    def key(self) -> Pixel | Box:
        """Pixel or region that tables describe."""
        return self.keys[self.view.active]

    @property
    def place(self) -> PlaceStatistics:
        """Statistics of the place that tables describe."""
        return self.places[self.view.active]

    @property
    def title(self) -> str:
        """Name of the place that tables describe, and how many samples it has."""
        samples = f"{self.place.spp:,} samples".replace(",", "\u2009")
        if len(self.key) == 4:
            top, left, bottom, right = self.key
            return f"Region y {top}–{bottom - 1}, x {left}–{right - 1} · {samples}"
        which = f" {self.view.active + 1}" if len(self.places) > 1 else ""
        return f"Pixel{which} · y {self.key[0]}, x {self.key[1]} · {samples}"

    @property
    def n(self) -> int:
        """Samples of an estimate: one alone is no estimate."""
        return max(self.view.batch, 2)


class SelectionResults:
    """Computes results and keeps the statistics of the latest places.

    `plots` is for one thread at a time; the other methods only read what it returned.

    Parameters
    ----------
    shared
        Has the sources, the first of which may grow.
    """

    def __init__(self, shared: Shared) -> None:
        self._shared = shared
        self._places: dict[tuple[int, Pixel | Box], PlaceStatistics] = {}

    def plots(self, view: View) -> SelectionPlots:
        """Return what the panels of a view show.

        Raises
        ------
        InputError
            If a pixel is outside the image.
        StoreError
            If a store is damaged or gone.
        """
        source, other = self._shared.source, self._shared.other
        keys: list[Pixel | Box] = list(view.pixels) if view.region is None else [view.region]
        places = [self._statistics(source, 0, key) for key in keys]
        others = [] if other is None else [self._statistics(other, 1, key) for key in keys]
        series = series_of(view, places, others)
        legend = [(s.name, s.color) for s in series if not s.other]
        if other is not None:
            legend.append((f"dashed: {other.name}", BLENDED))
        live = isinstance(source, SceneSource) and bool(view.pixels)
        live_spp = places[view.active].spp if live else None
        return SelectionPlots(view, keys, places, others, panels(view, series), legend, live_spp)

    def describe(
        self, plots: SelectionPlots
    ) -> tuple[dict[str, Table], list[estimators.ScoredEstimate]]:
        """Return the tables of the active place by name, and the estimates of quick estimators."""
        if not plots.places:
            return {}, []
        place, batches = plots.place, self._batches(plots)
        quick = estimators.scored(batches, names=estimators.quick_names()) if batches else []
        columns = tables.columns_of(plots.places, plots.view.channel)
        found = {
            "statistics": tables.statistics_table(columns),
            "patterns": tables.patterns_table(columns),
            "estimates": self._estimates_table(plots, quick),
        }
        for name, title, rows in self._light(plots.key):
            found[name] = self._of(plots, tables.light_table(title, rows))
        if self._shared.other is not None:
            apart = self._difference(plots.key, place, plots.others[plots.view.active])
            names = (self._shared.source.name, self._shared.other.name)
            found["compared"] = self._of(plots, tables.compared_table(apart, place.channels, names))
        return found, quick

    def _light(self, key: Pixel | Box) -> Iterator[tuple[str, str, list[dict[str, str | float]]]]:
        """Yield name, title and rows of a pixel's light by its parts, as far as they are known."""
        source = self._shared.source
        if len(key) != 2 or not isinstance(source, StoreSource):
            return
        if source.samples.depths or source.samples.lights:
            pixel = source.samples.pixel(*key)
            if pixel.light:
                yield "paths", "Light by length of path", pixel.light
            if pixel.lights:
                yield "lights", "Light by its source", pixel.lights

    def slow_estimates(
        self,
        plots: SelectionPlots,
        quick: Sequence[estimators.ScoredEstimate],
        step: Callable[[], None],
    ) -> Table:
        """Return the table of estimates with the slow ones, and those that look around.

        `step` is called before each of them; whatever it raises ends the computation.
        """
        shared, key, batches = self._shared, plots.key, self._batches(plots)
        if batches is None:
            return self._estimates_table(plots, quick)
        overall = shared.overall
        unit = overall.unit if np.isfinite(overall.mean).any() else None
        store = shared.source if isinstance(shared.source, StoreSource) else None
        slow = estimators.fixed().keys() - estimators.quick_names()
        found = [*quick, *estimators.scored(batches, names=slow, step=step)]
        for learner in shared.learners:
            step()
            learned = learner.score(batches, store, key, unit)
            found += [] if learned is None else [learned]
        if store is None or len(key) != 2:
            return self._estimates_table(plots, found)
        around = estimators.scored_around(batches, store, key, step=step)
        count = estimators.BATCHES_AROUND
        more = f"; {len(around)} look at the pixels around, in {count} batches"
        said = notes([estimate.name for estimate in around])
        more += "".join(f". The {name} is {text}" for name, text in said.items()).rstrip(".")
        return self._estimates_table(plots, [*found, *around], more)

    def goodness(self, plots: SelectionPlots, step: Callable[[float], None]) -> Table:
        """Return the goodness of fit of every family; `step` is called with the share done."""
        return self._of(plots, tables.goodness_table(plots.place, goodness(plots.place, step)))

    def _statistics(self, source: Source, which: int, key: Pixel | Box) -> PlaceStatistics:
        x = source.pixel(*key) if len(key) == 2 else source.region(key)
        found = self._places.pop((which, key), None)
        if found is None or found.spp != x.shape[1]:
            earlier, found = found, PlaceStatistics(x, source.channels)
            if earlier is not None:
                found.take_over(earlier)
        self._places[which, key] = found
        held = sum(place.rows.nbytes for place in self._places.values())
        while len(self._places) > 1 and held > _KEPT_BYTES:  # the oldest goes
            held -= self._places.pop(next(iter(self._places))).rows.nbytes
        return found

    def _difference(
        self, key: Pixel | Box, place: PlaceStatistics, other: PlaceStatistics
    ) -> Difference:
        """Compare a place of the two stores, in pairs where these share random numbers."""
        source, second = self._shared.source, self._shared.other
        one, two = place.samples, other.samples
        if second is None or not isinstance(source, StoreSource):
            return difference(one, two)
        if not source.samples.shares_numbers_with(second.samples):
            return difference(one, two)
        spp = min(source.samples.spp, second.samples.spp)
        if len(key) == 2:
            return difference(one[:, :spp], two[:, :spp], paired=True)
        if one.shape != two.shape:  # as many of each pixel, so that pairs stay together
            one, two = source.region(key, spp), second.region(key, spp)
        return difference(one, two, paired=True)

    def _reference(self) -> tuple[StoreSource | None, int]:
        """Return the reference and its first sample with random numbers of its own; None if none.

        In a reference of the seed of the source, the noise of those before is that of the source:
        errors against them would be too small.
        """
        source, reference = self._shared.source, self._shared.reference
        if reference is None:
            return None, 0
        samples = reference.samples
        first = 0
        if isinstance(source, StoreSource) and source.samples.shares_numbers_with(samples):
            first = source.samples.spp
        return (reference, first) if first < samples.spp else (None, 0)

    def _batches(self, plots: SelectionPlots) -> estimators.ScoringBatches | None:
        """Return the batches of the active place, which are scored against the reference."""
        place, key, truth = plots.place, plots.key, None
        reference, first = self._reference()
        if reference is not None and len(key) == 2:
            moments = PlaceStatistics(reference.pixel(*key)[:, first:], place.channels).moments
            truth = moments.seen(moments.mean)[: len(place.channels)]
        return estimators.batches_of(place.samples, plots.n, truth)

    def _estimates_table(
        self, plots: SelectionPlots, found: Sequence[estimators.ScoredEstimate], more: str = ""
    ) -> Table:
        note = "error against the mean of the other samples, which no batch contains"
        reference, first = self._reference()
        if reference is not None:
            note = f"error against {reference.name}"
            # The first ones share their random numbers with what is scored.
            note += f" from sample {first} on" if first else ""
        if plots.place.constant.all() and not plots.place.null.any():
            note, more = "the samples are constant: every estimator gives the same", ""
            none = float("nan")
            found = [replace(e, mse_ratio=none, bias=none, improved=none) for e in found]
        table = tables.estimates_table(found, plots.place.channels, plots.n, note + more)
        return self._of(plots, table)

    def _of(self, plots: SelectionPlots, table: Table) -> Table:
        """Return a table that names its pixel, where several are selected."""
        if len(plots.places) < 2:
            return table
        y, x = plots.key[:2]
        return {**table, "title": f"{table['title']}, pixel {plots.view.active + 1}: y {y}, x {x}"}


# --- files --------------------------------------------------------------------------------------

EXPORTS = {
    "csv": "text/csv",
    "npz": "application/octet-stream",
    "png": "image/png",
    "svg": "image/svg+xml",
    "pdf": "application/pdf",
}
"""Media types of the formats of exports."""
_MOST_ROWS = 2**17
"""Lines of a CSV file, as many as a spreadsheet takes."""
_TEMPLATE = "selection.typ"


def exported(
    format: str,  # noqa: A002
    source: str,
    plots: SelectionPlots,
    overall: Overall,
    exposure: float,
    origin: Mapping[str, str | int],
) -> tuple[str, bytes]:
    """Return name and content of a file with the selection.

    Parameters
    ----------
    format
        One of `EXPORTS`.
    source
        Name of the store or scene.
    plots
        The selection.
    overall, exposure
        The image, and the stops that it is shown with.
    origin
        Where the samples come from, as the npz file says: scene, spp, seed.
    """
    kept = "".join(c if c.isalnum() or c in "._" else "-" for c in source)
    keys = ("_".join(map(str, key)) for key in plots.keys)
    stem = "-".join([kept.removesuffix(".zarr") or "selection", *keys])[:80]
    stream = io.BytesIO()
    if format == "csv":
        stream.write(_csv(plots))
    elif format == "npz":
        arrays: dict[str, Any] = {"selection": np.array([str(key) for key in plots.keys])}
        arrays |= {name: np.array(value) for name, value in origin.items()}
        for i, p in enumerate(plots.places):
            arrays |= {f"radiance_{i}": p.samples, f"null_{i}": p.null, f"bad_{i}": p.bad}
        np.savez_compressed(stream, **arrays)
    elif format == "pdf":
        stream.write(_pdf(source, plots, overall, exposure))
    else:
        with viz.style(), spelt():
            metadata = {"Date": None} if format == "svg" else None
            _figure(plots).savefig(stream, format=format, metadata=metadata)
    return f"{stem}.{format}", stream.getvalue()


def _csv(plots: SelectionPlots) -> bytes:
    """Return one line for each sample."""
    lines = [",".join(["y", "x", "sample", *plots.place.channels, "null", "bad"])]
    most = max(1, _MOST_ROWS // len(plots.places))
    for key, place in zip(plots.keys, plots.places, strict=True):
        start = f"{key[0]},{key[1]}" if len(key) == 2 else ","
        for i, values in enumerate(place.samples[:, :most].T):
            numbers = ",".join(np.format_float_scientific(v, trim="-") for v in values)
            lines.append(f"{start},{i},{numbers},{int(place.null[i])},{int(place.bad[i])}")
    return ("\n".join(lines) + "\n").encode("ascii")


def _figure(plots: SelectionPlots) -> Figure:
    family = plots.view.families[0] if plots.view.families else ""
    drawn = []
    for key, place in zip(plots.keys, plots.places, strict=True):
        count = len(place.channels)
        fits = [place.positive(family, row) if family else None for row in range(count)]
        named = dict.fromkeys(NAMES.get(fit[0], fit[0]) for fit in fits if fit is not None)
        panel = viz.Panel(
            name=_mark(key).name,
            linear=take_rows(place.histograms["linear"], slice(count), axis=0),
            log=take_rows(place.histograms["log"], slice(count), axis=0),
            channels=place.channels,
            fits=[None if fit is None else fit[1] for fit in fits],
            mean=place.moments.mean[:count].tolist(),
            note=f"{percent(place.null_share)} null, {' / '.join(named) or 'no fit'}",
        )
        drawn.append(panel)
    return viz.chd_grid(drawn, columns=1 if len(drawn) == 1 else 2)


def _narrow(table: Table) -> Table:
    """Return a table without its second column, which takes the room of the others on paper."""
    rows = [[row[0], *row[2:]] for row in table["rows"]]
    return {**table, "columns": [table["columns"][0], *table["columns"][2:]], "rows": rows}


def _mark(key: Pixel | Box) -> viz.Mark:
    if len(key) == 2:
        y, x = key
        return viz.Mark(f"y {y}, x {x}", slice(y, y + 1), slice(x, x + 1), key)
    top, left, bottom, right = key
    center = ((top + bottom - 1) // 2, (left + right - 1) // 2)
    name = f"y {top} to {bottom - 1}, x {left} to {right - 1}"
    return viz.Mark(name, slice(top, bottom), slice(left, right), center)


def _pdf(source: str, plots: SelectionPlots, overall: Overall, exposure: float) -> bytes:
    image = np.nan_to_num(overall.mean, nan=0.0, posinf=0.0, neginf=0.0)
    marks = [_mark(key) for key in plots.keys]
    figures = {"image": viz.with_marks(image, marks, exposure=exposure), "chds": _figure(plots)}
    columns, count = columns_of([plots.place], "all"), len(plots.places)
    content = {
        "title": source,
        "place": plots.title,
        "rows": -(-count // (1 if count == 1 else 2)),
        "tables": [statistics_table(columns), _narrow(patterns_table(columns))],
    }
    with scratch() as folder:
        (folder / _TEMPLATE).write_text(_SELECTION, encoding="utf-8")
        target = folder / "selection.pdf"
        typeset(Document(_TEMPLATE, content, figures), folder, target)
        return target.read_bytes()


_SELECTION = """\
#let data = json("content.json")
#set document(title: data.title, author: "chdstat")
#set page(paper: "a4", margin: (x: 16mm, top: 12mm, bottom: 10mm))
#set text(font: ("Libertinus Serif",), size: 8.5pt, lang: "en")
#set table(stroke: none, inset: (x: 3pt, y: 1.4pt))
#show table.cell.where(y: 0): set text(weight: "semibold")
#let of(t) = [
  #text(9.5pt, weight: "bold")[#t.title] \\
  #text(6.5pt, t.note)
  #set text(6.5pt)
  #table(
    columns: t.columns.len(),
    table.hline(stroke: 0.4pt),
    ..t.columns.map(c => [#c]),
    table.hline(stroke: 0.4pt),
    ..t.rows.map(r => r.slice(0, t.columns.len())).flatten().map(c => [#c]),
    table.hline(stroke: 0.4pt),
  )
]
#text(13pt, weight: "bold")[#data.title]
#v(-2mm)
#align(center, image("image.svg", height: if data.rows < 2 { 96mm } else { 66mm }, fit: "contain"))
#let tall = calc.min(100mm, 36mm * data.rows + 8mm)
#align(center, image("chds.svg", width: 100%, height: tall, fit: "contain"))
#text(10pt, weight: "bold")[#data.place]

#grid(columns: (1.7fr, 1fr), column-gutter: 6mm, of(data.tables.at(0)), of(data.tables.at(1)))
"""
