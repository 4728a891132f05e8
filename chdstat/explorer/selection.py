"""Selection: what a view shows of the selected pixels or region, computed without any page.

Panels come first, as images are looked at first; then tables; then what takes long.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison.estimator_choice import notes
from chdstat.explorer import batch_estimates, tables
from chdstat.explorer.address import Box, PixelIndex, View
from chdstat.explorer.batch_estimates import BATCHES_AROUND, PlaceEstimates
from chdstat.explorer.brushing import grouped
from chdstat.explorer.image_sources import (
    MOST_POOLED,
    ImageSource,
    Sampled,
    SceneSource,
    StoreSource,
    drop_oldest,
)
from chdstat.explorer.panels import PanelData, beside, panels, series_of
from chdstat.explorer.tables import MOST_TESTED, RESAMPLES, Table
from chdstat.explorer.workspace import Workspace
from chdstat.fit import Goodness
from chdstat.fit.families import FAMILIES
from chdstat.inference.differences import Difference, difference
from chdstat.patterns import Pixel
from chdstat.samples.tiles import LightPart


@dataclass(frozen=True)
class SelectionPlots:
    """Everything that a view shows except its tables.

    Attributes
    ----------
    view
        The view.
    keys
        (y, x) of pixels, or (top, left, bottom, right) of a region; none where nothing is selected.
    found
        What is known of each by the index of a source that has samples.
    index
        Which of these tables describe: the one that is shown, else the first.
    source, name
        What it is, and what it is called.
    panels
        What each panel draws, by name.
    legend
        Names and colours of what is drawn.
    """

    view: View
    keys: Sequence[PixelIndex | Box]
    found: Mapping[int, Sequence[Pixel]]
    index: int
    source: Sampled
    name: str
    panels: Mapping[str, PanelData]
    legend: Sequence[tuple[str, str]]

    @property
    def places(self) -> Sequence[Pixel]:
        """The places that tables describe."""
        return self.found[self.index]

    @property
    def live_spp(self) -> int | None:
        """Samples of the active pixel where more of them can be drawn, else None."""
        live = isinstance(self.source, SceneSource) and bool(self.view.pixels)
        return self.place.spp if live else None

    @property
    def key(self) -> PixelIndex | Box:
        """Pixel or region that tables describe."""
        return self.keys[self.view.active]

    @property
    def place(self) -> Pixel:
        """The place that tables describe."""
        return self.places[self.view.active]

    @property
    def title(self) -> str:
        """Name of the place that tables describe, and how many samples it has."""
        samples = f"{grouped(self.place.spp)} samples"
        samples += f" of {self.name}" if len(self.found) > 1 else ""
        if len(self.key) == 4:
            top, left, bottom, right = self.key
            where = f"Region y {top}–{bottom - 1}, x {left}–{right - 1}"
            whole = self.source.held(self.key) if isinstance(self.source, StoreSource) else 0
            of = f" of {grouped(whole)}" if whole > self.place.spp else ""
            samples = samples.replace(" samples", f"{of} samples", 1)
            return f"{where} · {grouped((bottom - top) * (right - left))} pixels · {samples}"
        which = f" {self.view.active + 1}" if len(self.places) > 1 else ""
        return f"Pixel{which} · y {self.key[0]}, x {self.key[1]} · {samples}"

    @property
    def n(self) -> int:
        """Samples of an estimate: one alone is no estimate."""
        return max(self.view.batch, 2)


class SelectionResults:
    """Computes results and keeps the latest places.

    `plots` is for one thread at a time; the other methods only read what it returned.

    Parameters
    ----------
    workspace
        Has the sources, the first of which may grow.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._places: dict[tuple[int, PixelIndex | Box], Pixel] = {}
        self._guessed: tuple[Any, ...] = ()

    def plots(self, view: View, step: Callable[[], None] = lambda: None) -> SelectionPlots | None:
        """Return what the panels of a view show; None where nothing is selected or has samples.

        `step` is called now and then; whatever it raises ends the computation, and what is known of
        the places by then is kept.

        Raises
        ------
        InputError
            If a pixel is outside the image.
        StoreError
            If a store is damaged or gone.
        """
        workspace = self._workspace
        keys: list[PixelIndex | Box] = list(view.pixels) if view.region is None else [view.region]
        found = {
            i: [self._statistics(source, i, key) for key in keys]
            for i, source in enumerate(workspace.sources)
            if not isinstance(source, ImageSource) and keys
        }
        if not found:
            return None
        shown, _ = view.of_images(len(workspace.sources))
        index = shown if shown in found else next(iter(found))
        view = view.of_samples(min(place.spp for those in found.values() for place in those))
        series = series_of(view, {workspace.names[i]: those for i, those in found.items()})
        legend = list(dict.fromkeys((s.name, s.color) for s in series))
        source: Any = workspace.sources[index]
        name, drawn = workspace.names[index], panels(view, series, step)
        overall = workspace.overalls[index]
        if view.region is not None and overall.histogram.any():
            drawn["log"] = beside(drawn["log"], overall, series)
        return SelectionPlots(view, keys, found, index, source, name, drawn, legend)

    def guess(self, view: View, step: Callable[[], None]) -> None:
        """Compute what `results` will return of a view, unless `step` raises."""
        sources = list(self._workspace.sources)
        plots = self.plots(view, step)
        step()
        # The distance of two stores takes long.
        if plots is not None and len(sources) == 1:
            self._guessed = view.of_results(), sources, plots, self.describe(plots)

    def results(
        self, view: View, show: Callable[[SelectionPlots], None]
    ) -> tuple[SelectionPlots, dict[str, Table], list[PlaceEstimates]] | None:
        """Return plots, tables and quick estimates of a view; the plots are shown before these.

        Raises
        ------
        InputError, StoreError
            As for `plots`.
        """
        if self._guessed[:2] == (view.of_results(), list(self._workspace.sources)):
            *_, plots, described = self._guessed
            show(plots)
            return plots, *described
        plots = self.plots(view)
        if plots is None:
            return None
        show(plots)
        return plots, *self.describe(plots)

    def describe(self, plots: SelectionPlots) -> tuple[dict[str, Table], list[PlaceEstimates]]:
        """Return the tables of the active place by name, and the estimates of quick estimators."""
        source, workspace = plots.source, self._workspace
        batches = batch_estimates.batches_of(plots.place.radiance, plots.n)
        quick = batch_estimates.estimates(batches) if len(batches) else []
        around = quick and isinstance(source, StoreSource) and len(plots.key) == 2
        more = "estimators that use neighbouring pixels follow" if around else ""
        columns = tables.columns_of(plots.places, plots.view.channel)
        found = {
            "statistics": tables.statistics_table(columns),
            "patterns": tables.patterns_table(columns),
            "estimates": self._estimates_table(plots, quick, more),
        }
        light = plots.place.light, plots.place.lights
        titles = {"paths": "Light by length of path", "lights": "Light by its source"}
        for (name, title), rows in zip(titles.items(), light, strict=True):
            if rows:
                found[name] = self._of(plots, tables.light_table(title, rows))
        if plots.place.means_by_place is not None:
            found["places"] = self._of(plots, tables.places_table(plots.place))
        _, reference = plots.view.of_images(len(workspace.sources))
        if reference in plots.found and reference != plots.index:
            names = workspace.names[reference], plots.name
            table = tables.compared_table(
                self._difference(plots, reference), plots.place.channels, names
            )
            found["compared"] = self._of(plots, table)
        return found, quick

    def slow_estimates(
        self,
        plots: SelectionPlots,
        quick: Sequence[PlaceEstimates],
        step: Callable[[], None],
    ) -> Table:
        """Return the table of estimates with the slow ones, and those that look around.

        `step` is called before each of them; whatever it raises ends the computation.
        """
        key, source = plots.key, plots.source
        batches = batch_estimates.batches_of(plots.place.radiance, plots.n)
        if not len(batches):
            return self._estimates_table(plots, quick)
        found = [*quick]
        for name, model in self._workspace.models:
            step()
            found += batch_estimates.estimates_of_model(name, model, batches)
        if not isinstance(source, StoreSource) or len(key) != 2:
            return self._estimates_table(plots, found)
        around = batch_estimates.estimates_around(source, key, plots.n, step=step)
        about = notes([estimate.name for estimate in around])
        more = f"{len(around)} look at the pixels around, in {BATCHES_AROUND} batches"
        more += "".join(
            f". {name.capitalize()}, {text.rstrip('.')}" for name, text in about.items()
        )
        return self._estimates_table(plots, [*found, *around], more)

    def goodness(self, plots: SelectionPlots, step: Callable[[float], None]) -> Table:
        """Return the goodness of fit of every family; `step` is called with the share done."""
        found: dict[str, Goodness] = {}
        step(0)
        for family, test in plots.place.goodness(resamples=RESAMPLES, most=MOST_TESTED):
            found[family] = test
            step(len(found) / len(FAMILIES))
        return self._of(plots, tables.goodness_table(plots.place, found))

    def _statistics(self, source: Sampled, which: int, key: PixelIndex | Box) -> Pixel:
        earlier = self._places.pop((which, key), None)
        x = source.pixel(*key) if len(key) == 2 else source.region(key)
        if earlier is not None and earlier.spp == x.shape[1]:
            found = earlier
        elif earlier is not None:
            found = earlier.grown(x)
        else:
            parts: dict[LightPart, npt.NDArray[np.float32]] = {}
            if isinstance(source, StoreSource) and len(key) == 2:
                parts = {name: part[key] for name, part in source.samples.parts.items()}
            found = Pixel(*key[:2], x, source.channels, source.name, parts, most_fitted=MOST_POOLED)
        self._places[which, key] = found
        drop_oldest(self._places, lambda place: place.rows.nbytes)
        return found

    def _difference(self, plots: SelectionPlots, reference: int) -> Difference:
        """Compare a place with that of the reference, in pairs if these share random numbers."""
        source, other, key = plots.source, self._workspace.sources[reference], plots.key
        one, two = plots.found[reference][plots.view.active].radiance, plots.place.radiance
        if not isinstance(source, StoreSource) or not isinstance(other, StoreSource):
            return difference(one, two)
        paired = source.samples.shares_numbers_with(other.samples)
        if paired and one.shape != two.shape:
            spp = min(source.samples.spp, other.samples.spp)
            if len(key) == 2:
                one, two = one[:, :spp], two[:, :spp]
            else:  # as many of each pixel, so that pairs stay together
                one, two = other.region(key, spp), source.region(key, spp)
        return difference(one, two, paired=paired)

    def _estimates_table(
        self, plots: SelectionPlots, found: Sequence[PlaceEstimates], more: str = ""
    ) -> Table:
        given = [name for name, _ in self._workspace.models]
        table = tables.estimates_table(found, plots.place.channels, plots.n, more, given=given)
        return self._of(plots, table)

    def _of(self, plots: SelectionPlots, table: Table) -> Table:
        """Return a table that names its pixel, where several are selected."""
        if len(plots.places) < 2:
            return table
        y, x = plots.key[:2]
        return {**table, "title": f"{table['title']}, pixel {plots.view.active + 1}: y {y}, x {x}"}
