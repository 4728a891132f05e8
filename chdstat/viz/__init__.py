"""Drawing: arrays and results in, Matplotlib axes and figures out.

Nothing here computes statistics, and nothing is saved or shown. A function that draws one panel
takes ``ax=``, the axes to draw into, and returns them; a function that draws several panels takes
``fig=`` and returns the figure. Without them, it makes a new figure (``ax.figure``), which a
notebook shows. ``width=`` is a column or the page of a paper, or a number of inches. All figures
have the same style (`style`); colours are distinct for colour-blind readers, and fonts are
embedded.
"""

from __future__ import annotations

from chdstat._core.image_scales import tonemap
from chdstat.viz.chd import (
    Panel,
    batch_histograms,
    chd_axes,
    chd_grid,
    chd_pair,
    fit_curve,
    fits,
    mode_stems,
    tail_curve,
)
from chdstat.viz.claims import VERDICTS, claim_intervals, finding_plots, verdict_matrix
from chdstat.viz.estimators import (
    averages,
    error_curves,
    estimator_measures,
    pattern_breakdown,
    pixel_estimates,
    training,
)
from chdstat.viz.image import (
    Mark,
    batches_of_pixels,
    firefly_pair,
    region_study,
    side_by_side,
    with_marks,
)
from chdstat.viz.maps import (
    atlas,
    categorical_map,
    film_split,
    image_map,
    map_grid,
    n_needed,
    pixel_by_place,
    value_map,
)
from chdstat.viz.several_renders import contrast, renders_contrasted
from chdstat.viz.styling import CHANNELS, PALETTE, style

__all__ = [
    "CHANNELS",
    "PALETTE",
    "VERDICTS",
    "Mark",
    "Panel",
    "atlas",
    "averages",
    "batch_histograms",
    "batches_of_pixels",
    "categorical_map",
    "chd_axes",
    "chd_grid",
    "chd_pair",
    "claim_intervals",
    "contrast",
    "error_curves",
    "estimator_measures",
    "film_split",
    "finding_plots",
    "firefly_pair",
    "fit_curve",
    "fits",
    "image_map",
    "map_grid",
    "mode_stems",
    "n_needed",
    "pattern_breakdown",
    "pixel_by_place",
    "pixel_estimates",
    "region_study",
    "renders_contrasted",
    "side_by_side",
    "style",
    "tail_curve",
    "tonemap",
    "training",
    "value_map",
    "verdict_matrix",
    "with_marks",
]


def __dir__() -> list[str]:
    return sorted(__all__)
