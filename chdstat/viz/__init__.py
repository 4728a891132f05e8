"""Drawing: arrays and results in, Matplotlib figures out.

Nothing here computes statistics, and nothing is saved or shown: every function returns a `Figure`
to save, or draws into given `Axes`. One style holds for all (`style`); colours stay apart for
colour-blind readers.
"""

from __future__ import annotations

from chdstat.viz.chd import BatchPanel, Curve, Panel, batch_histograms, chd_axes, chd_grid, fits
from chdstat.viz.claims import (
    VERDICTS,
    Display,
    Measured,
    claim_intervals,
    displays,
    verdict_matrix,
)
from chdstat.viz.estimators import (
    error_curves,
    estimator_measures,
    pattern_breakdown,
    pixel_estimates,
)
from chdstat.viz.image import Mark, firefly_pair, side_by_side, tonemap, view_pair, with_marks
from chdstat.viz.maps import (
    atlas,
    categorical_map,
    coverage,
    image_map,
    map_grid,
    n_needed,
    value_map,
)
from chdstat.viz.regions import averages, region_study, training
from chdstat.viz.styling import CHANNELS, PALETTE, style

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
    "pixel_estimates",
    "region_study",
    "side_by_side",
    "style",
    "tonemap",
    "training",
    "value_map",
    "verdict_matrix",
    "view_pair",
    "with_marks",
]
