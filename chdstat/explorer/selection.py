"""Results of a selection: panels, tables and estimates, computed without any page.

Panels come first, as images are looked at first; then tables; then what takes long.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chdstat.explorer import tables
from chdstat.explorer.estimators import (
    BATCHES_AROUND,
    ScoredEstimate,
    batches_of,
    fixed_names,
    quick_names,
    scored,
    scored_around,
    scored_learners,
)
from chdstat.explorer.exports import Shown
from chdstat.explorer.images import SceneSource
from chdstat.explorer.palette import BLENDED
from chdstat.explorer.panels import PanelData, panels, series_of
from chdstat.explorer.shared import Shared
from chdstat.explorer.sources import Box, Source, StoreSource
from chdstat.explorer.statistics import PlaceStatistics, goodness
from chdstat.explorer.view import Pixel, View
from chdstat.inference.differences import Difference, difference

__all__ = ["SelectionPlots", "SelectionResults", "SelectionTables"]

_KEPT_BYTES = 128 * 2**20


@dataclass(frozen=True)
class SelectionPlots:
    """What a view shows, but for its tables.

    Attributes
    ----------
    view
        The view.
    shown
        The places that are selected; none where nothing is.
    others
        The same places of the store that is compared with.
    panels
        What each panel draws, by name.
    legend
        Names and colours of what is drawn.
    live_spp
        Samples of the active pixel where more of them can be drawn, else None.
    """

    view: View
    shown: Shown
    others: Sequence[PlaceStatistics]
    panels: Mapping[str, PanelData]
    legend: Sequence[tuple[str, str]]
    live_spp: int | None


@dataclass(frozen=True)
class SelectionTables:
    """Tables that describe the active place.

    Attributes
    ----------
    tables
        Ready for the page, by name.
    estimates
        Of the quick estimators.
    """

    tables: dict[str, tables.Table]
    estimates: Sequence[ScoredEstimate]


class SelectionResults:
    """Computes results and remembers the places that were looked at.

    `plots` is for one thread at a time; the others only read what it returned.

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
        keys: list[Pixel | Box] = list(view.pixels) if view.region is None else [view.region]
        places = [self._statistics(self._shared.source, 0, key) for key in keys]
        other = self._shared.other
        others = [] if other is None else [self._statistics(other, 1, key) for key in keys]
        series = series_of(view, places, others)
        legend = [(s.name, s.color) for s in series if not s.other]
        live = isinstance(self._shared.source, SceneSource) and bool(view.pixels)
        return SelectionPlots(
            view=view,
            shown=Shown(self._shared.source.name, keys, places, view.active),
            others=others,
            panels=panels(view, series),
            legend=legend if other is None else [*legend, (f"dashed: {other.name}", BLENDED)],
            live_spp=places[view.active].spp if live else None,
        )

    def describe(self, plots: SelectionPlots) -> SelectionTables:
        """Return what the tables tell of the active place."""
        view, shown = plots.view, plots.shown
        if not shown.places:
            return SelectionTables({}, [])
        place = shown.places[view.active]
        reference = self._reference(shown.keys[view.active], place)
        estimates = scored(_channels(place), _batch(view), reference, names=quick_names())
        found = {
            "statistics": tables.statistics(place),
            "patterns": {**tables.patterns(place), "words": True},
            "estimates": self._table(estimates, place, view),
        }
        if self._shared.other is not None:
            changes = self._difference(shown.keys[view.active], place, plots.others[view.active])
            names = (self._shared.source.name, self._shared.other.name)
            found["compared"] = tables.compared(changes, self._shared.source.channels, names)
        return SelectionTables(found, estimates)

    def _difference(
        self, key: tuple[int, ...], place: PlaceStatistics, other: PlaceStatistics
    ) -> Difference:
        """Compare a place of the two stores, in pairs where these share random numbers."""
        source, second = self._shared.source, self._shared.other
        one, two = _channels(place), _channels(other)
        if (
            second is None
            or not isinstance(source, StoreSource)
            or not source.samples.shares_numbers_with(second.samples)
        ):
            return difference(one, two)
        spp = min(source.samples.spp, second.samples.spp)
        if len(key) == 2:
            return difference(one[:, :spp], two[:, :spp], paired=True)
        if one.shape != two.shape:  # as many of each pixel, so that pairs stay together
            box = (key[0], key[1], key[2], key[3])
            one, two = source.region(box, spp), second.region(box, spp)
        return difference(one, two, paired=True)

    def slow_estimates(
        self, plots: SelectionPlots, quick: SelectionTables, step: Callable[[], None]
    ) -> tables.Table:
        """Return the table of estimates with the slow ones, and those that look around.

        `step` is called before each of them; whatever it raises ends the computation.
        """
        view, shown = plots.view, plots.shown
        key, place = shown.keys[view.active], shown.places[view.active]
        x, n, reference = _channels(place), _batch(view), self._reference(key, place)
        slow = frozenset(fixed_names()) - quick_names()
        own = [*quick.estimates, *scored(x, n, reference, names=slow, step=step)]
        own += self._learned(key, x, n, reference, step)
        if not isinstance(self._shared.source, StoreSource) or len(key) != 2:
            return self._table(own, place, view)
        window, inside, _ = self._shared.source.around(key[0], key[1], n * BATCHES_AROUND)
        found = scored_around(x, window, inside, n, reference, step=step)
        more = f"; the last {len(found)} look at the pixels around, in {BATCHES_AROUND} batches"
        return self._table([*own, *found], place, view, more)

    def goodness(self, plots: SelectionPlots, step: Callable[[float], None]) -> tables.Table:
        """Return the goodness of fit of every family; `step` is told how far it is."""
        place = plots.shown.places[plots.view.active]
        return tables.goodness(goodness(place, step), place.names)

    def _learned(
        self,
        key: tuple[int, ...],
        x: npt.NDArray[np.float32],
        n: int,
        reference: npt.NDArray[np.float64] | None,
        step: Callable[[], None],
    ) -> list[ScoredEstimate]:
        shared = self._shared
        batches = batches_of(x, n, reference) if shared.learners else None
        if batches is None:
            return []
        source = shared.source if isinstance(shared.source, StoreSource) else None
        return scored_learners(shared.learners, batches, source, key, shared.unit, step=step)

    def _statistics(self, source: Source, which: int, key: Pixel | Box) -> PlaceStatistics:
        x = source.pixel(*key) if len(key) == 2 else source.region(key)
        known = self._places.pop((which, key), None)
        found = known if known is not None and known.spp == x.shape[1] else None
        if found is None:
            found = PlaceStatistics(x, source.channels)
            if known is not None:
                found.take_over(known)
        self._places[which, key] = found
        while len(self._places) > 1 and self._held > _KEPT_BYTES:
            self._places.pop(next(iter(self._places)))  # the one looked at longest ago
        return found

    @property
    def _held(self) -> int:
        return sum(place.rows.nbytes for place in self._places.values())

    def _reference(
        self, key: tuple[int, ...], place: PlaceStatistics
    ) -> npt.NDArray[np.float64] | None:
        reference = self._shared.reference
        if reference is None or len(key) != 2:
            return None
        x = reference.pixel(key[0], key[1])[:, self._shared.first_of_reference :]
        if not x.shape[1]:
            return None
        true = PlaceStatistics(x, place.channels)
        return true.moments.seen(true.moments.mean)[: len(place.channels)]

    def _table(
        self, found: Sequence[ScoredEstimate], place: PlaceStatistics, view: View, more: str = ""
    ) -> tables.Table:
        note = "error against the mean of the other samples, which no batch contains"
        reference, first = self._shared.reference, self._shared.first_of_reference
        if reference is not None and first < reference.samples.spp:
            note = f"error against {reference.name}"
            # The first ones share their random numbers with what is scored.
            note += f" from sample {first} on" if first else ""
        return tables.estimates(found, place.channels, _batch(view), note + more)


def _channels(place: PlaceStatistics) -> npt.NDArray[np.float32]:
    """Return the samples of a place without luminance."""
    return place.rows[: len(place.channels)]


def _batch(view: View) -> int:
    """Return the samples of an estimate: one alone is no estimate."""
    return max(view.batch, 2)
