"""Drawing: arrays and results in, Matplotlib figures out.

Nothing here computes statistics, and nothing is saved or shown: every function returns a `Figure`
to save, or draws into given `Axes`. One style holds for all (`style`); colours stay apart for
colour-blind readers.
"""

from __future__ import annotations

from chdstat.viz.batches import BatchPanel, batch_histograms
from chdstat.viz.chd import Curve, Panel, chd_axes, chd_grid, fits
from chdstat.viz.claims import VERDICTS, Measured, claim_intervals, verdict_matrix
from chdstat.viz.contrasts import firefly_pair, view_pair
from chdstat.viz.curves import averages, training
from chdstat.viz.errors import error_curves, pattern_breakdown
from chdstat.viz.estimates import estimator_measures, pixel_estimates
from chdstat.viz.exhibits import Display, displays
from chdstat.viz.image import Mark, pictures, tonemap, with_marks
from chdstat.viz.maps import categorical_map, coverage, image_map, map_grid, n_needed, value_map
from chdstat.viz.regions import region_study
from chdstat.viz.shapes import atlas
from chdstat.viz.style import CHANNELS, PALETTE, style

__all__ = [
    "CHANNELS",
    "PALETTE",
    "VERDICTS",
    "BatchPanel",
    "Curve",
    "Display",
    "Mark",
    "Measured",
    "Panel",
    "atlas",
    "averages",
    "batch_histograms",
    "categorical_map",
    "chd_axes",
    "chd_grid",
    "claim_intervals",
    "coverage",
    "displays",
    "error_curves",
    "estimator_measures",
    "firefly_pair",
    "fits",
    "image_map",
    "map_grid",
    "n_needed",
    "pattern_breakdown",
    "pictures",
    "pixel_estimates",
    "region_study",
    "style",
    "tonemap",
    "training",
    "value_map",
    "verdict_matrix",
    "view_pair",
    "with_marks",
]
