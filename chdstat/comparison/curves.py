"""Curves: how the error of estimators falls with the number of samples.

`error_curve` compares estimators, as `chdstat.compare` does, at many sizes of batches. Use it to
see up to which size an estimator pays: where it has a bias that does not fall, its error does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Seed, seed_number, whole
from chdstat._core.resampling import Interval
from chdstat.comparison.accumulate import MEASURES, ErrorAccumulator, Units, judge, stack_intervals
from chdstat.comparison.candidates import (
    DEFAULT,
    Candidates,
    Entry,
    Given,
    least_taken,
    looked_up,
    resolve,
    takes,
    totals_of,
)
from chdstat.comparison.tables import (
    dataset_of,
    interval_variables,
    names_array,
    parts_of,
    ready_for_json,
)
from chdstat.errors import InputError
from chdstat.estimators.registry import Model
from chdstat.estimators.validation import check_spp
from chdstat.samples import Image, Samples, samples_of

if TYPE_CHECKING:
    import xarray as xr

Array = npt.NDArray[np.float64]

__all__ = ["ErrorCurve", "curve_sizes", "error_curve"]

_SMALLEST, _SHARE = 4, 8
"""By default, sizes double from 4 to an eighth of the samples: the rest is the reference."""


@dataclass(frozen=True)
class ErrorCurve:
    """What `error_curve` has found.

    Attributes
    ----------
    estimators
        Names, those that use neighbours last.
    uses_neighbours
        Which of them look at the pixels around, shape (estimator,).
    sizes
        Samples per estimate, ascending.
    measures
        By the names of `chdstat.comparison.MEASURES`: intervals over blocks, averaged over
        channels, shape (size, estimator); NaN where an estimator does not take so many samples.
    reference_noise
        For "mse" and "relmse": the error that even a perfect estimator would show, since the
        reference is noisy; the same unit, shape (size,).
    batches
        Estimates that count, over all test pixels, shape (size,).
    test_pixels
        How many pixels count.
    models
        Trained estimators by name.
    provenance
        Scene, samples, seed and settings, ready for JSON.
    """

    estimators: tuple[str, ...]
    uses_neighbours: npt.NDArray[np.bool_]
    sizes: tuple[int, ...]
    measures: Mapping[str, Interval[Array]]
    reference_noise: Mapping[str, npt.NDArray[np.float64]]
    batches: npt.NDArray[np.int64]
    test_pixels: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per size and estimator that takes it, with every measure."""
        return [
            {
                "n": size,
                "estimator": name,
                "uses_neighbours": bool(self.uses_neighbours[k]),
                **{
                    measure + suffix: float(values[row, k])
                    for measure, interval in self.measures.items()
                    for suffix, values in parts_of(interval).items()
                },
            }
            for row, size in enumerate(self.sizes)
            for k, name in enumerate(self.estimators)
            if np.isfinite(self.measures["mse"].value[row, k])
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the models, ready for JSON (NaN becomes None)."""
        content = {
            "sizes": self.sizes,
            "batches": self.batches,
            "test_pixels": self.test_pixels,
            "reference_noise": dict(self.reference_noise),
            "table": self.table(),
            "provenance": dict(self.provenance),
        }
        return {key: ready_for_json(value) for key, value in content.items()}

    def to_dataset(self) -> xr.Dataset:
        """Return the measures with dims (n, estimator), each with ``_se``, ``_low``, ``_high``."""
        variables = interval_variables(self.measures, ("n", "estimator"))
        for measure, noise in self.reference_noise.items():
            long_name, units = MEASURES[measure]
            about = {"long_name": f"{long_name} of a perfect estimator", "units": units}
            variables[f"{measure}_reference_noise"] = (("n",), noise, about)
        marks = {"long_name": "whether it looks at the pixels around", "units": "1"}
        variables["uses_neighbours"] = (("estimator",), self.uses_neighbours, marks)
        counts = {"long_name": "estimates that count", "units": "1"}
        variables["batches"] = (("n",), self.batches, counts)
        size = ("n", np.array(self.sizes), {"long_name": "samples per estimate", "units": "1"})
        coordinates = {"n": size, "estimator": names_array(self.estimators)}
        return dataset_of(variables, coordinates, self.provenance)


def error_curve(
    samples: Image | npt.ArrayLike,
    estimators: Sequence[str | Entry] = DEFAULT,
    *,
    sizes: Sequence[int] | None = None,
    seed: Seed = 0,
    max_batches: int | None = 16,
    model: Given = None,
    progress: bool | None = None,
) -> ErrorCurve:
    r"""Measure the error of estimators at many numbers of samples, N.

    At every N, batches of N samples estimate, and the mean of the other samples of the pixel is the
    reference, as in `chdstat.compare`. The variance of a sample is :math:`\sigma^2`; the sample
    mean shows :math:`\sigma^2 / N + \sigma^2 / (\text{spp} - N)`, of which the second part is the
    noise of the reference. It is N/spp of the whole, which is how it is known without knowing
    :math:`\sigma^2`; for relMSE, the same share is an approximation.

    Parameters
    ----------
    samples
        The image, as `compare` takes it, at least twice as many samples per pixel as the largest N.
    estimators
        Names of registered estimators, or entries of your own. Where one does not take N samples,
        there is no number.
    sizes
        N, in any order; None doubles from 4 to an eighth of the samples, and adds the fewest that
        an estimator takes where these are none.
    seed, max_batches, model, progress
        As for `chdstat.compare`. Pixels that trained a model count at no N. Small batches are
        read one by one: `Samples.load` a store first.

    Returns
    -------
    ErrorCurve

    Raises
    ------
    InputError
        If `sizes` are not different whole numbers from 1, there are too few samples for them, an
        estimator takes none of them, or nothing is left to judge by.

    Examples
    --------
    The bias of a median stays, so that its error stops falling:

    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(16, 16, 1, 1024)))
    >>> curve = error_curve(samples, ["mean", "median"], sizes=[16, 128])
    >>> curve.measures["mse_ratio"].value.round()
    array([[ 1.,  2.],
           [ 1., 11.]])
    """
    samples, seed = samples_of(samples), seed_number(seed)
    if max_batches is not None:
        max_batches = whole("max_batches", max_batches, least=1)
    chosen = curve_sizes(samples, estimators, sizes=sizes)
    entries = resolve(estimators, chosen)
    totals = totals_of(samples)
    candidates = Candidates.of(
        entries, samples, sizes=chosen, seed=seed, model=model, progress=progress
    )
    units = Units.of(candidates.test_pixels(samples.shape[:2]))
    accumulated = [
        judge(
            candidates.taking(n),
            samples,
            totals,
            units,
            n=n,
            limit=max_batches,
            images=False,
            progress=progress,
        )
        for n in chosen
    ]
    found = [
        _measures(errors, candidates, n, seed)
        for errors, n in zip(accumulated, chosen, strict=True)
    ]
    return ErrorCurve(
        estimators=candidates.names,
        uses_neighbours=candidates.uses_neighbours,
        sizes=chosen,
        measures={name: stack_intervals([part[name] for part in found]) for name in MEASURES},
        reference_noise=_reference_noise(accumulated, chosen, samples.spp),
        batches=np.array([errors.by_unit.count.sum() for errors in accumulated]),
        test_pixels=len(units.ys),
        models=candidates.models,
        provenance={
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            "seed": seed,
            "max_batches": max_batches,
            "models": candidates.provenance,
        },
    )


def curve_sizes(
    samples: Samples,
    estimators: Sequence[str | Entry] = DEFAULT,
    *,
    sizes: Sequence[int] | None = None,
) -> tuple[int, ...]:
    """Return the N of an error curve in ascending order, checked before any work.

    Raises
    ------
    InputError
        As `error_curve` does.
    """
    if sizes is None:
        largest = max(_SMALLEST, samples.spp // _SHARE)
        doubled = [2**k for k in range(_SMALLEST.bit_length() - 1, largest.bit_length())]
        entries = looked_up(estimators)
        fewest = {least_taken(e) for e in entries if not any(takes(e, n) for n in doubled)}
        sizes = [*doubled, *(n for n in fewest if 2 * n <= samples.spp)]
    if np.ndim(sizes) != 1:
        message = f"sizes must be several numbers, got {sizes!r}"
        raise InputError(message)
    chosen = tuple(sorted(whole("a size", n, least=1) for n in sizes))
    if not chosen or len(set(chosen)) < len(chosen):
        message = f"sizes must be one or more different numbers from 1, got {chosen}"
        raise InputError(message)
    check_spp(samples, chosen[-1])
    resolve(estimators, chosen)
    return chosen


def _measures(
    errors: ErrorAccumulator, candidates: Candidates, n: int, seed: int
) -> dict[str, Interval[Array]]:
    """Return measures averaged over channels, NaN for those who do not take n samples."""
    if errors.by_unit.count.sum() == 0:
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    found = errors.by_block.measures(seed=seed)
    names = list(candidates.taking(n))
    place = [names.index(name) if name in names else len(names) for name in candidates.names]
    return {measure: _placed(interval[:, -1], place) for measure, interval in found.items()}


def _placed(interval: Interval[Array], place: list[int]) -> Interval[Array]:
    """Put estimators in their place; beyond the last there is NaN."""
    return interval.map(lambda part: np.append(part, np.nan)[place])


def _reference_noise(
    accumulated: list[ErrorAccumulator], sizes: tuple[int, ...], spp: int
) -> dict[str, npt.NDArray[np.float64]]:
    """Return what the noise of the reference adds: the share N/spp of the sample mean's error."""
    sums = np.stack([errors.by_unit.sums[:, :2, 0].sum(axis=0) for errors in accumulated])
    counts = np.array([errors.by_unit.count.sum() for errors in accumulated])
    of_mean = sums.mean(axis=-1) / counts[:, np.newaxis]
    share = np.array(sizes) / spp
    return {"mse": of_mean[:, 0] * share, "relmse": of_mean[:, 1] * share}
