"""Error curves: the errors of estimators against the number of samples.

`error_curve` compares as `chdstat.compare` does, for many n, and returns an `ErrorCurve`. Use it to
see up to how many samples an estimator pays: with a constant bias, its error stops falling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, Seed, plain, seed_number, whole
from chdstat._core.display import Card, Shown, Width
from chdstat._core.doors import draw
from chdstat._core.resampling import Interval
from chdstat.comparison.entries import Entry, choose, curve_sizes
from chdstat.comparison.judging import Models, judge, trained_candidates
from chdstat.comparison.metrics import (
    columns_of,
    counts,
    data_frame_of,
    measures_of,
    rows_of,
    stacked,
    titled,
)
from chdstat.estimators.registry import Model
from chdstat.samples import ImageLike, samples_of

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class ErrorCurve(Shown):
    """Result of `error_curve`.

    Attributes
    ----------
    estimators, uses_neighbours, models, provenance
        As in a `Comparison`.
    sizes
        Samples per estimate, ascending.
    measures
        By the names of `chdstat.comparison.MEASURES`: intervals over blocks, averaged over
        channels, shape (size, estimator); NaN where an estimator does not take so many samples.
    batches
        Number of estimates that count, over all test pixels, shape (size,).
    test_pixels
        Number of test pixels.
    """

    _drawn: ClassVar[str] = "errors against the number of samples"
    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    sizes: tuple[int, ...]
    measures: Mapping[str, Interval[Array]]
    batches: npt.NDArray[np.int64]
    test_pixels: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per size and estimator that takes it, with every measure."""
        columns = columns_of(self.measures)
        return [
            {"n": size, **one}
            for row, size in enumerate(self.sizes)
            for one in rows_of(columns, self.estimators, self.uses_neighbours, row)
            if np.isfinite(one["mse"])
        ]

    def plot(self, *, width: Width = "page", fig: Figure | None = None) -> Figure:
        """Draw errors against the number of samples, as `chdstat.viz.error_curves` does."""
        return draw(self, width=width, fig=fig)

    def _card(self) -> Card:
        return Card("Error curve", table=titled(self.table()))

    def to_dataframe(self) -> pd.DataFrame:
        """Return a `pandas.DataFrame` like that of a `Comparison`, by n and estimator."""
        return data_frame_of(self.measures, n=self.sizes, estimator=self.estimators)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        names = "sizes", "batches", "test_pixels", "provenance"
        found: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return found | {"table": plain(self.table())}


def error_curve(
    samples: ImageLike | npt.ArrayLike,
    estimators: Sequence[str | Entry] | None = None,
    *,
    sizes: Sequence[int] | None = None,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Models = None,
    progress: bool | None = None,
    client: Client | None = None,
) -> ErrorCurve:
    """Measure the error of estimators at many numbers of samples, N.

    For every N, estimates from batches of N samples are compared with the other samples of the
    pixel, as in `chdstat.compare`: errors are without the noise of the reference.

    Parameters
    ----------
    samples
        The image, as `compare` takes it, with at least twice as many samples per pixel as the
        largest N.
    estimators
        As `compare` takes them. An estimator that does not take N samples has NaN there.
    sizes
        N, in any order; None doubles from 4 to an eighth of the samples. An estimator that takes
        none of these numbers adds the fewest samples that it takes.
    seed, max_batches, model, progress, client
        As for `chdstat.compare`. Pixels that trained a model count for no N. Small batches are read
        one by one, so `Samples.load` a store first.

    Returns
    -------
    ErrorCurve

    Raises
    ------
    InputError
        If `sizes` are not different integers from 1, there are too few samples for them, an
        estimator takes none of them, or no judging pixel is left.

    Examples
    --------
    The bias of a median remains, so its error stops falling:

    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(16, 16, 1, 1024)))
    >>> curve = error_curve(samples, ["mean", "median"], sizes=[16, 128])
    >>> curve.measures["mse_ratio"].value.round()
    array([[ 1.,  2.],
           [ 1., 13.]])
    """
    samples, seed = samples_of(samples), seed_number(seed)
    if max_batches is not None:
        max_batches = whole("max_batches", max_batches, least=1)
    numbers = curve_sizes(samples, estimators, sizes=sizes)
    chosen = choose(estimators, numbers, samples=samples)
    found = trained_candidates(
        chosen, samples, sizes=numbers, seed=seed, model=model, progress=progress
    )
    units = found.test_units(seed)
    parts, judged = [], []
    for n in numbers:
        errors = judge(found, units, n=n, limit=max_batches, progress=progress, client=client)
        parts.append(measures_of(errors.by_unit, seed=seed))
        judged.append(counts(errors.by_unit).sum())
    return ErrorCurve(
        estimators=tuple(found.entries),
        uses_neighbours=found.uses_neighbours,
        sizes=numbers,
        measures=stacked(parts),
        batches=np.array(judged),
        test_pixels=len(units.ys),
        models=found.models,
        provenance=found.provenance(seed, max_batches),
    )
