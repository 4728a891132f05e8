"""Across scenes: what an estimator that was trained on one scene is worth on another.

`across` trains our estimator on every scene alone, on all but one, and on all, and measures each on
every scene, always on the same pixels, which trained none of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison._contestants import totals_of
from chdstat.comparison._sums import stack_intervals
from chdstat.comparison._tables import (
    ALL_CHANNELS,
    about_of,
    dataset_of,
    interval_variables,
    names_array,
    ready_for_json,
    row_of,
)
from chdstat.comparison._tally import Function, Units, judge
from chdstat.errors import InputError
from chdstat.estimators.heldout import check_spp
from chdstat.estimators.progressive import Progressive
from chdstat.estimators.progressive.pictures import chosen_pixels
from chdstat.metrics import Interval
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Across", "across"]

_FEWEST = 2
OTHERS, ALL, CONDITIONED = "all others", "all", ", conditioned"


@dataclass(frozen=True)
class Across:
    """What estimators trained on some scenes are worth on others.

    Attributes
    ----------
    trainings
        What they were trained on: the name of a scene, "all others" (but the one that judges),
        "all", and the last two with ", conditioned".
    scenes
        Names of the scenes that judge.
    measures
        By the names of `MEASURES`, averaged over channels: intervals over blocks, shape (training,
        scene).
    trusted
        The same for ``trust="halves"``.
    trust
        Mean over batches of how far each was trusted, 0 to 1, shape (training, scene).
    test_pixels
        How many pixels of each scene judge.
    n
        Samples per estimate.
    balance
        0 for the least MSE, 1 for the least relMSE.
    provenance
        Where the trained ones come from, and seed.
    """

    trainings: tuple[str, ...]
    scenes: tuple[str, ...]
    measures: Mapping[str, Interval]
    trusted: Mapping[str, Interval]
    trust: npt.NDArray[np.float64]
    test_pixels: tuple[int, ...]
    n: int
    balance: float
    provenance: Mapping[str, Any]

    def table(self) -> list[dict[str, Any]]:
        """Return one row per training and scene: every measure, and with ``trusted_`` again."""
        return [
            {
                "training": training,
                "scene": scene,
                "trust": float(self.trust[i, j]),
                **row_of(self.measures, (i, j)),
                **{f"trusted_{k}": v for k, v in row_of(self.trusted, (i, j)).items()},
            }
            for i, training in enumerate(self.trainings)
            for j, scene in enumerate(self.scenes)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the table and where it comes from, ready for JSON; NaN becomes None."""
        content = {
            "n": self.n,
            "balance": self.balance,
            "test_pixels": dict(zip(self.scenes, self.test_pixels, strict=True)),
            "table": self.table(),
            "provenance": self.provenance,
        }
        return {key: ready_for_json(value) for key, value in content.items()}

    def to_dataset(self) -> xr.Dataset:
        """Return the measures with dims (training, scene), and with the prefix ``trusted_``.

        Beside each stand ``<measure>_se``, ``_low`` and ``_high``.
        """
        dims = ("training", "scene")
        variables = interval_variables(self.measures, dims)
        variables |= interval_variables(
            self.trusted, dims, prefix="trusted_", about=", trusted as far as halves tell"
        )
        variables["trust"] = (dims, self.trust, about_of("share of the move from the mean", "1"))
        variables["test_pixels"] = (
            ("scene",),
            np.array(self.test_pixels),
            about_of("pixels that judge", "1"),
        )
        coordinates = {
            "training": names_array(self.trainings),
            "scene": names_array(self.scenes),
        }
        attrs = {"n": self.n, "balance": self.balance, **self.provenance}
        return dataset_of(variables, coordinates, attrs)


def across(
    scenes: Mapping[str, Samples],
    *,
    n: int = 32,
    balance: float = 0.5,
    iterations: int | None = None,
    seed: int = 0,
    max_batches: int | None = 8,
    progress: bool | None = None,
) -> Across:
    """Measure our estimator on every scene, trained on each alone, on all others, and on all.

    Of every scene the same half of the pixels trains or does not; the other half judges, all
    estimators on the same batches of n samples, against the mean of the other samples.

    Parameters
    ----------
    scenes
        Pictures by name, two or more, of any sizes, with the same channels and at least 2 n spp.
    n
        Samples per estimate.
    balance
        0 for the least MSE, 1 for the least relMSE, and what lies between.
    iterations
        As for `Progressive.train`.
    seed
        Draws training and bootstrap.
    max_batches
        Batches per pixel that estimate; None takes all.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Across

    Raises
    ------
    InputError
        If there are fewer than two scenes, they have too few samples or differ in channels, or an
        option is out of range.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> def picture(scale):
    ...     return chd.Samples.from_array(scale * rng.exponential(size=(16, 16, 1, 32)))
    >>> found = across({"day": picture(1), "night": picture(0.01)}, n=8, iterations=10)
    >>> found.trainings
    ('day', 'night', 'all others', 'all', 'all others, conditioned', 'all, conditioned')
    >>> found.measures["mse_ratio"].value.shape
    (6, 2)
    """
    _check(scenes, n, balance, max_batches)
    school = _School(scenes, n=n, iterations=iterations, seed=seed, progress=progress)
    rows = [*scenes, OTHERS, ALL, OTHERS + CONDITIONED, ALL + CONDITIONED]
    columns = [
        _judge(
            [school.model(row, name) for row in rows],
            samples,
            school.pixels[name],
            n=n,
            balance=balance,
            seed=seed,
            limit=max_batches,
            progress=progress,
        )
        for name, samples in scenes.items()
    ]
    return Across(
        trainings=tuple(rows),
        scenes=tuple(scenes),
        measures=_side_by_side(column.measures for column in columns),
        trusted=_side_by_side(column.trusted for column in columns),
        trust=np.stack([column.trust for column in columns], axis=1),
        test_pixels=tuple(column.pixels for column in columns),
        n=n,
        balance=balance,
        provenance={"seed": seed, "max_batches": max_batches, "models": school.provenance},
    )


def _check(scenes: Mapping[str, Samples], n: int, balance: float, max_batches: int | None) -> None:
    if len(scenes) < _FEWEST:
        message = f"across scenes needs at least {_FEWEST} of them, got {list(scenes)}"
        raise InputError(message)
    reserved = {name + more for name in (OTHERS, ALL) for more in ("", CONDITIONED)} & set(scenes)
    if reserved:
        message = f"{sorted(reserved)} cannot name scenes: they name trainings; use other names"
        raise InputError(message)
    for name, number in (("n", n), ("max_batches", max_batches)):
        if number is not None and number < 1:
            message = f"{name} must be at least 1, got {number}"
            raise InputError(message)
    if not 0 <= balance <= 1:
        message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
        raise InputError(message)
    for samples in scenes.values():
        check_spp(samples, n)


class _School:
    """Trains a model once for every set of scenes that one is asked of."""

    def __init__(
        self,
        scenes: Mapping[str, Samples],
        *,
        n: int,
        iterations: int | None,
        seed: int,
        progress: bool | None,
    ) -> None:
        self.scenes = scenes
        # The same pixels in every training, so that all are judged by the same others.
        drawn = chosen_pixels(list(scenes.values()), None, seed=seed)
        self.pixels = dict(zip(scenes, drawn, strict=True))
        self._options = {"sizes": [n], "iterations": iterations, "seed": seed, "progress": progress}
        self._models: dict[tuple[tuple[str, ...], bool], Progressive] = {}

    def model(self, row: str, judged: str) -> Progressive:
        """Return the model of a row for the scene that judges it."""
        conditioned = row.endswith(CONDITIONED) and row not in self.scenes
        row = row.removesuffix(CONDITIONED) if conditioned else row
        names = {OTHERS: [k for k in self.scenes if k != judged], ALL: list(self.scenes)}
        return self._trained(tuple(names.get(row, [row])), conditioned=conditioned)

    def _trained(self, names: tuple[str, ...], *, conditioned: bool) -> Progressive:
        key = names, conditioned
        if key not in self._models:
            options: dict[str, Any] = {
                "pixels": [self.pixels[name] for name in names],
                **self._options,
            }
            pictures = [self.scenes[name] for name in names]
            self._models[key] = Progressive(conditioned=conditioned).train(pictures, **options)
        return self._models[key]

    @property
    def provenance(self) -> list[dict[str, Any]]:
        """What the models say of their training, with the names of the scenes."""
        return [
            {"trained_on": list(names), **model.provenance}
            for (names, _), model in self._models.items()
        ]


@dataclass(frozen=True)
class _Column:
    """What all trainings are worth on one scene, shape (training,)."""

    measures: Mapping[str, Interval]
    trusted: Mapping[str, Interval]
    trust: npt.NDArray[np.float64]
    pixels: int


@dataclass(frozen=True)
class _Trusting:
    """A model that first measures how far to trust it, and notes that down."""

    model: Progressive
    balance: float
    shares: list[float] = field(default_factory=list)

    def __call__(self, x: npt.ArrayLike) -> npt.NDArray[Any]:
        self.shares.append(self.model.trust(x, balance=self.balance))
        return self.model.predict(x, balance=self.balance, trust=self.shares[-1])


def _judge(
    models: list[Progressive],
    samples: Samples,
    pixels: npt.NDArray[np.int64],
    *,
    n: int,
    balance: float,
    seed: int,
    limit: int | None,
    progress: bool | None,
) -> _Column:
    trusting = [_Trusting(model, balance) for model in models]
    plain = [partial(model.predict, balance=balance) for model in models]
    every: list[Function] = [*plain, *trusting]
    functions = {str(k): function for k, function in enumerate(every)}
    test = np.ones(samples.shape[:2], bool)
    test[tuple(pixels.T)] = False
    units = Units.of(test)
    totals = totals_of(samples)
    tally = judge(
        functions, samples, totals, units, n=n, limit=limit, pictures=False, progress=progress
    )
    measures = tally.by_block.measures(seed=seed)
    count = len(models)
    return _Column(
        {name: found[:count, ALL_CHANNELS] for name, found in measures.items()},
        {name: found[count:, ALL_CHANNELS] for name, found in measures.items()},
        np.array([np.mean(model.shares) for model in trusting]),
        int(test.sum()),
    )


def _side_by_side(columns: Iterable[Mapping[str, Interval]]) -> dict[str, Interval]:
    """Return measures (training, scene) of the columns of the matrix."""
    every = list(columns)
    stacked = {name: stack_intervals([column[name] for column in every]) for name in every[0]}
    fields = ("value", "standard_error", "low", "high")
    return {
        name: Interval(*(getattr(found, part).T for part in fields))
        for name, found in stacked.items()
    }
