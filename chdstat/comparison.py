"""Comparison: estimators side by side, on the same samples and against a held-out reference.

`compare` cuts the samples of every pixel into batches of n, lets each estimator estimate from each
batch, and measures against the mean of all *other* samples of the pixel. Estimators that learn are
trained first; the pixels that they saw do not count, for none of the estimators.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._tally import MEASURES, Function, judge
from chdstat.errors import InputError
from chdstat.estimators.heldout import Totals, check_spp, draw_pixels
from chdstat.estimators.registry import Estimator, LearnedEstimator, Model, lookup
from chdstat.metrics import Interval
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MEASURES", "Comparison", "compare"]

Array = npt.NDArray[Any]

_ALL = -1
"""Last place of the channel axis of a measure: the average over channels."""
_SUFFIXES = {
    "": "",
    "_se": ", standard error",
    "_low": ", lower end of the 95 % interval",
    "_high": ", upper end of the 95 % interval",
}


@dataclass(frozen=True)
class Comparison:
    """What `compare` has found.

    Attributes
    ----------
    estimators
        Names, in the order asked for.
    channels
        Names of the channels.
    measures
        By the names of `MEASURES`: intervals of shape (estimator, channel + 1), the last place
        being the average over channels.
    estimates
        One estimate of the whole picture from its first n samples, radiance, float32, shape
        (estimator, y, x, channel).
    squared_error
        Squared error of `estimates` against the mean of all other samples, same shape; NaN where
        the first n samples hold a bad one.
    reference
        Mean of all good samples, radiance, shape (y, x, channel).
    test_pixels
        True where no estimator was trained: only these pixels count; shape (y, x).
    n
        Samples per estimate.
    batches
        Estimates that count, over all test pixels.
    excluded
        Estimates of test pixels left out for a bad sample.
    models
        Trained estimators by name.
    provenance
        Scene, samples, seed and settings, ready for JSON.
    """

    estimators: tuple[str, ...]
    channels: tuple[str, ...]
    measures: Mapping[str, Interval]
    estimates: npt.NDArray[np.float32]
    squared_error: npt.NDArray[np.float32]
    reference: npt.NDArray[np.float64]
    test_pixels: npt.NDArray[np.bool_]
    n: int
    batches: int
    excluded: int
    models: Mapping[str, Model]
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per estimator: its name and every measure, averaged over channels.

        Each measure also has ``_se``, ``_low`` and ``_high``: the standard error and the interval.
        """
        return [
            {"estimator": name, **self._row(index)} for index, name in enumerate(self.estimators)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return measures, per channel too, and provenance, ready for JSON (NaN becomes None)."""
        per_channel = {
            name: {
                measure: dict(zip(self.channels, values.value[index].tolist(), strict=False))
                for measure, values in self.measures.items()
            }
            for index, name in enumerate(self.estimators)
        }
        content = {
            "n": self.n,
            "batches": self.batches,
            "excluded": self.excluded,
            "test_pixels": int(self.test_pixels.sum()),
            "table": self.table(),
            "per_channel": per_channel,
            "provenance": dict(self.provenance),
        }
        return {key: _without_nan(value) for key, value in content.items()}

    def to_dataset(self) -> xr.Dataset:
        """Return measures and pictures with named dims.

        Measures have dims (estimator, part), a part being a channel or "mean"; beside each stand
        ``<measure>_se``, ``_low``, ``_high``.
        """
        import xarray as xr

        variables: dict[str, Any] = {}
        for measure, (long_name, units) in MEASURES.items():
            for suffix, values in _parts(self.measures[measure]).items():
                about = {"long_name": f"{long_name}{_SUFFIXES[suffix]}", "units": units}
                variables[measure + suffix] = (("estimator", "part"), values, about)
        picture = ("estimator", "y", "x", "channel")
        variables |= {
            "estimate": (picture, self.estimates, _about("estimate", "W sr-1 m-2")),
            "squared_error": (
                picture,
                self.squared_error,
                _about("squared error", "(W sr-1 m-2)^2"),
            ),
            "reference": (picture[1:], self.reference, _about("reference", "W sr-1 m-2")),
            "test_pixel": (picture[1:3], self.test_pixels, _about("pixel counts", "1")),
        }
        height, width = self.test_pixels.shape
        return xr.Dataset(
            variables,
            {
                "estimator": np.array(self.estimators, dtype=object),
                "part": np.array([*self.channels, "mean"], dtype=object),
                "channel": np.array(self.channels, dtype=object),
                "y": np.arange(height),
                "x": np.arange(width),
            },
            {
                k: v if isinstance(v, str | int) else json.dumps(v, default=str)
                for k, v in self.provenance.items()
            },
        )

    def _row(self, index: int) -> dict[str, float]:
        return {
            measure + suffix: float(values[index, _ALL])
            for measure, interval in self.measures.items()
            for suffix, values in _parts(interval).items()
        }


def compare(
    samples: Samples,
    estimators: Sequence[str | Estimator] = ("mean", "median_of_means", "elek2019"),
    *,
    n: int = 32,
    seed: int = 0,
    max_batches: int | None = 16,
    model: Model | None = None,
    progress: bool | None = None,
) -> Comparison:
    """Measure estimators on the same batches of n samples, against held-out references.

    The reference of a batch is the mean of the other samples of its pixel. It is itself noisy, and
    its variance, about n/(spp - n) times that of a batch's mean, is part of every squared error.
    Where all batches estimate, the errors of the sample mean cancel within each pixel: its bias is
    then 0 by construction.

    Parameters
    ----------
    samples
        The picture, at least 2 n samples per pixel.
    estimators
        Names of registered estimators, or entries of your own.
    n
        Samples per estimate.
    seed
        Draws training and bootstrap.
    max_batches
        Batches per pixel that estimate, in stored order; None takes all. All samples count for
        the reference.
    model
        A trained estimator to take in place of training the one of its name. Where it was trained
        on a picture of the same size, its pixels do not count.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If an estimator is unknown, named twice, or does not take n samples; if there are too few
        samples; or if no pixel is left to judge by.

    Examples
    --------
    >>> import chdstat as chd
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> samples = chd.Samples.from_array(rng.exponential(size=(8, 8, 3, 128)))
    >>> found = chd.compare(samples, ["mean", "median_of_means"])
    >>> for row in found.table():
    ...     print(row["estimator"], round(row["mse_ratio"], 1), row["bias"] < -0.05)
    mean 1.0 False
    median_of_means 1.5 True
    """
    for name, number in (("n", n), ("max_batches", max_batches)):
        if number is not None and number < 1:
            message = f"{name} must be at least 1, got {number}"
            raise InputError(message)
    entries = _resolve(estimators, n)
    check_spp(samples, n)
    totals = Totals.of(samples)
    if not totals.count.any():
        message = "every sample of the picture is bad (NaN, infinite or negative); none can judge"
        raise InputError(message)
    models = _train(entries, samples, seed=seed, model=model, progress=progress)
    test = _test_pixels(models, samples.shape[:2])
    functions: dict[str, Function] = {
        name: models[name].predict if isinstance(entry, LearnedEstimator) else entry
        for name, entry in entries.items()
    }
    tally = judge(functions, samples, totals, test, n=n, limit=max_batches, progress=progress)
    if tally.count.sum() == 0:
        message = (
            f"every batch of {n} samples of the test pixels holds a bad sample; none can judge"
        )
        raise InputError(message)
    return Comparison(
        estimators=tuple(functions),
        channels=samples.channels,
        measures=tally.measures(seed=seed),
        estimates=tally.estimates,
        squared_error=tally.squared_error,
        reference=totals.mean(),
        test_pixels=test,
        n=n,
        batches=int(tally.count.sum()),
        excluded=tally.excluded,
        models=models,
        provenance={
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            "seed": seed,
            "max_batches": max_batches,
            "models": {name: getattr(m, "provenance", {}) for name, m in models.items()},
        },
    )


def _resolve(
    estimators: Sequence[str | Estimator], n: int
) -> dict[str, Estimator | LearnedEstimator]:
    """Look the names up and refuse what cannot be compared on batches of n."""
    found = [lookup(e) if isinstance(e, str) else e for e in estimators]
    entries = {entry.name: entry for entry in found}
    if not entries or len(entries) < len(found):
        message = f"estimators must be one or more different names, got {[e.name for e in found]}"
        raise InputError(message)
    for entry in found:
        least = entry.inputs if isinstance(entry, LearnedEstimator) else entry.minimum_samples
        if n < least or (isinstance(entry, LearnedEstimator) and n != least):
            exactly = "exactly" if isinstance(entry, LearnedEstimator) else "at least"
            message = f"{entry.name} takes {exactly} {least} samples, got n={n}; give another n"
            raise InputError(message)
    return entries


def _train(
    entries: Mapping[str, Estimator | LearnedEstimator],
    samples: Samples,
    *,
    seed: int,
    model: Model | None,
    progress: bool | None,
) -> dict[str, Model]:
    """Train what learns, all on the same pixels, except for the model that is at hand."""
    learned = {k: e for k, e in entries.items() if isinstance(e, LearnedEstimator)}
    if model is not None and model.name not in learned:
        message = (
            f"the model is a {model.name!r}, which is not among {list(entries)}; name it there"
        )
        raise InputError(message)
    wanted = max((e.pixels for e in learned.values()), default=0)
    pixels = draw_pixels(samples.shape[:2], wanted, seed=seed)
    return {
        name: model
        if model is not None and model.name == name
        else entry.train(samples, seed=seed, pixels=pixels, progress=progress)
        for name, entry in learned.items()
    }


def _test_pixels(models: Mapping[str, Model], shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    test = np.ones(shape, bool)
    for model in models.values():
        if model.train_shape == shape:
            test[tuple(model.train_pixels.T)] = False
    if not test.any():
        message = "the models were trained on every pixel of this picture; none is left to judge by"
        raise InputError(message)
    return test


def _parts(interval: Interval) -> dict[str, Array]:
    values = interval.value, interval.standard_error, interval.low, interval.high
    return dict(zip(_SUFFIXES, values, strict=True))


def _about(long_name: str, units: str) -> dict[str, str]:
    return {"long_name": long_name, "units": units}


def _without_nan(value: Any) -> Any:
    """Replace what JSON cannot say."""
    if isinstance(value, Mapping):
        return {str(key): _without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(part) for part in value]
    if isinstance(value, np.generic | np.ndarray):
        return _without_nan(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
