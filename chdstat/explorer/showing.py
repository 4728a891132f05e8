"""Showing: the picture of a page, and the map in its place."""

from __future__ import annotations

import numpy as np

from chdstat.errors import InputError
from chdstat.explorer.cargo import colorbar
from chdstat.explorer.images import Overall, rgba
from chdstat.explorer.live import SceneSource
from chdstat.explorer.maps import PICTURES, map_kind, of_overall
from chdstat.explorer.page import Page
from chdstat.explorer.shared import Shared
from chdstat.explorer.view import View

__all__ = ["Showing"]


class Showing:
    """Shows pictures and maps on a page, as a view wants them.

    Parameters
    ----------
    page
        Where to.
    shared
        Where they come from.
    """

    def __init__(self, page: Page, shared: Shared) -> None:
        self._page, self._shared = page, shared

    @property
    def overall(self) -> Overall:
        """The picture so far."""
        source = self._shared.source
        return self._shared.overall or Overall.empty(*source.size, len(source.channels))

    def exposure(self, view: View) -> float:
        """Return the stops that the picture is shown with."""
        return self.overall.exposure if view.exposure is None else view.exposure

    def picture(self, view: View) -> None:
        """Show the picture, or both."""
        exposure, mean = self.exposure(view), self.overall.mean
        if not np.isfinite(mean).any():  # nothing is drawn yet, which is no error
            mean = np.zeros_like(mean)
        self._page.show_picture(0, rgba(mean, exposure, view.tone), mean)
        other = self._shared.other_overall
        if other is not None:
            self._page.show_picture(1, rgba(other.mean, exposure, view.tone), other.mean)

    def want_map(self, name: str) -> None:
        """See to it that a map gets computed.

        Raises
        ------
        InputError
            If there is no such map, or no store to make it of.
        """
        if isinstance(self._shared.source, SceneSource):
            if (kind := map_kind(name)).name in PICTURES:
                return
            message = (
                f"{kind.title!r} needs a store: render the scene with "
                "'chdstat render SCENE -o STORE'"
            )
            raise InputError(message)
        self._shared.want(name)

    def map(self, view: View) -> None:
        """Show what there is of the map, or take it away."""
        found = None
        if view.map != "picture":
            overall = self._shared.overall
            found = of_overall(overall, view.map) if overall is not None else None
            found = found or self._shared.maps.get(view.map)
        self._page.show_map(found)
        self._page.say({"kind": "colorbar", "bar": colorbar(found)})
