"""Drawing: arrays and results in, Matplotlib figures out.

Nothing here computes statistics, and nothing is saved or shown: every function returns a `Figure`
to save, or draws into given `Axes`. One style holds for all (`style`); colours stay apart for
colour-blind readers.
"""

from __future__ import annotations

from chdstat.viz.chd import Curve, Panel, chd_axes, chd_grid, fits
from chdstat.viz.curves import averages, training
from chdstat.viz.errors import error_curves, pattern_breakdown
from chdstat.viz.estimates import estimator_measures, pixel_estimates
from chdstat.viz.image import Mark, pictures, tonemap, with_marks
from chdstat.viz.maps import categorical_map, map_grid, n_needed, value_map
from chdstat.viz.shapes import atlas
from chdstat.viz.style import CHANNELS, PALETTE, style

__all__ = [
    "CHANNELS",
    "PALETTE",
    "Curve",
    "Mark",
    "Panel",
    "atlas",
    "averages",
    "categorical_map",
    "chd_axes",
    "chd_grid",
    "error_curves",
    "estimator_measures",
    "fits",
    "map_grid",
    "n_needed",
    "pattern_breakdown",
    "pictures",
    "pixel_estimates",
    "style",
    "tonemap",
    "training",
    "value_map",
    "with_marks",
]
